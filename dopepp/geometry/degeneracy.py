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
    rays: Float[np.ndarray, "n 2"],
    to_px: Float[np.ndarray, "2 2"],
    whitening: Float[np.ndarray, "n 2 2"],
) -> str:
    """Say why these points cannot fix a pose, or return an empty string.

    ``to_px`` turns rays into pixels, ``whitening`` pixels into standard deviations.
    """
    if len(object_points) < MIN_POINTS:
        return too_few(len(object_points))
    extent, length, breadth, distinct, image_length, image_breadth, noise = _spreads(
        object_points, rays, to_px, whitening
    )
    if not SMALLEST < extent < LARGEST:
        return f"the object points extend over {extent:.3g} m"
    if breadth < 1e-6 * length:
        return "the object points lie on one line"
    if distinct < MIN_POINTS:
        return f"only {int(distinct)} distinct pixels, {MIN_POINTS} are needed"
    if image_breadth < 1e-3 * image_length:
        return "the pixels lie on one line"
    if math.hypot(image_length, image_breadth) < noise * math.sqrt(len(rays)):
        return "the pixels spread no wider than their own noise"
    return ""


def too_few(num_points: int) -> str:
    """Say that so many points fix no pose."""
    return f"only {num_points} usable points, {MIN_POINTS} are needed"


@compiled()
def _spreads(
    object_points: Array, rays: Array, to_px: Array, whitening: Array
) -> tuple[float, float, float, float, float, float, float]:
    """Return how far points spread, for :func:`degenerate`.

    That is the object's largest extent, metres, and its two largest singular values over that; the
    number of pixels more than a thousandth apart, and the pixels' two singular values; the median
    over points of their mean deviation over both directions, (det W)^(−1/2).
    """
    n = len(object_points)
    extent = 0.0
    for axis in range(3):
        extent = max(extent, np.ptp(object_points[:, axis]))
    centred, spread, sigma = np.empty((n, 3)), np.empty((n, 2)), np.empty(n)
    for axis in range(3):
        values = object_points[:, axis]
        centred[:, axis] = (values - values.mean()) / extent  # NaN for a single place
    for i in range(n):
        sigma[i] = (whitening[i, 0, 0] * whitening[i, 1, 1]) ** -0.5
        for axis in range(2):
            spread[i, axis] = to_px[axis, 0] * rays[i, 0] + to_px[axis, 1] * rays[i, 1]
    distinct = 0.0
    for i in range(n):
        new = True
        for j in range(i):
            dx, dy = spread[i, 0] - spread[j, 0], spread[i, 1] - spread[j, 1]
            new &= abs(dx) > SAME_PIXEL or abs(dy) > SAME_PIXEL
        distinct += new
    for axis in range(2):
        spread[:, axis] -= spread[:, axis].mean()
    solid = np.linalg.svd(centred, False)[1] if np.isfinite(centred).all() else np.zeros(3)
    flat = np.linalg.svd(spread, False)[1] if np.isfinite(spread).all() else np.zeros(2)
    return extent, solid[0], solid[1], distinct, flat[0], flat[1], np.median(sigma)
