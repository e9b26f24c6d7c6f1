"""Describe the images of a split for the checkpoint, and compare two descriptions.

Files, meshes or the rendering code may change while the options stay the same. Therefore a
checkpoint describes the sources and the first image of every split: its labels and an image of
16 × 12 pixels, which is robust against rounding on other machines.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import cv2
import numpy as np

from dopepp.data.sample import DescribedSource, Sample
from dopepp.experiment.config.run_config import flatten
from dopepp.geometry.camera import Letterbox

_THUMBNAIL_SIZE: Final = (16, 12)
_MAX_LEVELS: Final = 2.0  # smallest mean difference of two thumbnails, grey levels
_MAX_LABEL: Final = 1e-4  # smallest change of camera matrices (relative) or poses (metres)
_LONG: Final = 40  # maximum number of characters of a shown value


def describe_images(source: DescribedSource) -> dict[str, Any]:
    """Return the sources of a split, and the labels and a thumbnail of its first image, as JSON."""
    sources = {
        f"{number} {info.name}": {"images": info.num_images, **info.identity}
        for number, info in enumerate(source.describe())
    }
    return {"sources": sources, "first_image": _thumbnail(source.sample(0, 0))}


def differing_images(stored: Mapping[str, Any], present: Mapping[str, Any]) -> list[str]:
    """Return descriptions of the differences between two results of :func:`describe_images`.

    Presets are compared by the first image only, because a new version may add fields to a preset.
    """
    old, new = dict(flatten(stored["sources"])), dict(flatten(present["sources"]))
    presets = {f"{source}.preset" for source in present["sources"]}
    lines = [
        f"{key}: {_shown(old.get(key))} → {_shown(new.get(key))}"
        for key in {**old, **new}
        if old.get(key) != new.get(key) and key not in presets
    ]
    before, now = stored["first_image"], present["first_image"]
    if before["labels"] != now["labels"] or not all(
        np.allclose(before[name], now[name], rtol=_MAX_LABEL, atol=_MAX_LABEL)
        for name in ("K", "T_cam_obj")
    ):
        lines.append("labels of the first image")
    if _image_difference(before, now) > _MAX_LEVELS:
        lines.append("pixels of the first image")
    return lines


def _thumbnail(sample: Sample) -> dict[str, Any]:
    """Return a copy of up to 16×12 pixels of a sample's image, and its ground truth, as JSON."""
    box = Letterbox.fit(sample.size, _THUMBNAIL_SIZE)
    small = cv2.resize(sample.image, (box.width, box.height), interpolation=cv2.INTER_AREA)
    return {
        "K": sample.K.tolist(),
        "labels": [instance.label for instance in sample.instances],
        "T_cam_obj": [instance.T_cam_obj.tolist() for instance in sample.instances],
        "size": [box.width, box.height],
        "pixels": np.asarray(small, np.uint8).tobytes().hex(),
    }


def _image_difference(stored: Mapping[str, Any], present: Mapping[str, Any]) -> float:
    """Return the mean grey-level difference of two thumbnails; infinite for different sizes."""
    if stored["size"] != present["size"]:
        return np.inf
    images = (
        np.frombuffer(bytes.fromhex(record["pixels"]), np.uint8).astype(float)
        for record in (stored, present)
    )
    return float(np.abs(np.subtract(*images)).mean())


def _shown(value: object) -> str:
    text = str(value)
    return text if len(text) <= _LONG else f"{text[:_LONG]}…"
