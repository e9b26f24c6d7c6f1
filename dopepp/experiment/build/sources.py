"""From the ``data`` config to the objects to learn, and to the DataModule: what a split shows.

A split's images are labelled ones in a format of the field, or renders. To add a format, write a
source and an entry in :data:`FORMATS`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from dopepp.core.errors import UserError
from dopepp.core.files import cache_folder
from dopepp.core.futures import available_cores
from dopepp.data.datamodule import PoseDataModule
from dopepp.data.formats.bop.models import bop_parts
from dopepp.data.formats.bop.source import BopSource
from dopepp.data.formats.ndds.source import NddsSource
from dopepp.data.formats.webdataset.source import WebdatasetSource
from dopepp.data.formats.ycb_video.frame import read_classes, read_image_set
from dopepp.data.formats.ycb_video.source import YcbVideoSource
from dopepp.data.part_symmetries import choose_symmetries
from dopepp.data.sample import DescribedSource
from dopepp.data.sources.hybrid import HybridSource
from dopepp.data.sources.rendered import CachedSource, RenderedSource, Split
from dopepp.data.sources.windowed import WindowedSource
from dopepp.drawing.pictures import Size
from dopepp.experiment.build.registries import AUGMENTATIONS, JITTERS, MASKINGS, build_optional
from dopepp.experiment.config.data import Cache, DataConfig, chosen_data, trained_on
from dopepp.geometry.camera import Letterbox
from dopepp.models.checkpoint.schema import Checkpoint
from dopepp.parts.catalogue import load_part, with_meshes
from dopepp.parts.mesh.read import ycb_part
from dopepp.parts.part import Part, Parts
from dopepp.virtual.backgrounds import Backgrounds, find_backgrounds
from dopepp.virtual.factory import Factory, code_hash
from dopepp.virtual.presets.preset import Preset, customised_preset

_log = logging.getLogger(__name__)

_TRAINING_SHARE: Final = 0.8
"""Of the images of a folder that training shares with validation or test."""

PAPER_OBJECTS: Final = (
    "003_cracker_box",
    "005_tomato_soup_can",
    "006_mustard_bottle",
    "009_gelatin_box",
    "010_potted_meat_can",
)
"""The YCB objects of the paper's tables."""


def build_parts(data: DataConfig) -> list[Part]:
    """Build the objects to learn: those of the labelled images in ``root``, else the listed parts.

    They have the symmetries that ``data.symmetries`` says. A :class:`UserError` tells what is wrong
    with root, objects or parts, or that real frames were asked for without a root.
    """
    return choose_symmetries(_read_parts(data), data.symmetries)


def _read_parts(data: DataConfig) -> list[Part]:
    if data.root is None:
        for option, value in (("objects", data.objects), ("frames", data.frames)):
            if value is not None:
                raise UserError(
                    f"data.{option}={list(value)} without data.root",
                    f"data.{option} names {option} of a data set; data.parts names meshes",
                    "set data.root, or use data.parts",
                )
    elif data.format == "ycb_video":
        return _ycb_parts(data.root, data.objects)
    elif data.format in ("bop", "webdataset"):
        return bop_parts(data.root, data.objects)
    return [load_part(name, data.unit) for name in data.parts]


def _ycb_parts(root: Path, objects: Sequence[str] | None) -> list[Part]:
    classes = read_classes(root)
    names = PAPER_OBJECTS if objects is None else objects
    unknown = [name for name in names if name not in classes]
    if unknown:
        fix = "choose from this list"
        raise UserError(f"data.objects with {unknown[0]!r}", ", ".join(classes), fix)
    return [ycb_part(root, name) for name in names]


