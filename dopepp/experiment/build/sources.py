"""From the ``data`` config to the DataModule: which images go into which split."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from dopepp.core.checks import check_integer
from dopepp.core.errors import UserError
from dopepp.core.machine import available_cores
from dopepp.data.datamodule import PoseDataModule
from dopepp.data.sample import DescribedSource
from dopepp.data.sources.hybrid import HybridSource
from dopepp.data.sources.rendered import Split
from dopepp.experiment.build.registries import AUGMENTATIONS, MASKINGS, build_optional
from dopepp.experiment.build.splits import (
    choose_backgrounds,
    held_out_renders,
    kept,
    labelled_images,
    synthetic_companions,
    training_renders,
)
from dopepp.experiment.config.chosen_data import are_renders
from dopepp.parts.part import Part
from dopepp.virtual.backgrounds import Backgrounds

_log = logging.getLogger(__name__)


def build_datamodule(data: Mapping[str, Any], parts: Sequence[Part], seed: int) -> PoseDataModule:
    """Build training, validation and test data and say in one line where real frames are missing.

    Raises:
        UserError: An option or a file is wrong.
    """
    backgrounds = choose_backgrounds(data)
    input_size = (data["input_size"][0], data["input_size"][1])
    workers = data["num_workers"]

    return PoseDataModule(
        train=_train_source(data, parts, seed, backgrounds),
        val=_held_out_source(data, parts, held_out_seed(data), "val"),
        test=_held_out_source(data, parts, held_out_seed(data), "test"),
        object_names=[part.name for part in parts],
        input_size=input_size,
        batch_size=data["batch_size"],
        num_workers=available_cores() if workers is None else workers,
        seed=seed,
        masking=build_optional(MASKINGS, data["masking"]),
        augment=build_optional(AUGMENTATIONS, data["augment"]),
        backgrounds=backgrounds,
    )


def held_out_seed(data: Mapping[str, Any]) -> int:
    """Return the seed of validation and test images, which is not that of the training.

    Raises:
        UserError: It is no seed.
    """
    return check_integer("data.eval_seed", data["eval_seed"], 0, 2**32 - 1)


def build_test_source(data: Mapping[str, Any], parts: Sequence[Part], seed: int) -> DescribedSource:
    """Build the test images alone, at their native resolution."""
    return _held_out_source(data, parts, seed, "test")


def build_scaled_test_source(
    data: Mapping[str, Any], parts: Sequence[Part], seed: int, scale: float
) -> DescribedSource:
    """Build the scenes of the test images with a camera so many times as near.

    Raises:
        UserError: They are no renders.
    """
    if not are_renders(data):
        raise UserError(
            f"scale={scale:g} on the images in data.root={data['root']}",
            "renders, whose camera can be moved",
            "leave out scale, or test on renders of these objects with data.test.renderer=raster",
        )
    return held_out_renders(data, parts, seed, "test", scale)


def build_validation_source(
    data: Mapping[str, Any], parts: Sequence[Part], seed: int
) -> DescribedSource:
    """Build the validation images alone, at their native resolution."""
    return _held_out_source(data, parts, seed, "val")


def build_source_without_objects(
    data: Mapping[str, Any], parts: Sequence[Part], seed: int, split: Split, num_images: int
) -> DescribedSource:
    """Render what the network must be silent on: backgrounds, distractors and look-alike parts.

    They are the scenes of the validation or the test range, without the objects.
    """
    scene = {**(data["virtual"]["scene"] or {}), "targets_per_image": [0, 0]}
    empty = {**data, "virtual": {**data["virtual"], "scene": scene}, f"num_{split}": num_images}
    return held_out_renders(empty, parts, seed, split)


def _train_source(
    data: Mapping[str, Any],
    parts: Sequence[Part],
    seed: int,
    backgrounds: Backgrounds,
) -> DescribedSource:
    """Mix real frames, their synthetic companions and renders."""
    real, synthetic = None, None
    if data["root"] is not None and data["real_fraction"] > 0:
        size = (data["input_size"][0], data["input_size"][1])
        real = kept(labelled_images(data, parts, seed, "train"), data, data["cache"], size)
    elif data["real_fraction"] > 0:
        if data["real_fraction"] == 1:
            raise UserError(
                f"data={data['name']} without data.root",
                f"a folder of {data['format']}: only labelled images were asked for",
                "set data.root, or train on renders with data=virtual",
            )
        _log.warning(
            "no real images were given (data.root is not set): the real share is 0, "
            "training on renders of %s",
            ", ".join(part.name for part in parts),
        )
    if data["root"] is not None and data["synthetic_fraction"] > 0 and data["real_fraction"] < 1:
        synthetic = synthetic_companions(data, parts, seed, backgrounds)
    virtual = None if data["real_fraction"] == 1 else training_renders(data, parts, seed)
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


def _held_out_source(
    data: Mapping[str, Any], parts: Sequence[Part], seed: int, split: Split
) -> DescribedSource:
    """Open labelled images where there is a root, else a range of renders that no other uses.

    Another renderer for the test means renders, of the same objects, also with a root.
    """
    asked_for_renders = split == "test" and data["test"]["renderer"] is not None
    if data["root"] is not None and not asked_for_renders:
        return labelled_images(data, parts, seed, split)
    return held_out_renders(data, parts, seed, split)
