"""Value noise from a small periodic table: the unevenness of paint, and of brushed streaks."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from dopepp.compiled import Array, Scalar, compiled

_SIDE: Final = 32
_MASK: Final = _SIDE - 1

# 32³ values of one byte stay in the processor's first cache; the seed only fixes the pattern.
NOISE: Final = np.random.default_rng(0).integers(-127, 128, (_SIDE, _SIDE, _SIDE)).astype(np.int8)
"""Random values on a lattice that repeats every 32 steps, in units of 1/127."""


@compiled(fastmath=True)
def value_noise(noise: Array, x: Scalar, y: Scalar, z: Scalar) -> Scalar:
    """Return trilinear noise in [-1, 1] of lattice pitch 1 (``noise`` is :data:`NOISE`)."""
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    x, y, z = x - fx, y - fy, z - fz
    i0, j0, m0 = int(fx) & _MASK, int(fy) & _MASK, int(fz) & _MASK
    i1, j1, m1 = (i0 + 1) & _MASK, (j0 + 1) & _MASK, (m0 + 1) & _MASK
    a = noise[m0, j0, i0] * (1 - x) + noise[m0, j0, i1] * x
    b = noise[m0, j1, i0] * (1 - x) + noise[m0, j1, i1] * x
    c = noise[m1, j0, i0] * (1 - x) + noise[m1, j0, i1] * x
    d = noise[m1, j1, i0] * (1 - x) + noise[m1, j1, i1] * x
    return ((a * (1 - y) + b * y) * (1 - z) + (c * (1 - y) + d * y) * z) / 127.0


@compiled(fastmath=True)
def streak_noise(noise: Array, x: Scalar) -> Scalar:
    """Return noise in [-1, 1] along a line; it repeats after 32³ steps."""
    fx = math.floor(x)
    share, i = x - fx, int(fx)
    j = i + 1
    a = noise[(i >> 10) & _MASK, (i >> 5) & _MASK, i & _MASK]
    b = noise[(j >> 10) & _MASK, (j >> 5) & _MASK, j & _MASK]
    return (a * (1 - share) + b * share) / 127.0


@compiled(fastmath=True)
def tint_albedo(
    noise: Array,
    position: Array,
    T_cam_obj: Array,
    focal: float,
    amplitude: float,
    pitch: float,
    albedo: Array,
) -> None:
    """Vary the albedo over an object's surface; variation finer than a pixel fades.

    Args:
        noise: :data:`NOISE`.
        position: Points in the camera frame, metres, shape (3, n).
        T_cam_obj: Object to camera frame.
        focal: Focal length, pixels.
        amplitude: Relative amplitude.
        pitch: Of the lattice, metres.
        albedo: Linear RGB, shape (3, n), updated in place.
    """
    for p in range(position.shape[1]):
        # Two lattice steps are the shortest wave; it needs two pixels.
        fade = 2.0 - position[2, p] / (focal * pitch)
        if fade <= 0.0:
            continue
        x = position[0, p] - T_cam_obj[0, 3]
        y = position[1, p] - T_cam_obj[1, 3]
        z = position[2, p] - T_cam_obj[2, 3]
        tint = 1.0 + amplitude * min(fade, 1.0) * value_noise(
            noise,
            (T_cam_obj[0, 0] * x + T_cam_obj[1, 0] * y + T_cam_obj[2, 0] * z) / pitch,
            (T_cam_obj[0, 1] * x + T_cam_obj[1, 1] * y + T_cam_obj[2, 1] * z) / pitch,
            (T_cam_obj[0, 2] * x + T_cam_obj[1, 2] * y + T_cam_obj[2, 2] * z) / pitch,
        )
        for c in range(3):
            albedo[c, p] *= tint