def build_datamodule(data: DataConfig, parts: Parts, seed: int) -> PoseDataModule:
    """Build training, validation and test data and say in one line where real frames are missing.

    The seed is that of the training images; the others have ``data.eval_seed``. A
    :class:`UserError` tells which option or file is wrong.
    """
    backgrounds = find_backgrounds(data.virtual.backgrounds)
    return PoseDataModule(
        train=_train_source(data, parts, seed, backgrounds),
        val=_validation_source(data, parts),
        test=held_out_source(data, parts, "test"),
        object_names=[part.name for part in parts],
        input_size=data.network_input,
        batch_size=data.batch_size,
        num_workers=available_cores() if data.num_workers is None else data.num_workers,
        seed=seed,
        jitter=build_optional(JITTERS, data.jitter),
        masking=build_optional(MASKINGS, data.masking),
        augment=build_optional(AUGMENTATIONS, data.augment),
        backgrounds=backgrounds,
    )


def _validation_source(data: DataConfig, parts: Parts) -> DescribedSource:
    """Build the validation images as the network sees them while it trains.

    In a camera of its own, these are windows; all others who measure take the whole pictures.
    """
    source = held_out_source(data, parts, "val")
    if data.virtual.view is None or not isinstance(source, RenderedSource):
        return source
    factory = _factory(data, parts, seen_preset(data), data.eval_seed, data.virtual.renderer)
    return RenderedSource(factory, data.num_val, "val")


def held_out_source(data: DataConfig, parts: Parts, split: Split) -> DescribedSource:
    """Build the validation or the test images alone, at their native resolution.

    They are labelled ones where there is a root, else a range of renders that no other uses; so
    is validation where the labelled images show no object and all can be rendered, which the log
    says.
    """
    if data.is_rendered(split):
        return held_out_renders(data, parts, split)
    labelled = labelled_images(data, parts, data.eval_seed, split)
    seen = split == "test" or any(labelled.contains(part.name) for part in parts)
    if seen or any(part.mesh is None for part in parts):
        return labelled
    _log.warning(
        "%s shows none of %s: validation is on renders, as with data.image_sets.val=null",
        labelled.name, ", ".join(part.name for part in parts),
    )  # fmt: skip
    return held_out_renders(data, parts, split)


def build_scaled_test_source(data: DataConfig, parts: Parts, scale: float) -> DescribedSource:
    """Build the test scenes, which must be renders, with a camera so many times as near."""
    if not data.is_rendered("test"):
        raise UserError(
            f"scale={scale:g} on the images in data.root={data.root}",
            "renders, whose camera can be moved",
            "leave out scale, or test on renders of these objects with data.test.renderer=raster",
        )
    return held_out_renders(data, parts, "test", scale)


def build_source_without_objects(
    data: DataConfig, parts: Parts, split: Split, num_images: int
) -> DescribedSource:
    """Render a held-out range without the objects: what the network must be silent on."""
    scene = {**(data.virtual.scene or {}), "targets_per_image": [0, 0]}
    virtual = replace(data.virtual, scene=scene)
    empty = replace(data, virtual=virtual, num_val=num_images, num_test=num_images)
    return held_out_renders(empty, parts, split)


def _train_source(
    data: DataConfig, parts: Parts, seed: int, backgrounds: Backgrounds
) -> DescribedSource:
    """Mix real frames, their synthetic companions and renders."""
    real, synthetic = None, None
    if data.root is not None and data.real_fraction > 0:
        real = _real_frames(data, parts, seed)
    elif data.real_fraction > 0:
        if data.real_fraction == 1:
            raise UserError(
                f"data={data.name} without data.root",
                f"a folder of {data.format}: only labelled images were asked for",
                "set data.root, or train on renders with data=virtual",
            )
        _log.warning(
            "no real images were given (data.root is not set): the real share is 0, "
            "training on renders of %s",
            ", ".join(part.name for part in parts),
        )
    if data.root is not None and data.synthetic_fraction > 0 and data.real_fraction < 1:
        synthetic = synthetic_companions(data, parts, seed, backgrounds)
    virtual = None if data.real_fraction == 1 else training_renders(data, parts, seed)
    return HybridSource(
        real,
        virtual,
        data.real_fraction if real is not None else 0.0,
        data.samples_per_epoch,
        seed,
        synthetic,
        data.synthetic_fraction,
        name=data.name,
    )


