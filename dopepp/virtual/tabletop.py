"""Objects on a table: each on the plane beside the others, or dropped onto a heap.

They are set down from above, and a height map knows what lies where. The table's frame has its
origin on the plane and z upwards. Heights are kept on a square grid of cells; an object is let down
until, in some cell, its underside meets what is already there. That is no physics: an object stays
as it was turned. Objects never overlap but by what changes within a cell.
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
from dopepp.virtual.presets.table import Table, inverse_depth_row, plane_of
from dopepp.virtual.surface import Surface
from dopepp.virtual.triangles import CENTRE_SAMPLE, rasterise

Column = Float[np.ndarray, "vertices"]
Cell = tuple[int, int]  # x and y


def arrange_on_table(composition: Composition, table: Table, targets: Sequence[Body]) -> Transform:
    """Choose a view, add targets and distractors, and return T_cam_table (plane z = 0, z up)."""
    rng = composition.rng
    # Another view is drawn where no target finds room in the image.
    for _ in range(8):
        composition.clear()
        setting = _Setting(composition, table, targets)
        for body in targets:
            if not setting.place(body) and not composition.objects:
                break
        if composition.objects or not targets:
            break
    low, high = composition.preset.distractors.number
    for _ in range(int(rng.integers(low, high + 1))):
        setting.place(composition.draw_distractor(float(setting.T_cam_table[2, 3])))
    return setting.T_cam_table


@dataclass(frozen=True, eq=False)
class _Lying:
    """One way to lie, with the heights of lowest point and centre of mass above the plane."""

    T_table_obj: Transform
    footprint: Footprint
    place: Cell
    height: float
    centre: float


class _Setting:
    """One view of the table and what lies on it."""

    def __init__(self, composition: Composition, table: Table, targets: Sequence[Body]) -> None:
        self.composition, self.table, self.rng = composition, table, composition.rng
        self.T_cam_table = table.draw_view(self.rng)
        if composition.preset.window is not None:
            self.T_cam_table = _in_the_middle(self.T_cam_table, composition)
        distance = float(self.T_cam_table[2, 3])
        diameter = max((2 * body.surface.radius for body in targets), default=0.3 * distance)
        self._radius = diameter * self.rng.uniform(*table.heap_radius)
        # A heap needs fine cells but little room; on a free table it is the other way round.
        reach = self._radius + 2 * diameter if table.heaped else 2 * distance
        # A cell is a hundredth of the largest target; at most 512 are to either side.
        self._map = HeightMap(max(0.01 * diameter, reach / 512), reach)
        self._inverse_depth = inverse_depth_row(plane_of(self.T_cam_table), composition.K)

    def place(self, body: Body) -> bool:
        """Lay a body down; tell whether it found a place."""
        material = self.composition.draw_material(body)
        for _ in range(6):  # turned anew, until it fits
            for lying in self._candidates(body):
                T_cam_obj = self.T_cam_table @ lying.T_table_obj
                if self.composition.add(body, T_cam_obj, material):
                    self._map.put(lying.footprint, lying.place, lying.height)
                    return True
        return False

    def _candidates(self, body: Body) -> Iterable[_Lying]:
        """Draw ways in which a body could lie; on a heap, the lowest first."""
        if not self.table.heaped:
            return self._turned(body)
        # Things slide down: the lowest of two turnings' places.
        several = [lying for _ in range(2) for lying in self._turned(body)]
        return sorted(several, key=lambda lying: lying.centre)

    def _turned(self, body: Body) -> Iterator[_Lying]:
        """Turn a body at random and yield places for it."""
        rotation, lowest = self.table.draw_turning(self.rng, body.hull)
        footprint = self._map.footprint(body.surface, rotation, lowest)
        if footprint is None:
            return
        cell, (rows, columns) = self._map.cell, footprint.top.shape
        for _ in range(6):
            drawn = self._draw_place()
            if drawn is None:
                continue
            x, y = (round(value / cell) for value in drawn)
            place = x - footprint.corner[0] - columns // 2, y - footprint.corner[1] - rows // 2
            height = self._map.height(footprint, place)
            if height is None or not (self.table.heaped or self._map.is_free(footprint, place)):
                continue
            origin = np.array([place[0] * cell, place[1] * cell, height - lowest])
            centre = origin[2] + float(rotation[2] @ body.hull.centre)
            yield _Lying(make_transform(rotation, origin), footprint, place, height, centre)

    def _draw_place(self) -> tuple[float, float] | None:
        """Draw a point of the table, metres: in the heap's circle, or seen by a random pixel."""
        rng = self.rng
        if self.table.heaped:
            # The root makes the points uniform over the circle's area.
            radius, angle = self._radius * math.sqrt(rng.random()), rng.uniform(0, 2 * math.pi)
            return radius * math.cos(angle), radius * math.sin(angle)
        pixel = np.array([*(rng.uniform(0, 1, 2) * self.composition.size - 0.5), 1.0])
        inverse_depth = float(self._inverse_depth @ pixel)
        # Farther than three camera distances it would be tiny.
        if inverse_depth < 1 / (3 * self.T_cam_table[2, 3]):
            return None
        point = np.linalg.solve(self.composition.K, pixel) / inverse_depth
        x, y, _ = self.T_cam_table[:3, :3].T @ (point - self.T_cam_table[:3, 3])
        return float(x), float(y)


