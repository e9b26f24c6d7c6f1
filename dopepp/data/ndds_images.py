"""The depth and segmentation images of an NDDS item, as far as their values are known."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Integer
from numpy.typing import NDArray

from dopepp.data.ndds_fields import bad, objects_of, stated
from dopepp.data.ndds_files import Settings, companion
from dopepp.drawing.pictures import read_image

DEPTH_UNIT: Final = 0.0001
"""Metres per value of a 16-bit ``.depth.png``: FAT's unit, and what we write; 0 is unknown."""


def read_depth(
    record: Mapping[str, Any], annotation: Path, shape: tuple[int, int]
) -> Float[np.ndarray, "height width"] | None:
    """Read depth in metres along z, or None where there is none or its unit is not known.

    The unit is known where the annotation states it, or from FAT's naming.

    Raises:
        UserError: The image is damaged, or of another size than ``shape`` (height, width).
    """
    unit = stated(record, "depth_unit_m")
    if unit is None and annotation.name.endswith((".left.json", ".right.json")):
        unit = DEPTH_UNIT
    path = companion(annotation, ".depth.png")
    if not isinstance(unit, (int, float)) or not 0 < unit <= 1 or not path.is_file():
        return None
    return read_map(path, shape).astype(np.float32) * np.float32(unit)


class Masks:
    """The masks of one image; ``STEM.seg.png`` is read when the first one is asked for.

    Args:
        record: The annotation.
        annotation: Its path.
        settings: The data set's settings.
        shape: (height, width) of the image.
    """

    def __init__(
        self,
        record: Mapping[str, Any],
        annotation: Path,
        settings: Settings,
        shape: tuple[int, int],
    ) -> None:
        self._shape, self._annotation, self._settings = shape, annotation, settings
        self._labels: NDArray[Any] | None = None
        self._has_own_ids = stated(record, "segmentation") == "segmentation_id"
        listed = objects_of(record, annotation)
        ids = [item.get("segmentation_id") for _, item, _ in listed]
        self._ids = Counter(value for value in ids if isinstance(value, int))
        self._class_ids = Counter(settings.class_id(annotation, name) for _, _, name in listed)

    def of(
        self, segmentation_id: int | None, label: str
    ) -> Bool[np.ndarray, "height width"] | None:
        """Return an instance's mask, or None where its pixels' value is unknown or not only its.

        Args:
            segmentation_id: The object's own value, if it has one.
            label: Its class.
        """
        class_id = None
        if not self._has_own_ids:
            class_id = self._settings.class_id(self._annotation, label)
        if segmentation_id is not None and self._ids[segmentation_id] == 1:
            value = segmentation_id
        elif segmentation_id is None and class_id is not None and self._class_ids[class_id] == 1:
            value = class_id
        else:
            return None
        path = companion(self._annotation, ".seg.png")
        if self._labels is None and path.is_file():
            image = read_image(path)
            # Colours stand for objects in a way that no file states.
            self._labels = read_map(path, self._shape) if image.ndim == 2 else None
        return None if self._labels is None else np.asarray(self._labels == value)


def read_map(path: Path, shape: tuple[int, int]) -> Integer[np.ndarray, "height width"]:
    """Read an image with one channel.

    Raises:
        UserError: It is damaged, has several channels or another (height, width).
    """
    image = read_image(path)
    if image.shape != shape:
        got = "×".join(map(str, image.shape))
        raise bad(path, "size", got, f"one channel of {shape[0]}×{shape[1]} (height×width)")
    return image
