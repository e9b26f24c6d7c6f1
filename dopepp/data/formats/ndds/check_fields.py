"""Read the fields of one NDDS object, each by itself; what is wrong with one is a defect.

The eight corners of an NDDS cuboid as a box: its edges, its axes, its size.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from dopepp.data.formats.problems import CheckReport, mapping, numbers
from dopepp.geometry.rotation import quaternion_to_matrix, rotation_angle

EDGE_SHARE: Final = 0.02
"""Of the longest edge: by how much edges may be unequal, slanted, or thin to have no direction."""

SIZE_SHARE: Final = 0.05
"""By how much edges may differ from the class's ``cuboid_dimensions``."""

_EDGES: Final = np.array(
    [
        [(1, 0), (2, 3), (5, 4), (6, 7)],
        [(0, 3), (1, 2), (4, 7), (5, 6)],
        [(4, 0), (5, 1), (6, 2), (7, 3)],
    ]
)
"""Corner pairs of the edges along x, y and z, from the negative to the positive end."""


def is_box(corners: Float[np.ndarray, "8 3"]) -> bool:
    """Tell whether eight points are the corners of a box in NDDS order."""
    edges = corners[_EDGES[..., 1]] - corners[_EDGES[..., 0]]
    means = edges.mean(axis=1)
    lengths = np.linalg.norm(means, axis=1)
    if np.abs(edges - means[:, None]).max() > EDGE_SHARE * lengths.max():
        return False
    axes = box_axes(corners)
    return axes is None or bool(np.abs(axes.T @ axes - np.eye(3)).max() <= EDGE_SHARE)


def box_axes(corners: Float[np.ndarray, "8 3"]) -> Float[np.ndarray, "3 3"] | None:
    """Return the directions of a box's edges as columns; None for one that is flat."""
    means = (corners[_EDGES[..., 1]] - corners[_EDGES[..., 0]]).mean(axis=1)
    lengths = np.linalg.norm(means, axis=1)
    if lengths.min() <= EDGE_SHARE * lengths.max():
        return None
    return np.asarray((means / lengths[:, None]).T)


def size_problem(
    corners: Float[np.ndarray, "8 3"], sides: Float[np.ndarray, "3"]
) -> tuple[str, str] | None:
    """Say as (kind, message) how a box differs from its class's sides, None where it does not."""
    edges = np.linalg.norm(corners[_EDGES[:, 0, 1]] - corners[_EDGES[:, 0, 0]], axis=1)
    if np.abs(edges - sides).max() <= SIZE_SHARE * sides.max():
        return None
    power = np.log10(max(edges.max(), 1e-12) / sides.max())
    in_another_unit = abs(round(power)) >= 1 and abs(power - round(power)) < SIZE_SHARE
    message = f"edges {text(edges)}; its class has cuboid_dimensions {text(sides)}"
    return ("unit" if in_another_unit else "size"), message


def quarter_turn_distance(rotation: Float[np.ndarray, "3 3"]) -> float:
    """Return the angle to the nearest orthogonal matrix that maps axes onto axes, mirrored or not.

    Frames of one object differ by such matrices between tools.
    """
    nearest = np.where(np.abs(rotation) == np.abs(rotation).max(axis=0), np.sign(rotation), 0.0)
    if abs(np.linalg.det(nearest)) != 1:
        return np.inf
    return float(rotation_angle(nearest.T @ rotation))


def text(values: Float[np.ndarray, " n"]) -> str:
    """Return numbers with four digits."""
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"


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