def _in_the_middle(T_cam_table: Transform, composition: Composition) -> Transform:
    """Turn the camera so that the middle of a window, not of the picture, looks at the table."""
    middle = np.array([*(np.array(composition.size) / 2 - 0.5), 1.0])
    ray = np.linalg.solve(composition.K, middle)
    aside = np.array([-ray[1], ray[0], 0.0])  # z × ray: about it, by the angle between them
    length = float(np.linalg.norm(aside))
    angle = math.atan(length)
    turned = rotation_vector_to_matrix(aside * (angle / length if length else 0.0))
    return make_transform(turned @ T_cam_table[:3, :3], turned @ T_cam_table[:3, 3])


@dataclass(frozen=True, eq=False)
class Footprint:
    """A turned object as seen from below and above, with a border of one cell around it.

    Attributes:
        bottom: Height of its underside above its lowest point, metres, the least of a cell and
            its eight neighbours, for what happens between cells' centres; infinite beside it.
        top: Height of its upper side above its lowest point, metres; −infinite beside it.
        corner: x and y of the first cell's centre relative to the object's origin, in cells.
    """

    bottom: Float32[np.ndarray, "rows columns"]
    top: Float32[np.ndarray, "rows columns"]
    corner: Cell


class HeightMap:
    """What lies on the table.

    It covers x and y from −``reach`` to ``reach``, metres; beyond it nothing can lie.
    """

    def __init__(self, cell: float, reach: float) -> None:
        self.cell = cell
        self._half = max(math.ceil(reach / cell), 1)
        side = 2 * self._half + 1
        self._heights = np.zeros((side, side), np.float32)

    def footprint(
        self, surface: Surface, rotation: RotationMatrix, lowest: float
    ) -> Footprint | None:
        """See a turned object from below and above; None where it covers too many cells.

        ``lowest`` is the height of its lowest point relative to its origin, metres.
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
        # Seen from above without turning the map over, what is in front winds the other way.
        mirrored = np.ascontiguousarray(surface.faces[:, ::-1])
        above = _greatest(x, y, heights / span, surface, mirrored, (x0, y0), shape)
        if not above.any():
            # Thinner than a cell: it takes the one in the middle, from its foot to its head.
            above[shape[0] // 2, shape[1] // 2] = below[shape[0] // 2, shape[1] // 2] = 2
        inside, unit = above > 0, np.float32(span * self.cell)
        bottom = np.where(inside, unit * (2 - below), np.float32(np.inf))
        return Footprint(
            bottom=np.asarray(cv2.erode(bottom, np.ones((3, 3), np.uint8))),
            top=np.where(inside, unit * (above - 1), np.float32(-np.inf)),
            corner=(x0, y0),
        )

    def height(self, footprint: Footprint, place: Cell) -> float | None:
        """Return how high an object's lowest point would come to lie, metres; None beyond the map.

        ``place`` is x and y of its origin, in cells.
        """
        rows, columns = window = self._window(footprint, place)
        if min(rows.start, columns.start) < 0 or max(rows.stop, columns.stop) > len(self._heights):
            return None
        return max(float((self._heights[window] - footprint.bottom).max()), 0.0)

    def put(self, footprint: Footprint, place: Cell, height: float) -> None:
        """Set an object down where :meth:`height` said."""
        window = self._window(footprint, place)
        np.maximum(self._heights[window], footprint.top + height, out=self._heights[window])

    def is_free(self, footprint: Footprint, place: Cell) -> bool:
        """Tell whether nothing lies where the object would, neither under nor over it."""
        window = self._window(footprint, place)
        return not bool((self._heights[window][np.isfinite(footprint.bottom)] > 0).any())

    def _window(self, footprint: Footprint, place: Cell) -> tuple[slice, slice]:
        rows, columns = footprint.top.shape
        left = place[0] + footprint.corner[0] + self._half
        top = place[1] + footprint.corner[1] + self._half
        return slice(top, top + rows), slice(left, left + columns)


def _greatest(
    x: Column, y: Column, values: Column, surface: Surface, faces: Faces, corner: Cell, shape: Shape
) -> Float32[np.ndarray, "rows columns"]:
    """Return 1 + the greatest value over every cell's centre, 0 beside the object."""
    # The rasteriser keeps the greatest 1/z and interpolates it linearly over the image, so a vertex
    # at column x and row y with z = 1/(1 + value) makes it a map of any linear value in [0, 1].
    z = 1.0 / (1.0 + values)
    hom = np.stack([x * z, y * z, z], axis=1)
    greatest, ids = np.zeros((*shape, 1), np.float32), np.empty((*shape, 1), np.int32)
    # No depth is below 1/2.
    rasterise(hom, faces, surface.closed, 0.25, corner, CENTRE_SAMPLE, greatest, ids, 0)
    return np.asarray(greatest[..., 0])
