"""Turns of nearly round parts, e.g. a gear with a keyway or a flange with one larger hole.

A turn about the axis of such a part changes only a few of its lines, so a wrong turn fits the image
nearly as well as the correct one.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.geometry.rotation import Vector, rotation_angle
from dopepp.parts.mesh import SurfaceTree
from dopepp.parts.part import Mesh
from dopepp.parts.symmetry_finder import axis_rotation

NEARLY_ROUND: Final = 0.02
"""Mean distance of turned surface points from the surface, diameters. It is 0.01 for a gear with 16
teeth, and 0.03 for a knob with a pointer."""

STEP: Final = math.radians(2.0)  # angle between neighbouring turns
NUM_POINTS: Final = 300  # surface points that are turned

Turns = Float[np.ndarray, "turns 3 3"]


def nearly_round_turns(
    mesh: Mesh, centre: Vector, diameter: float, symmetries: Turns
) -> list[Turns]:
    """Return turns of a part that hardly change its surface, an array for each axis and side.

    An axis of the part's box counts if every turn about it is :data:`NEARLY_ROUND`, alone or after
    a half turn to the other side. Of all turns that symmetries make equal, only one is returned.

    Args:
        mesh: Mesh of the part, metres.
        centre: Centre of the box, metres.
        diameter: Diameter of the part, metres.
        symmetries: Rotations of the part's discrete symmetries, with the identity.

    Returns:
        Rotations by increasing angle, :data:`STEP` apart; the first array has the identity.
    """
    surface = SurfaceTree((np.asarray(mesh.vertices) - centre) / diameter, mesh.faces)
    points, angles = surface.spread(NUM_POINTS, seed=5)[0], np.arange(-math.pi, math.pi, STEP)

    def are_nearly_round(turns: Turns) -> bool:
        distances = surface.distances(points @ np.swapaxes(turns, 1, 2), neighbours=1)
        return bool(distances.mean(axis=1).max() < NEARLY_ROUND)

    found: list[Turns] = []
    for axis, across in np.eye(3)[[[0, 1], [1, 2], [2, 0]]]:
        about_axis = np.array([axis_rotation(axis, angle) for angle in angles])
        for side in np.eye(3), axis_rotation(across, math.pi):
            turns = about_axis @ side
            # A quarter turn excludes most parts.
            subsets = turns[len(turns) // 4 :][:1], turns[::16], turns
            if all(map(are_nearly_round, subsets)):
                former = np.concatenate([np.empty((0, 3, 3)), *found])
                found.append(turns[_distinct(turns, former, symmetries)])
    return [turns for turns in found if len(turns) > 1]


def _distinct(turns: Turns, former: Turns, symmetries: Turns) -> list[int]:
    """Return the indices of turns that no symmetry makes equal to a former or smaller turn."""
    kept: list[int] = []
    for index in np.argsort(rotation_angle(turns), kind="stable"):
        others = np.concatenate([former, turns[kept]])
        steps = (np.swapaxes(others, 1, 2) @ turns[index])[:, None] @ symmetries
        if not len(others) or rotation_angle(steps).min() > STEP / 2:
            kept.append(int(index))
    return sorted(kept)
