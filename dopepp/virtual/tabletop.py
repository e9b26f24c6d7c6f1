"""Objects on a table: side by side on the plane, or lowered onto a heap.

The table frame has its origin on the plane and z upwards. A height map on a square grid holds the
placed objects. A new object is lowered until its underside meets the map in some cell. Objects keep
their orientation (without physics) and overlap by at most the height change within a cell.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32

from dopepp.drawing.pictures import Shape
from dopepp.geometry.camera import Transform, make_transform
from dopepp.geometry.rotation import RotationMatrix, rotation_vector_to_matrix
from dopepp.parts.mesh import Faces
from dopepp.virtual.arrangement import Composition
from dopepp.virtual.body import Body
from dopepp.virtual.presets.table import Table, plane_of
from dopepp.virtual.surface import Surface
from dopepp.virtual.triangles import CENTRE_SAMPLE, rasterise

Column = Float[np.ndarray, "vertices"]
Cell = tuple[int, int]  # x and y


def arrange_on_table(composition: Composition, table: Table, targets: Sequence[Body]) -> Transform:
    """Add targets and distractors on the table to a composition, and return the view T_cam_table.

    The plane is z = 0, and z points up. Views and resting poses are sampled from ``table``.
    """
    rng = composition.rng
    # Sample another view if no target fits into the image.
    for _ in range(8):
        composition.clear()
        scene = _TableScene(composition, table, targets)
        for body in targets:
            if not scene.place(body) and not composition.objects:
                break
        if composition.objects or not targets:
            break
    low, high = composition.preset.distractors.number
    for _ in range(int(rng.integers(low, high + 1))):
        scene.place(composition.draw_distractor(float(scene.T_cam_table[2, 3])))
    return scene.T_cam_table


@dataclass(frozen=True, eq=False)
class _RestingPose:
    """A resting pose, with the heights of its lowest point and its centre of mass, metres."""

    T_table_obj: Transform
    footprint: Footprint
    cell: Cell
    height: float
    centre: float


class _TableScene:
    """A view of the table, and the height map of the objects on it."""

    def __init__(self, composition: Composition, table: Table, targets: Sequence[Body]) -> None:
        self.composition, self.table, self.rng = composition, table, composition.rng
        self.T_cam_table = draw_view(table, composition)
        distance = float(self.T_cam_table[2, 3])
        diameter = max((2 * body.surface.radius for body in targets), default=0.3 * distance)
        self._radius = diameter * self.rng.uniform(*table.heap_radius)
        # A heap needs fine cells and little room; a free table needs room and allows coarse cells.
        reach = self._radius + 2 * diameter if table.heaped else 2 * distance
        # A cell is a hundredth of the largest target; at most 512 cells lie to either side.
        self._map = HeightMap(max(0.01 * diameter, reach / 512), reach)
        self._inverse_depth = plane_of(self.T_cam_table).inverse_depth_row(composition.K)

    def place(self, body: Body) -> bool:
        """Add a body in a sampled resting pose; return whether a pose was accepted."""
        material = self.composition.draw_material(body)
        for _ in range(6):  # random orientations, until the body fits
            for pose in self._candidates(body):
                T_cam_obj = self.T_cam_table @ pose.T_table_obj
                if self.composition.add(body, T_cam_obj, material):
                    self._map.put(pose.footprint, pose.cell, pose.height)
                    return True
        return False

    def _candidates(self, body: Body) -> Iterable[_RestingPose]:
        """Sample a body's resting poses; for a heap, the lowest centre of mass comes first."""
        if not self.table.heaped:
            return self._resting_poses(body)
        # Objects slide down: prefer the lowest pose of two orientations.
        several = [pose for _ in range(2) for pose in self._resting_poses(body)]
        return sorted(several, key=lambda pose: pose.centre)

    def _resting_poses(self, body: Body) -> Iterator[_RestingPose]:
        """Sample an orientation of a body, and yield resting poses at sampled points."""
        rotation, lowest = self.table.draw_turning(self.rng, body.hull)
        footprint = self._map.footprint(body.surface, rotation, lowest)
        if footprint is None:
            return
        side, (rows, columns) = self._map.cell, footprint.top.shape
        for _ in range(6):
            point = self._draw_point()
            if point is None:
                continue
            x, y = (round(value / side) for value in point)
            cell = x - footprint.corner[0] - columns // 2, y - footprint.corner[1] - rows // 2
            height = self._map.height(footprint, cell)
            if height is None or not (self.table.heaped or self._map.is_free(footprint, cell)):
                continue
            origin = np.array([cell[0] * side, cell[1] * side, height - lowest])
            centre = origin[2] + float(rotation[2] @ body.hull.centre)
            yield _RestingPose(make_transform(rotation, origin), footprint, cell, height, centre)

    def _draw_point(self) -> tuple[float, float] | None:
        """Sample (x, y) on the table, metres: in the heap's circle, or at a random pixel.

        Return None for a pixel that shows no point within three camera distances.
        """
        rng = self.rng
        if self.table.heaped:
            # The root makes the points uniform over the circle's area.
            radius, angle = self._radius * math.sqrt(rng.random()), rng.uniform(0, 2 * math.pi)
            return radius * math.cos(angle), radius * math.sin(angle)
        pixel = np.array([*(rng.uniform(0, 1, 2) * self.composition.size - 0.5), 1.0])
        inverse_depth = float(self._inverse_depth @ pixel)
        if inverse_depth < 1 / (3 * self.T_cam_table[2, 3]):
            return None
        point = np.linalg.solve(self.composition.K, pixel) / inverse_depth
        x, y, _ = self.T_cam_table[:3, :3].T @ (point - self.T_cam_table[:3, 3])
        return float(x), float(y)