def _real_frames(data: DataConfig, parts: Parts, seed: int) -> DescribedSource:
    """Open the labelled images as the network sees them: in a camera of its own, windows."""
    frames, view = labelled_images(data, parts, seed, "train"), data.virtual.view
    if view is None:
        return kept(frames, data, data.cache, data.network_input)
    box = Letterbox.scaled(view.size, data.virtual.camera_scale or 1.0)
    picture = box.width, box.height
    whole = kept(frames, data, data.cache, picture)
    return WindowedSource(whole, picture, data.network_input, seed)


def labelled_images(data: DataConfig, parts: Parts, seed: int, split: Split) -> DescribedSource:
    """Open a split's labelled images; a :class:`UserError` if ``data.root`` does not hold them."""
    assert data.root is not None
    if data.format not in FORMATS:
        formats = ", ".join(FORMATS)
        raise UserError(f"data.format={data.format}", formats, "choose the images' format")
    return FORMATS[data.format](data, data.root, parts, seed, split)


def synthetic_companions(
    data: DataConfig, parts: Parts, seed: int, backgrounds: Backgrounds
) -> DescribedSource | None:
    """Open YCB-Video's own synthetic frames where its training list names any."""
    if data.root is None or data.format != "ycb_video":
        return None
    image_set = data.image_sets["train"]
    if image_set is None or not read_image_set(data.root, image_set, "synthetic"):
        return None
    return YcbVideoSource(
        data.root, parts, image_set, "synthetic",
        backgrounds=backgrounds, seed=seed, read_depth=False,
    )  # fmt: skip


def share_of(image_sets: Mapping[str, str | None], split: Split) -> tuple[float, float]:
    """Return the range of its folder's images that a split takes, as fractions.

    A folder that several splits name is divided in order (training, validation, test): 80 % to
    training if it is among them, the rest equally.
    """
    sharing = [name for name in ("train", "val", "test") if image_sets[name] == image_sets[split]]
    first = _TRAINING_SHARE if sharing[0] == "train" and len(sharing) > 1 else 1 / len(sharing)
    borders = [0.0, first]
    for number in range(1, len(sharing)):
        borders.append(first + (1 - first) * number / (len(sharing) - 1))
    place = sharing.index(split)
    return borders[place], borders[place + 1]


Opener = Callable[[DataConfig, Path, Parts, int, Split], DescribedSource]
"""From data, root, parts, seed and split to the split's images."""

FORMATS: Final[dict[str, Opener]] = {
    # An image set of real frames, or the listed frames, the same for every split.
    "ycb_video": lambda data, root, parts, seed, split: YcbVideoSource(
        root, parts, data.image_set(split) if data.frames is None else None,
        frames=data.frames, seed=seed, read_depth=split == "test",
    ),
    "bop": lambda data, root, parts, seed, split: BopSource(
        root, parts, data.image_set(split), part_of=share_of(data.image_sets, split),
        targets=data.targets if split == "test" else None, read_depth=split == "test",
    ),
    "ndds": lambda data, root, parts, seed, split: NddsSource(
        root / data.image_set(split), parts, part_of=share_of(data.image_sets, split),
        classes=data.classes, read_depth=split == "test",
    ),
    "webdataset": lambda data, root, parts, seed, split: WebdatasetSource(
        root, parts, data.image_set(split), part_of=share_of(data.image_sets, split),
        download_dir=data.download_dir, read_depth=split == "test",
    ),
}  # fmt: skip
"""How the images of each format are opened."""


def training_renders(data: DataConfig, parts: Parts, seed: int) -> DescribedSource:
    """Render at the size the network sees, which costs a fraction of the native one."""
    factory = _factory(data, parts, seen_preset(data), seed, data.virtual.renderer)
    source = RenderedSource(factory, data.samples_per_epoch)
    return kept(source, data, data.cache, data.network_input)


