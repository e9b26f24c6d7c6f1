"""The nine keypoints of an object: the corners of its bounding cuboid and its centre.

The corners are in NDDS order in all maps, readers, drawings and files.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from dopepp.geometry.rotation import Vector

Cuboid = Float[np.ndarray, "9 3"]  # The nine keypoints of an object, metres, object frame

NUM_CORNERS: Final = 8
NUM_KEYPOINTS: Final = 9
CENTROID: Final = 8

CORNER_SIGNS: Final[NDArray[np.float64]] = np.array(
    [(x, y, z) for z in (1, -1) for x, y in ((1, -1), (-1, -1), (-1, 1), (1, 1))], np.float64
)
"""Corners in units of half-extents, NDDS order, shape (8, 3)."""

EDGES: Final[tuple[tuple[int, int], ...]] = tuple(
    (a, b)
    for a in range(NUM_CORNERS)
    for b in range(a + 1, NUM_CORNERS)
    if np.abs(CORNER_SIGNS[a] - CORNER_SIGNS[b]).sum() == 2
)
"""The cuboid's twelve edges as pairs of corner indices (they differ in one sign)."""


def cuboid_keypoints(lower: Vector, upper: Vector) -> Cuboid:
    """Return a box's eight corners (NDDS order) and centre from its bounds, metres, object frame.

    Raises:
        ValueError: A bound is not finite, or ``lower`` exceeds ``upper``.
    """
    lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    if not (np.isfinite(lower).all() and np.isfinite(upper).all() and (lower <= upper).all()):
        raise ValueError(f"bounds must be finite with lower <= upper, got {lower} and {upper}")
    centre, half = (lower + upper) / 2, (upper - lower) / 2
    return np.vstack([centre + CORNER_SIGNS * half, centre])