def draw_view(table: Table, composition: Composition) -> Transform:
    """Sample T_cam_table; the middle of the image or window shows the table's origin."""
    T_cam_table = table.draw_view(composition.rng)
    if composition.preset.window is None:
        return T_cam_table
    middle = np.array([*(np.array(composition.size) / 2 - 0.5), 1.0])
    ray = np.linalg.solve(composition.K, middle)
    aside = np.array([-ray[1], ray[0], 0.0])  # rotation axis z × ray
    length = float(np.linalg.norm(aside))
    angle = math.atan(length)
    turned = rotation_vector_to_matrix(aside * (angle / length if length else 0.0))
    return make_transform(turned @ T_cam_table[:3, :3], turned @ T_cam_table[:3, 3])


@dataclass(frozen=True, eq=False)
class Footprint:
    """Height maps of a rotated object from below and above, with a border of one cell."""

    # Height of the underside above the lowest point, metres; the minimum of a cell and its eight
    # neighbours, to cover the space between centres; infinite outside the object.
    bottom: Float32[np.ndarray, "rows columns"]
    # Height of the upper side above the lowest point, metres; −infinite outside the object.
    top: Float32[np.ndarray, "rows columns"]
    corner: Cell  # x and y of the first cell's centre relative to the object's origin, in cells


class HeightMap:
    """Height of the objects above the table per square cell, x and y within ±``reach`` metres."""

    def __init__(self, cell: float, reach: float) -> None:
        self.cell = cell
        self._half = max(math.ceil(reach / cell), 1)
        side = 2 * self._half + 1
        self._heights = np.zeros((side, side), np.float32)

    def footprint(
        self, surface: Surface, rotation: RotationMatrix, lowest: float
    ) -> Footprint | None:
        """Return the footprint of a rotated object, or None if it is longer than 1024 cells.

        ``lowest`` is the height of the object's lowest point relative to its origin, metres.
        """
        # In cells; one contiguous row per coordinate.
        x, y, z = (rotation / self.cell) @ surface.vertices.T
        x0, y0 = math.ceil(x.min()) - 1, math.ceil(y.min()) - 1
        x1, y1 = math.floor(x.max()) + 1, math.floor(y.max()) + 1
        shape = (max(y1 - y0, 2) + 1, max(x1 - x0, 2) + 1)
        if max(shape) > 1024:
            return None
        heights = z - lowest / self.cell
        span = max(float(heights.max()), 1.0)
        below = _greatest(x, y, 1 - heights / span, surface, surface.faces, (x0, y0), shape)
        # Seen from above on the same map, front faces wind the other way.
        mirrored = np.ascontiguousarray(surface.faces[:, ::-1])
        above = _greatest(x, y, heights / span, surface, mirrored, (x0, y0), shape)
        if not above.any():
            # An object thinner than a cell occupies the middle cell over its full height.
            above[shape[0] // 2, shape[1] // 2] = below[shape[0] // 2, shape[1] // 2] = 2
        inside, unit = above > 0, np.float32(span * self.cell)
        bottom = np.where(inside, unit * (2 - below), np.float32(np.inf))
        return Footprint(
            bottom=np.asarray(cv2.erode(bottom, np.ones((3, 3), np.uint8))),
            top=np.where(inside, unit * (above - 1), np.float32(-np.inf)),
            corner=(x0, y0),
        )

    def height(self, footprint: Footprint, cell: Cell) -> float | None:
        """Return the height of the object's lowest point at rest, metres; None beyond the map.

        ``cell`` is the position of the object's origin, in cells.
        """
        rows, columns = window = self._window(footprint, cell)
        if min(rows.start, columns.start) < 0 or max(rows.stop, columns.stop) > len(self._heights):
            return None
        return max(float((self._heights[window] - footprint.bottom).max()), 0.0)

    def put(self, footprint: Footprint, cell: Cell, height: float) -> None:
        """Raise the map to the top of an object that rests at the result of :meth:`height`."""
        window = self._window(footprint, cell)
        np.maximum(self._heights[window], footprint.top + height, out=self._heights[window])

    def is_free(self, footprint: Footprint, cell: Cell) -> bool:
        """Return whether the map is empty under a footprint with the origin at ``cell``."""
        window = self._window(footprint, cell)
        return not bool((self._heights[window][np.isfinite(footprint.bottom)] > 0).any())

    def _window(self, footprint: Footprint, cell: Cell) -> tuple[slice, slice]:
        """Return the map's rows and columns under a footprint with the origin at ``cell``."""
        rows, columns = footprint.top.shape
        left = cell[0] + footprint.corner[0] + self._half
        top = cell[1] + footprint.corner[1] + self._half
        return slice(top, top + rows), slice(left, left + columns)


def _greatest(
    x: Column, y: Column, values: Column, surface: Surface, faces: Faces, corner: Cell, shape: Shape
) -> Float32[np.ndarray, "rows columns"]:
    """Return 1 + the greatest interpolated value at each cell's centre; 0 outside the object.

    ``values``, in [0, 1], belong to vertices at columns ``x`` and rows ``y``; ``corner`` is the
    (column, row) of the first cell.
    """
    # The rasteriser keeps the greatest 1/z and interpolates it linearly over the image. A vertex at
    # column x and row y with z = 1/(1 + value) therefore maps any linear value in [0, 1].
    z = 1.0 / (1.0 + values)
    hom = np.stack([x * z, y * z, z], axis=1)
    greatest, ids = np.zeros((*shape, 1), np.float32), np.empty((*shape, 1), np.int32)
    # No depth is below 1/2.
    rasterise(hom, faces, surface.closed, 0.25, corner, CENTRE_SAMPLE, greatest, ids, 0)
    return np.asarray(greatest[..., 0])
