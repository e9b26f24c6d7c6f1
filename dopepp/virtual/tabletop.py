"""Objects on a table: each on the plane beside the others, or dropped onto a heap."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.geometry.camera import make_transform
from dopepp.virtual.body import Body
from dopepp.virtual.composition import Composition
from dopepp.virtual.heap import Footprint, HeightMap
from dopepp.virtual.table import Table, plane_of

_VIEWS: Final = 8
"""Draws of the camera's place; another one is drawn where no target finds room in the image."""

_ROUNDS: Final = 6
"""So often an object is turned anew, until it fits."""

_PLACES: Final = 6
"""Draws of where an object lies, for each turning."""

_COMPARED: Final = 2
"""Turnings among whose places the lowest is taken on a heap, where things slide down."""

_CELL_SHARE: Final = 0.01
"""Size of the height map's cells over the largest target's diameter."""

_MAX_HALF_CELLS: Final = 512
"""The height map has at most so many cells to either side."""

_FARTHEST: Final = 3.0
"""Nothing is placed farther away than so many camera distances, where it would be tiny."""


def arrange_on_table(
    composition: Composition, table: Table, targets: Sequence[Body]
) -> Float[np.ndarray, "4 4"]:
    """Choose a view and place targets and distractors.

    Args:
        composition: Empty; objects are added to it, no target if none finds a place.
        table: How they may lie.
        targets: What to place.

    Returns:
        T_cam_table, which maps the table's frame (z up, plane z = 0) to the camera's.
    """
    rng = composition.rng
    for _ in range(_VIEWS):
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
    """One way in which a body could lie.

    Attributes:
        T_table_obj: Its pose in the table's frame.
        footprint: What it covers.
        place: x and y of its origin, in the height map's cells.
        height: Of its lowest point above the plane, metres.
        centre: Of its centre of mass above the plane, metres.
    """

    T_table_obj: Float[np.ndarray, "4 4"]
    footprint: Footprint
    place: tuple[int, int]
    height: float
    centre: float


class _Setting:
    """One view of the table and what lies on it."""

    def __init__(self, composition: Composition, table: Table, targets: Sequence[Body]) -> None:
        self.composition, self.table, self.rng = composition, table, composition.rng
        self.T_cam_table = table.draw_view(self.rng)
        distance = float(self.T_cam_table[2, 3])
        diameter = max((2 * body.surface.radius for body in targets), default=0.3 * distance)
        self._radius = diameter * self.rng.uniform(*table.heap_radius)
        # A heap needs fine cells but little room; on a free table it is the other way round.
        reach = self._radius + 2 * diameter if table.heaped else 2 * distance
        self._map = HeightMap(max(_CELL_SHARE * diameter, reach / _MAX_HALF_CELLS), reach)
        plane = plane_of(self.T_cam_table)
        # Of the plane, per homogeneous pixel: 1/depth is linear in the image.
        self._inverse_depth = plane.normal @ np.linalg.inv(composition.K) / plane.offset

    def place(self, body: Body) -> bool:
        """Lay a body down; tell whether it found a place."""
        material = self.composition.draw_material(body)
        for _ in range(_ROUNDS):
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
        several = [lying for _ in range(_COMPARED) for lying in self._turned(body)]
        return sorted(several, key=lambda lying: lying.centre)

    def _turned(self, body: Body) -> Iterator[_Lying]:
        """Turn a body at random and yield places for it."""
        rotation, lowest = self.table.draw_turning(self.rng, body.hull)
        footprint = self._map.footprint(body.surface, rotation, lowest)
        if footprint is None:
            return
        for _ in range(_PLACES):
            drawn = self._draw_place()
            if drawn is None:
                continue
            middle, cell = footprint.middle, self._map.cell
            place = round(drawn[0] / cell) - middle[0], round(drawn[1] / cell) - middle[1]
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
        if inverse_depth < 1 / (_FARTHEST * self.T_cam_table[2, 3]):
            return None
        point = np.linalg.solve(self.composition.K, pixel) / inverse_depth
        x, y, _ = self.T_cam_table[:3, :3].T @ (point - self.T_cam_table[:3, 3])
        return float(x), float(y)
