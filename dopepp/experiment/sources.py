"""From the ``data`` config to parts, sources and the DataModule."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from dopepp.data.cache import CachedSource
from dopepp.data.datamodule import PoseDataModule
from dopepp.data.hybrid import HybridSource
from dopepp.data.rendered import MAX_ITEMS, RenderedSource, Split
from dopepp.data.sample import DescribedSource
from dopepp.data.ycb_layout import read_classes, read_image_set
from dopepp.data.ycb_video import YcbVideoSource
from dopepp.errors import UserError
from dopepp.experiment.gates import AUGMENTATIONS, MASKINGS, build_optional
from dopepp.geometry.camera import Letterbox
from dopepp.models.gate import check_integer, check_number
from dopepp.parts.catalogue import load_part
from dopepp.parts.mesh import ycb_part
from dopepp.parts.part import Part
from dopepp.virtual.backgrounds import Backgrounds, PhotoBackgrounds, ProceduralBackgrounds
from dopepp.virtual.customise import customised_preset
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import Preset

_log = logging.getLogger(__name__)

PAPER_OBJECTS: Final = (
    "003_cracker_box",
    "005_tomato_soup_can",
    "006_mustard_bottle",
    "009_gelatin_box",
    "010_potted_meat_can",
)
"""The YCB objects of the paper's tables."""

CACHES: Final = ("none", "memory")

MAX_WORKERS: Final = 1024
"""More loader processes than any machine here has cores: a slip of the keyboard."""


def build_parts(data: Mapping[str, Any]) -> list[Part]:
    """Build the objects to learn: YCB objects with a ``root``, else the listed parts.

    Raises:
        UserError: The root, an object or a part is wrong, or real frames are asked for without a
            root.
    """
    _check_options(data)
    if data["root"] is None:
        for option in ("objects", "frames"):
            if data[option] is not None:
                raise UserError(
                    f"data.{option}={data[option]} without data.root",
                    f"data.{option} names {option} of a YCB-Video folder; data.parts names meshes",
                    "set data.root, or use data.parts",
                )
        return [load_part(name, data["unit"]) for name in data["parts"]]
    root = Path(data["root"])
    classes = read_classes(root)
    names = PAPER_OBJECTS if data["objects"] is None else data["objects"]
    unknown = [name for name in names if name not in classes]
    if unknown:
        raise UserError(
            f"data.objects with {unknown[0]!r}", ", ".join(classes), "choose from this list"
        )
    return [ycb_part(root, name) for name in names]


def build_datamodule(data: Mapping[str, Any], parts: Sequence[Part], seed: int) -> PoseDataModule:
    """Build training, validation and test data and say in one line where real frames are missing.

    Raises:
        UserError: An option or a file is wrong.
    """
    backgrounds = _backgrounds(data)
    input_size = (data["input_size"][0], data["input_size"][1])
    workers = data["num_workers"]

    return PoseDataModule(
        train=_train_source(data, parts, seed, backgrounds, input_size),
        val=_held_out_source(data, parts, seed, "val"),
        test=_held_out_source(data, parts, seed, "test"),
        object_names=[part.name for part in parts],
        input_size=input_size,
        batch_size=data["batch_size"],
        num_workers=_num_cores() if workers is None else workers,
        seed=seed,
        masking=build_optional(MASKINGS, data["masking"]),
        augment=build_optional(AUGMENTATIONS, data["augment"]),
        backgrounds=backgrounds,
    )


