"""What lies on the bench in a trial: a part alone, beside other things, in a heap."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from dopepp.geometry.camera import Transform, make_transform
from dopepp.parts.part import Part
from dopepp.robot.grasping.cell import TRAY, Thing, convex_pieces
from dopepp.virtual.body import Body, distractor_shapes, make_body

SPREAD: Final = 0.025  # radius of the circle in which a part's middle lies, metres
HEAP: Final = (3, 5)
HEAP_SPREAD: Final = 0.05
HEAP_TILT: Final = 15.0
"""Fewest and most parts of a heap, the radius in which they fall, metres, and how tilted, degrees.
"""

DISTRACTORS: Final = (2, 4)
DISTRACTOR_RADIUS: Final = (0.012, 0.025)
DISTRACTOR_AREA: Final = 0.11
"""Fewest and most things beside a part, half their size, and within how far, metres."""

COLOUR: Final = (0.93, 0.55, 0.14)


@dataclass(frozen=True, eq=False)
class Lying:
    """A thing, and where it is let go, T_base_obj."""

    body: Body
    thing: Thing
    T_base_obj: Transform


class Layout:
    """Draws what lies on the bench.

    Args:
        yaw_deg: How far parts are turned about the vertical to either side, degrees; 0 has their x
            to the camera's right.
        rest: ``front`` lays the part's +z upwards; ``any`` on any face on which it rests.
    """

    def __init__(self, part: Part, name: str, yaw_deg: float, rest: str) -> None:
        self._name = name
        self.part, self.body = part, make_body(part, is_target=True)
        self.thing = Thing(convex_pieces(part), part.mesh, COLOUR)
        self._yaw, self._rest = np.radians(yaw_deg), rest

    def draw(self, rng: Generator) -> list[Lying]:
        """Draw things, the part or parts first."""
        lying: list[Lying] = getattr(self, self._name)(rng)
        return lying

    def drop(self, rng: Generator) -> Transform:
        """Draw a pose of a part that lies somewhere in the tray, alone."""
        return self._lying(rng, SPREAD, 0.0005, 0.0).T_base_obj

    def _lying(self, rng: Generator, spread: float, height: float, tilt_deg: float) -> Lying:
        up = np.array([0.0, 0.0, 1.0])
        if self._rest == "any":
            normals, shares = self.body.hull.rests
            up = -normals[rng.choice(len(shares), p=shares)]
        upright = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0]
        yaw, azimuth = rng.uniform(-self._yaw, self._yaw), rng.uniform(0, 2 * np.pi)
        tilt = np.radians(rng.uniform(0, tilt_deg)) * np.array([np.cos(azimuth), np.sin(azimuth)])
        turn = Rotation.from_rotvec([*tilt, 0.0]) * Rotation.from_rotvec([0.0, 0.0, yaw]) * upright
        rotation = turn.as_matrix()
        lowest = float((self.body.hull.vertices @ rotation[2]).min())
        middle = rotation @ self.part.cuboid[-1]
        place = TRAY + np.array([*_in_disc(rng, spread), height - lowest]) - [*middle[:2], 0.0]
        return Lying(self.body, self.thing, make_transform(rotation, place))

    def single(self, rng: Generator) -> list[Lying]:
        """Lay a part down alone."""
        return [self._lying(rng, SPREAD, 0.0005, 0.0)]

    def distractors(self, rng: Generator) -> list[Lying]:
        """Lay a part down among other things, which do not touch it."""
        lying = self.single(rng)
        taken = [(lying[0].T_base_obj[:3, 3], self.part.diameter / 2)]
        shapes = distractor_shapes()
        for _ in range(int(rng.integers(DISTRACTORS[0], DISTRACTORS[1] + 1))):
            radius = rng.uniform(*DISTRACTOR_RADIUS)
            body = shapes[int(rng.integers(len(shapes)))].stretched(
                radius * rng.uniform(0.6, 1.0, 3)
            )
            for _ in range(20):
                place = TRAY + np.array([*_in_disc(rng, DISTRACTOR_AREA), 0.0])
                if all(np.linalg.norm((place - at)[:2]) > radius + room for at, room in taken):
                    taken.append((place, radius))
                    lying.append(_stood(body, place, rng))
                    break
        return lying

    def heap(self, rng: Generator) -> list[Lying]:
        """Let parts fall upon each other."""
        count = int(rng.integers(HEAP[0], HEAP[1] + 1))
        return [self._lying(rng, HEAP_SPREAD, 0.002 + 0.02 * k, HEAP_TILT) for k in range(count)]


LAYOUTS: Final = ("single", "distractors", "heap")
"""Methods of :class:`Layout`; to add one, write it and name it here."""


def _stood(body: Body, place: np.ndarray, rng: Generator) -> Lying:
    """Stand a thing on the bench."""
    rotation = Rotation.from_rotvec([0.0, 0.0, rng.uniform(0, 2 * np.pi)]).as_matrix()
    vertices = body.surface.vertices
    height = 0.0005 - float(vertices[:, 2].min())
    thing = Thing((np.asarray(body.hull.vertices),), None, (0.35, 0.45, 0.6))
    return Lying(body, thing, make_transform(rotation, place + np.array([0.0, 0.0, height])))


def _in_disc(rng: Generator, radius: float) -> tuple[float, float]:
    distance, angle = radius * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
    return float(distance * np.cos(angle)), float(distance * np.sin(angle))
