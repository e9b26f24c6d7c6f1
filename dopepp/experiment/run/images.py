"""Which images a run has learnt from and was measured on, so that it shows when they are others.

The data's configuration may stay as it is while files, meshes or the rendering code change. So a
checkpoint holds, of every split, what its sources say of themselves and how its first image looks:
its labels and a picture of 16 × 12 pixels, which another machine's rounding does not change.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any, Final

import cv2
import numpy as np

from dopepp.core.errors import UserError
from dopepp.data.sample import DescribedSource, Sample
from dopepp.experiment.assembly.sources import held_out_source
from dopepp.experiment.config.data import DataConfig, chosen_data, trained_on
from dopepp.experiment.config.run import flat
from dopepp.geometry.camera import Letterbox
from dopepp.models.checkpoint import Checkpoint
from dopepp.parts.part import Parts

_log = logging.getLogger(__name__)

_LOOK_SIZE: Final = (16, 12)
_MAX_LEVELS: Final = 2.0
"""Mean difference of two small pictures, in grey levels, above which they show something else."""
_MAX_LABEL: Final = 1e-4
"""Difference of two camera matrices (relative) or poses (metres) above which they are others."""
_LONG: Final = 40
"""Values with more characters are not shown."""


def describe_images(source: DescribedSource) -> dict[str, Any]:
    """Describe a split's images in plain values."""
    sources = {
        f"{number} {info.name}": {"images": info.num_images, **info.identity}
        for number, info in enumerate(source.describe())
    }
    return {"sources": sources, "first_image": _look(source.sample(0, 0))}


def differing_images(stored: Mapping[str, Any], present: Mapping[str, Any]) -> list[str]:
    """Say in which points two descriptions of images differ; nothing where they do not."""
    old, new = dict(flat(stored["sources"])), dict(flat(present["sources"]))
    lines = [
        f"{key}: {_shown(old.get(key))} → {_shown(new.get(key))}"
        for key in {**old, **new}
        if old.get(key) != new.get(key)
    ]
    one, other = stored["first_image"], present["first_image"]
    if one["labels"] != other["labels"] or not all(
        np.allclose(one[name], other[name], rtol=_MAX_LABEL, atol=_MAX_LABEL)
        for name in ("K", "T_cam_obj")
    ):
        lines.append("labels of the first image")
    if _picture_difference(one, other) > _MAX_LEVELS:
        lines.append("pixels of the first image")
    return lines


def _look(sample: Sample) -> dict[str, Any]:
    box = Letterbox.fit(sample.size, _LOOK_SIZE)
    small = cv2.resize(sample.image, (box.width, box.height), interpolation=cv2.INTER_AREA)
    return {
        "K": sample.K.tolist(),
        "labels": [one.label for one in sample.instances],
        "T_cam_obj": [one.T_cam_obj.tolist() for one in sample.instances],
        "size": [box.width, box.height],
        "pixels": np.asarray(small, np.uint8).tobytes().hex(),
    }


def _picture_difference(one: Mapping[str, Any], other: Mapping[str, Any]) -> float:
    """Return the mean absolute difference, grey levels; infinite for other sizes."""
    if one["size"] != other["size"]:
        return np.inf
    pictures = (
        np.frombuffer(bytes.fromhex(look["pixels"]), np.uint8).astype(float)
        for look in (one, other)
    )
    return float(np.abs(np.subtract(*pictures)).mean())


def _shown(value: object) -> str:
    text = str(value)
    return text if len(text) <= _LONG else f"{text[:_LONG]}…"


def warn_of_other_images(checkpoint: Checkpoint, data: DataConfig, parts: Parts) -> None:
    """Warn of test images that changed under the checkpoint's own options, and of other shapes.

    ``parts`` are the checkpoint's objects as these data have them. A test set of other options is
    what its user wants.
    """
    pairs = zip(checkpoint.parts, parts, strict=True)
    others = [a.name for a, b in pairs if a.mesh_hash and b.mesh_hash not in ("", a.mesh_hash)]
    if others:
        _log.warning("the checkpoint was trained on another shape of %s", ", ".join(others))
    stored, config = checkpoint.data.get("images"), trained_on(checkpoint.data)
    if not isinstance(stored, dict) or config is None:
        return  # a checkpoint that train.py has not written
    try:
        own = chosen_data(None, None, config, "the checkpoint")
    except UserError:
        return  # nor does one whose data nobody can read
    if _test_set(own) != _test_set(data):
        return
    found = differing_images(stored["test"], describe_images(held_out_source(data, parts, "test")))
    if found:
        _log.warning(
            "the test images are not those of the checkpoint's own figures, "
            "though their configuration is the same: %s",
            "; ".join(found),
        )


def _test_set(data: DataConfig) -> list[object]:
    """Return the options that name a test set; the others cannot mean another one."""
    named = (data.format, data.root, data.objects, data.parts, data.unit, data.frames, data.virtual)
    return [*named, data.image_sets, data.num_test, data.eval_seed, data.test.renderer,
            data.targets, data.classes or {}]  # fmt: skip