def _num_cores() -> int:
    """Return the cores that this process may use, where the system tells (Linux), else all."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def build_test_source(data: Mapping[str, Any], parts: Sequence[Part], seed: int) -> DescribedSource:
    """Build the test images alone, at their native resolution."""
    return _held_out_source(data, parts, seed, "test")


def _train_source(
    data: Mapping[str, Any],
    parts: Sequence[Part],
    seed: int,
    backgrounds: Backgrounds,
    input_size: tuple[int, int],
) -> DescribedSource:
    """Mix real frames, their synthetic companions and renders."""
    real, synthetic = None, None
    if data["root"] is not None and data["real_fraction"] > 0:
        real = _real_source(data, parts, seed, "train")
        real = CachedSource(real, input_size) if _cached(data) else real
    elif data["real_fraction"] > 0:
        if data["real_fraction"] == 1:
            raise UserError(
                f"data={data['name']} without data.root",
                "a YCB-Video folder: only real frames were asked for",
                "set data.root, or train on renders with data=virtual",
            )
        _log.warning(
            "no real images were given (data.root is not set): the real share is 0, "
            "training on renders of %s",
            ", ".join(part.name for part in parts),
        )
    if data["root"] is not None and data["synthetic_fraction"] > 0 and data["real_fraction"] < 1:
        synthetic = _synthetic_source(data, parts, seed, backgrounds)
    virtual = None if data["real_fraction"] == 1 else _virtual_train(data, parts, seed, input_size)
    return HybridSource(
        real,
        virtual,
        data["real_fraction"] if real is not None else 0.0,
        data["samples_per_epoch"],
        seed,
        synthetic,
        data["synthetic_fraction"],
        name=data["name"],
    )


def _synthetic_source(
    data: Mapping[str, Any], parts: Sequence[Part], seed: int, backgrounds: Backgrounds
) -> DescribedSource | None:
    """Open the data set's own synthetic frames where its training list names any."""
    root, image_set = Path(data["root"]), data["image_sets"]["train"]
    if not read_image_set(root, image_set, "synthetic"):
        return None
    return YcbVideoSource(
        root, parts, image_set, "synthetic", backgrounds=backgrounds, seed=seed, read_depth=False
    )


def _virtual_train(
    data: Mapping[str, Any], parts: Sequence[Part], seed: int, input_size: tuple[int, int]
) -> DescribedSource:
    """Render at the size the network sees, which costs a fraction of the native one."""
    preset = _preset(data)
    box = Letterbox.fit((preset.width, preset.height), input_size)
    factory = Factory(parts, preset.resized(box.width, box.height), seed, _backgrounds(data))
    source = RenderedSource(factory, data["samples_per_epoch"])
    return CachedSource(source, input_size) if _cached(data) else source


def _cached(data: Mapping[str, Any]) -> bool:
    if data["cache"] not in CACHES:
        raise UserError(f"data.cache={data['cache']}", " or ".join(CACHES), "choose one of them")
    return bool(data["cache"] == "memory")


def _real_source(
    data: Mapping[str, Any], parts: Sequence[Part], seed: int, split: Split
) -> DescribedSource:
    """Open an image set of real frames, or the listed frames, the same for every split."""
    chosen = (
        {"image_set": data["image_sets"][split]}
        if data["frames"] is None
        else {"frames": data["frames"]}
    )
    return YcbVideoSource(
        Path(data["root"]), parts, seed=seed, read_depth=split == "test", **chosen
    )


def _held_out_source(
    data: Mapping[str, Any], parts: Sequence[Part], seed: int, split: Split
) -> DescribedSource:
    """Open a real image set where there is a root, else a range of renders that no other uses."""
    if data["root"] is not None:
        return _real_source(data, parts, seed, split)
    factory = Factory(parts, _preset(data), seed, _backgrounds(data))
    return RenderedSource(factory, data[f"num_{split}"], split)


def _preset(data: Mapping[str, Any]) -> Preset:
    name = data["preset"] or ("paper" if data["root"] is None else "ycb")
    return customised_preset(name, data["scene"])


def _backgrounds(data: Mapping[str, Any]) -> Backgrounds:
    folder = data["backgrounds"]
    return ProceduralBackgrounds() if folder is None else PhotoBackgrounds(Path(folder))


def _check_options(data: Mapping[str, Any]) -> None:
    """Refuse lists and numbers of the wrong kind before anything is read or rendered."""
    for name in ("objects", "parts", "frames"):
        value = data[name]
        if value is not None and not isinstance(value, list):
            raise UserError(
                f"data.{name}={value}", "a list, also of a single one", f"data.{name}=[{value}]"
            )
    for name in ("samples_per_epoch", "num_val", "num_test", "batch_size"):
        check_integer(f"data.{name}", data[name], 1, MAX_ITEMS)
    for name in ("real_fraction", "synthetic_fraction"):
        check_number(f"data.{name}", data[name], 0, 1)
    if data["num_workers"] is not None:
        check_integer("data.num_workers", data["num_workers"], 0, MAX_WORKERS)
    size = data["input_size"]
    sides = size if isinstance(size, list) and len(size) == 2 else [0]
    if not all(type(side) is int and side >= 32 and side % 32 == 0 for side in sides):
        raise UserError(
            f"data.input_size={size}",
            "[width, height], each a multiple of 32",
            "round up; images are letterboxed into it",
        )
