"""Who is lit: points looked up in a shadow map, compiled, in float32."""

from __future__ import annotations

import numpy as np

from dopepp.compiled import Array, Scalar, compiled
from dopepp.virtual.raster.scratch import scratch

_ZERO, _ONE = np.float32(0), np.float32(1)


@compiled(fastmath=True)
def _open_share(u: Scalar, v: Scalar, inverse: Scalar, inverse_depth: Array) -> Scalar:
    """Compare a point with the four texels around it; 1 beside the map.

    Percentage-closer filtering: the comparisons are interpolated, not the depths.
    """
    rows, columns = inverse_depth.shape[0], inverse_depth.shape[1]
    if not (_ZERO <= u < np.float32(columns - 1) and _ZERO <= v < np.float32(rows - 1)):
        return _ONE
    i, j = np.int64(u), np.int64(v)
    u, v = u - np.float32(i), v - np.float32(j)
    a = _ONE if inverse_depth[j, i, 0] <= inverse else _ZERO
    b = _ONE if inverse_depth[j, i + 1, 0] <= inverse else _ZERO
    c = _ONE if inverse_depth[j + 1, i, 0] <= inverse else _ZERO
    d = _ONE if inverse_depth[j + 1, i + 1, 0] <= inverse else _ZERO
    top, bottom = a + u * (b - a), c + u * (d - c)
    return top + v * (bottom - top)


@compiled(fastmath=True)
def lit_share(x: Scalar, y: Scalar, z: Scalar, inverse_depth: Array, P: Array) -> Scalar:
    """Return the share of a point's neighbourhood in a shadow map that sees the light.

    Args:
        x: The point, like y and z; metres, float32.
        y: Idem.
        z: Idem.
        inverse_depth: The map, 1/m, shape (height, width, 1), float32.
        P: Projects the point into the map: homogeneous pixels, of which the third is the depth,
            shape (3, 4), float32.
    """
    depth = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
    if depth <= _ZERO:
        return _ONE
    inverse = _ONE / depth
    u = (P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) * inverse
    v = (P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) * inverse
    return _open_share(u, v, inverse, inverse_depth)


def lit_shares(
    position: Array,
    normal: Array,
    bulge: Array,
    light: Array,
    inverse_depth: Array,
    P: Array,
    lift: float,
    lit: Array,
) -> None:
    """Write the share of a light's light that reaches each point; 0 where it faces away.

    Args:
        position: Points in the camera frame, metres, shape (3, n).
        normal: Unit normals, shape (3, n).
        bulge: Metres by which a point is lifted besides, shape (n,): a smooth ball of few flat
            triangles would shadow itself where its normals still face the light.
        light: The light's position in the camera frame, shape (>= 3,), float32.
        inverse_depth: The shadow map.
        P: Camera frame to the map, shape (3, 4), float32.
        lift: By which a point is lifted along its normal before it is looked up, metres per metre
            of distance from the light. From √2 texels on, the four texels around it lie behind it
            on its own plane, whatever the slope.
        lit: Result, shape (n,).
    """
    u, v, inverse = scratch("places", position.shape, np.float32)
    _place(position, normal, bulge, light, P, np.float32(lift), u, v, inverse)
    _compare(u, v, inverse, inverse_depth, lit)


@compiled(fastmath=True)
def _place(
    position: Array, normal: Array, bulge: Array, light: Array, P: Array, lift: Scalar, u: Array,
    v: Array, inverse: Array,
) -> None:  # fmt: skip
    """Project lifted points into the map: (u, v) and 1/depth, negative where they face away."""
    x0, y0, z0 = light[0], light[1], light[2]
    a, b, c, d = P[0, 0], P[0, 1], P[0, 2], P[0, 3]
    e, f, g, h = P[1, 0], P[1, 1], P[1, 2], P[1, 3]
    i, j, k, m = P[2, 0], P[2, 1], P[2, 2], P[2, 3]
    for p in range(position.shape[1]):
        x, y, z = position[0, p], position[1, p], position[2, p]
        nx, ny, nz = normal[0, p], normal[1, p], normal[2, p]
        facing = nx * (x0 - x) + ny * (y0 - y) + nz * (z0 - z)
        up = bulge[p] + lift * (i * x + j * y + k * z + m)
        x, y, z = x + up * nx, y + up * ny, z + up * nz
        scale = _ONE / (i * x + j * y + k * z + m)
        u[p] = (a * x + b * y + c * z + d) * scale
        v[p] = (e * x + f * y + g * z + h) * scale
        inverse[p] = scale if facing > _ZERO else -_ONE


@compiled(fastmath=True)
def _compare(u: Array, v: Array, inverse: Array, inverse_depth: Array, lit: Array) -> None:
    """Compare projected points with the map."""
    for p in range(lit.shape[0]):
        lit[p] = _open_share(u[p], v[p], inverse[p], inverse_depth) if inverse[p] > _ZERO else _ZERO
