"""The eight corners of an NDDS cuboid as a box: its edges, its axes, its size."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.geometry.rotation import rotation_angle

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