def share_in_words(data: DataConfig) -> str | None:
    """Say it where the test is only a share of the images in its folder; None where it is all."""
    if data.is_rendered("test") or data.format == "ycb_video":
        return None
    first, last = share_of(data.image_sets, "test")
    if last - first == 1:
        return None
    folder = data.image_sets["test"]
    sharing = [name for name in ("train", "val") if data.image_sets[name] == folder]
    all_of_it = " ".join(f"data.image_sets.{name}=none" for name in sharing)
    return (
        f"measured is the last {last - first:.0%} of the images in {folder}, because "
        f"data.image_sets names it for {' and '.join(sharing)} as well: {all_of_it} measures all "
        "of it, training images included, and data.image_sets.test=FOLDER another one"
    )


def held_out_renders(
    data: DataConfig, parts: Parts, split: Split, scale: float = 1.0
) -> DescribedSource:
    """Render a range that no other split uses, at its native size, with parts of any scale."""
    renderer, count = data.virtual.renderer, data.num_val
    cache: Cache = "none"
    if split == "test":
        renderer, count, cache = data.test.renderer or renderer, data.num_test, data.test.cache
    factory = _factory(data, parts, choose_preset(data), data.eval_seed, renderer)
    name = "virtual" if renderer == "raster" else renderer
    return kept(RenderedSource(factory, count, split, name, scale), data, cache, None)


def validation_renders(
    checkpoint: Checkpoint, path: Path, count: int, size: Size | None = None
) -> DescribedSource:
    """Render a checkpoint's parts, by the meshes in it, as its validation images are rendered.

    The path is for messages. ``size`` is the pictures' (width, height), pixels, instead of their
    own; those of a camera that the checkpoint was trained for keep theirs.
    """
    data = replace(chosen_data({}, {}, trained_on(checkpoint.data), str(path)), num_val=count)
    if size is not None and data.virtual.view is None:
        scene = {**(data.virtual.scene or {}), "width": size[0], "height": size[1]}
        data = replace(data, virtual=replace(data.virtual, scene=scene))
    return held_out_renders(data, with_meshes(checkpoint.parts), "val")


def kept(
    source: DescribedSource, data: DataConfig, cache: Cache, input_size: tuple[int, int] | None
) -> DescribedSource:
    """Put the chosen cache around a source; a :class:`UserError` where there is no room."""
    if cache == "none":
        return source
    folder = None
    if cache == "disk":
        folder = cache_folder() / "renders" if data.cache_dir is None else Path(data.cache_dir)
    return CachedSource(source, input_size, folder, identity=code_hash())


def choose_preset(data: DataConfig) -> Preset:
    """Return the preset with the config's changes, at the size of a camera's whole pictures."""
    preset, view = _customised(data), data.virtual.view
    return preset if view is None else view.whole(preset, data.virtual.camera_scale or 1.0)


def seen_preset(data: DataConfig) -> Preset:
    """Return the same scenes as the network sees them: resized, or in windows of such pictures."""
    preset, view = _customised(data), data.virtual.view
    if view is not None:
        return view.window(preset, data.virtual.camera_scale or 1.0, data.network_input)
    box = Letterbox.fit((preset.width, preset.height), data.network_input)
    return preset.resized(box.width, box.height)


def _customised(data: DataConfig) -> Preset:
    name = data.virtual.preset or ("paper" if data.root is None else "ycb")
    return customised_preset(name, data.virtual.scene or {})


def _factory(data: DataConfig, parts: Parts, preset: Preset, seed: int, renderer: str) -> Factory:
    return Factory(
        parts,
        preset,
        seed,
        find_backgrounds(data.virtual.backgrounds),
        renderer=renderer,
        negatives=_negatives(data, parts),
    )


def _negatives(data: DataConfig, parts: Parts) -> list[Part]:
    """Return what is shown and not to be found: the listed parts, and a BOP root's other models."""
    listed = [load_part(name, data.unit) for name in data.virtual.negatives]
    if data.root is None or data.format != "bop" or data.objects is None:
        return listed
    known = {part.mesh_hash for part in (*parts, *listed)}
    return listed + [part for part in bop_parts(data.root) if part.mesh_hash not in known]
