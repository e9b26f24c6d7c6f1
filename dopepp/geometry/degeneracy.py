"""When points cannot fix a pose, and why."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.core.compiled import Array, compiled

MIN_POINTS: Final = 4

SMALLEST: Final = 1e-9
LARGEST: Final = 1e9
"""Extent of the object points, metres, outside of which they are no object."""

SAME_PIXEL: Final = 1e-3
"""Pixels by which two positions must differ to be two."""


def degenerate(
    object_points: Float[np.ndarray, "n 3"],
    image_points: Float[np.ndarray, "n 2"],
    sigma: Float[np.ndarray, "n"],
) -> str:
    """Say why these points cannot fix a pose, or return an empty string."""
    if len(object_points) < MIN_POINTS:
        return f"only {len(object_points)} usable points, {MIN_POINTS} are needed"
    extent, length, breadth, distinct, image_length, image_breadth, noise = _spreads(
        object_points, image_points, sigma
    )
    if not SMALLEST < extent < LARGEST:
        return f"the object points extend over {extent:.3g} m"
    if breadth < 1e-6 * length:
        return "the object points lie on one line"
    if distinct < MIN_POINTS:
        return f"only {int(distinct)} distinct pixels, {MIN_POINTS} are needed"
    if image_breadth < 1e-3 * image_length:
        return "the pixels lie on one line"
    if math.hypot(image_length, image_breadth) < noise * math.sqrt(len(image_points)):
        return "the pixels spread no wider than their own noise"
    return ""


@compiled()
def _spreads(
    object_points: Array, image_points: Array, sigma: Array
) -> tuple[float, float, float, float, float, float, float]:
    """Return how far points spread, for :func:`degenerate`.

    That is the object's largest extent, metres, and its two largest singular values over that; the
    number of pixels more than a thousandth apart, and the pixels' two singular values; their median
    deviation.
    """
    n = len(object_points)
    extent = 0.0
    for axis in range(3):
        extent = max(extent, np.ptp(object_points[:, axis]))
    centred, spread = np.empty((n, 3)), np.empty((n, 2))
    for axis in range(3):
        values = object_points[:, axis]
        centred[:, axis] = (values - values.mean()) / extent  # NaN for a single place
    for axis in range(2):
        spread[:, axis] = image_points[:, axis] - image_points[:, axis].mean()
    distinct = 0.0
    for i in range(n):
        new = True
        for j in range(i):
            new &= np.abs(image_points[i] - image_points[j]).max() > SAME_PIXEL
        distinct += new
    solid = np.linalg.svd(centred, False)[1] if np.isfinite(centred).all() else np.zeros(3)
    flat = np.linalg.svd(spread, False)[1] if np.isfinite(spread).all() else np.zeros(2)
    return extent, solid[0], solid[1], distinct, flat[0], flat[1], np.median(sigma)
