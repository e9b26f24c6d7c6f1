"""What the images of a run are, so that it shows later when they are others.

The data configuration may stay as it is while files, meshes or the rendering code change. So a
checkpoint holds, of every split, what its sources say of themselves and how its first image looks:
its labels and a picture of 16 × 12 pixels, which another machine's rounding does not change.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import UInt8

from dopepp.data.sample import DescribedSource, Sample
from dopepp.experiment.options import flat
from dopepp.geometry.camera import Letterbox

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
    old, new = (dict(flat(one["sources"])) for one in (stored, present))
    lines = [
        f"{key}: {_shown(old.get(key))} → {_shown(new.get(key))}"
        for key in {**old, **new}
        if old.get(key) != new.get(key)
    ]
    if not _same_labels(stored["first_image"], present["first_image"]):
        lines.append("labels of the first image")
    if _picture_difference(stored["first_image"], present["first_image"]) > _MAX_LEVELS:
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


def _same_labels(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    if one["labels"] != other["labels"]:
        return False
    return all(
        np.allclose(one[name], other[name], rtol=_MAX_LABEL, atol=_MAX_LABEL)
        for name in ("K", "T_cam_obj")
    )


def _picture_difference(one: Mapping[str, Any], other: Mapping[str, Any]) -> float:
    """Return the mean absolute difference, grey levels; infinite for other sizes."""
    if one["size"] != other["size"]:
        return np.inf
    pictures = (_pixels(look["pixels"]).astype(float) for look in (one, other))
    return float(np.abs(np.subtract(*pictures)).mean())


def _pixels(text: str) -> UInt8[np.ndarray, "n"]:
    return np.frombuffer(bytes.fromhex(text), np.uint8)


def _shown(value: object) -> str:
    text = str(value)
    return text if len(text) <= _LONG else f"{text[:_LONG]}…"
