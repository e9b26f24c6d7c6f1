"""From the ``data`` config to the objects to learn, and to the DataModule: what a split shows."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from dopepp.core.errors import UserError
from dopepp.core.futures import available_cores
from dopepp.data.datamodule import PoseDataModule
from dopepp.data.formats.bop.models import bop_parts
from dopepp.data.formats.ycb_video.frame import read_classes
from dopepp.data.part_symmetries import choose_symmetries
from dopepp.data.sample import DescribedSource
from dopepp.data.sources.hybrid import HybridSource
from dopepp.data.sources.rendered import Split
from dopepp.experiment.build import splits
from dopepp.experiment.build.registries import AUGMENTATIONS, MASKINGS, build_optional
from dopepp.experiment.config.data import DataConfig
from dopepp.parts.catalogue import load_part
from dopepp.parts.mesh.read import ycb_part
from dopepp.parts.part import Part, Parts
from dopepp.virtual.backgrounds import Backgrounds, find_backgrounds

_log = logging.getLogger(__name__)

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
        val=build_validation_source(data, parts),
        test=build_test_source(data, parts),
        object_names=[part.name for part in parts],
        input_size=data.input_size,
        batch_size=data.batch_size,
        num_workers=available_cores() if data.num_workers is None else data.num_workers,
        seed=seed,
        masking=build_optional(MASKINGS, data.masking),
        augment=build_optional(AUGMENTATIONS, data.augment),
        backgrounds=backgrounds,
    )


def build_test_source(data: DataConfig, parts: Parts) -> DescribedSource:
    """Build the test images alone, at their native resolution."""
    return _held_out_source(data, parts, "test")


def build_validation_source(data: DataConfig, parts: Parts) -> DescribedSource:
    """Build the validation images alone, at their native resolution."""
    return _held_out_source(data, parts, "val")


def build_scaled_test_source(data: DataConfig, parts: Parts, scale: float) -> DescribedSource:
    """Build the test scenes, which must be renders, with a camera so many times as near."""
    if not data.is_rendered("test"):
        raise UserError(
            f"scale={scale:g} on the images in data.root={data.root}",
            "renders, whose camera can be moved",
            "leave out scale, or test on renders of these objects with data.test.renderer=raster",
        )
    return splits.held_out_renders(data, parts, "test", scale)


def build_source_without_objects(
    data: DataConfig, parts: Parts, split: Split, num_images: int
) -> DescribedSource:
    """Render what the network must be silent on: backgrounds, distractors and look-alike parts.

    They are the scenes of the validation or the test range, without the objects.
    """
    scene = {**(data.virtual.scene or {}), "targets_per_image": [0, 0]}
    virtual = replace(data.virtual, scene=scene)
    empty = replace(data, virtual=virtual, num_val=num_images, num_test=num_images)
    return splits.held_out_renders(empty, parts, split)


def _train_source(
    data: DataConfig, parts: Parts, seed: int, backgrounds: Backgrounds
) -> DescribedSource:
    """Mix real frames, their synthetic companions and renders."""
    real, synthetic = None, None
    if data.root is not None and data.real_fraction > 0:
        real = splits.kept(
            splits.labelled_images(data, parts, seed, "train"), data, data.cache, data.input_size
        )
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
        synthetic = splits.synthetic_companions(data, parts, seed, backgrounds)
    virtual = None if data.real_fraction == 1 else splits.training_renders(data, parts, seed)
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


def _held_out_source(data: DataConfig, parts: Parts, split: Split) -> DescribedSource:
    """Open labelled images where there is a root, else a range of renders that no other uses."""
    if data.is_rendered(split):
        return splits.held_out_renders(data, parts, split)
    return splits.labelled_images(data, parts, data.eval_seed, split)
