"""Read the fields of one NDDS object, each by itself; what is wrong with one is a defect."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dopepp.data.checking.ndds_cuboid import is_box
from dopepp.data.checking.report import CheckReport
from dopepp.data.checking.values import mapping, numbers
from dopepp.geometry.rotation import quaternion_to_matrix

NORM_TOLERANCE: Final = 0.01
"""Of a quaternion's norm from 1: FAT rounds to four digits."""


class ObjectFields:
    """The fields of an object, each None where it is missing or damaged.

    Attributes:
        location: ``location``, in the file's unit and camera frame.
        rotations: The rotation by either order of ``quaternion_xyzw``.
        cuboid: The corners, in the file's unit and camera frame.
        centroid: ``cuboid_centroid``.
        projected: ``projected_cuboid``, eight corners, pixels.
        projected_centroid: ``projected_cuboid_centroid``.
        bounding_box: ``top_left`` and ``bottom_right``.
        transforms: ``pose_transform`` and FAT's ``pose_transform_permuted`` by name.
        visibility: In [0, 1], or −1 for unknown.
    """

    def __init__(
        self, report: CheckReport, path: Path, field: str, item: Mapping[str, Any]
    ) -> None:
        self._report, self._path, self._field, self._item = report, path, field, item
        self.location = self._numbers("location", 3, required=True)
        self.rotations = self._rotations()
        self.cuboid = self._corners("cuboid", 3)
        if self.cuboid is not None and not is_box(self.cuboid):
            self.add("cuboid", "no box in NDDS order: edges not parallel, equal or perpendicular")
            self.cuboid = None
        self.centroid = self._numbers("cuboid_centroid", 3)
        self.projected = self._corners("projected_cuboid", 2)
        self.projected_centroid = self._numbers("projected_cuboid_centroid", 2)
        self.bounding_box = self._bounding_box()
        names = ("pose_transform", "pose_transform_permuted")
        matrices = {name: self._numbers(name, 4, 4) for name in names}
        self.transforms = {name: matrix for name, matrix in matrices.items() if matrix is not None}
        self.visibility = self._visibility()

    def add(self, field: str, message: str) -> None:
        """Add a defect of a field."""
        self._report.add(self._path, self.place(field), message)

    def place(self, field: str) -> str:
        """Return where a field stands in the file."""
        return f"{self._field}.{field}"

    @property
    def is_hidden(self) -> bool:
        """Whether the file itself says that nobody sees the object, or does not know."""
        return self.visibility is not None and self.visibility <= 0

    def _numbers(
        self, field: str, *shape: int, required: bool = False
    ) -> NDArray[np.float64] | None:
        value = self._item.get(field)
        if value is None and not required:
            return None
        return numbers(self._report, self._path, self.place(field), value, *shape)

    def _corners(self, field: str, axes: int) -> NDArray[np.float64] | None:
        """Return eight points; some writers append the centroid as a ninth."""
        value = self._item.get(field)
        count = 9 if isinstance(value, list) and len(value) == 9 else 8
        points = self._numbers(field, count, axes)
        return None if points is None else points[:8]

    def _rotations(self) -> dict[str, NDArray[np.float64]] | None:
        stored = self._numbers("quaternion_xyzw", 4, required=True)
        if stored is None:
            return None
        norm = float(np.linalg.norm(stored))
        if abs(norm - 1) > NORM_TOLERANCE:
            message = f"no rotation: norm {norm:.4g}; allowed: 1 ± {NORM_TOLERANCE}"
            self.add("quaternion_xyzw", message)
            return None
        return {
            "x, y, z, w": quaternion_to_matrix(np.roll(stored, 1)),
            "w, x, y, z": quaternion_to_matrix(stored),
        }

    def _bounding_box(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        stated = mapping(self._item.get("bounding_box"))
        if not stated:
            return None
        first, last = (
            numbers(
                self._report, self._path, self.place(f"bounding_box.{name}"), stated.get(name), 2
            )
            for name in ("top_left", "bottom_right")
        )
        if first is None or last is None:
            return None
        if (first > last).any():
            self.add("bounding_box", f"top_left {first.tolist()}, bottom_right {last.tolist()}")
            return None
        return first, last

    def _visibility(self) -> float | None:
        value = self._numbers("visibility", 1)
        if value is None:
            return None
        if not (0 <= value[0] <= 1 or value[0] == -1):
            self.add("visibility", f"{value[0]:g}; allowed: 0 … 1, or −1 for unknown")
            return None
        return float(value[0])
