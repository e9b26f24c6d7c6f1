"""Compiled rasterisation of triangles: the nearest triangle and inverse depth of every sample.

Ambient occlusion, scene composition, rendering and shadow maps share these functions.

Visibility uses homogeneous edge functions (Olano and Greer, "Triangle scan conversion using 2D
homogeneous coordinates", 1997): with the projected vertices ``p = K x_cam`` of a triangle,
``e_0(x, y) = (p_1 × p_2)·(x, y, 1)`` and its cyclic companions are the perspective-correct
barycentric coordinates times ``det/z``, so ``1/z = (e_0 + e_1 + e_2)/det`` is linear in the image
and a triangle that crosses the near plane needs no clipping: samples in front of it are rejected.
"""

from __future__ import annotations

import math
import threading
from typing import Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from dopepp.core.compiled import Array, Scalar, compiled

NUM_COLOUR_SAMPLES: Final = 4
"""Number of samples for a pixel's colour; the last sample, the centre, gives the labels."""

PIXEL_SAMPLES: Final = np.array(
    [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25), (0.0, 0.0)]
)
CENTRE_SAMPLE: Final = np.zeros((1, 2))

EdgeFunctions = tuple[float, float, float, float, float, float, float, float, float]
"""Coefficients of x, y and 1 for each of a triangle's edges."""

_ZERO, _ONE = np.float32(0), np.float32(1)  # literals would turn the arithmetic into float64

_pool = threading.local()


@compiled()
def project_vertices(vertices: Array, T_cam_obj: Array, K: Array, cam: Array, hom: Array) -> None:
    """Fill ``cam`` with vertices in the camera frame, metres, and ``hom`` with ``K x_cam``."""
    for i in range(vertices.shape[0]):
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        for r in range(3):
            cam[i, r] = (
                T_cam_obj[r, 0] * x + T_cam_obj[r, 1] * y + T_cam_obj[r, 2] * z + T_cam_obj[r, 3]
            )
        hom[i, 0] = K[0, 0] * cam[i, 0] + K[0, 1] * cam[i, 1] + K[0, 2] * cam[i, 2]
        hom[i, 1] = K[1, 1] * cam[i, 1] + K[1, 2] * cam[i, 2]
        hom[i, 2] = cam[i, 2]


@compiled()
def bounds(hom: Array, near: float) -> tuple[float, float, float, float]:
    """Return (left, top, right, bottom) of vertices, pixels; infinite across depth ``near``."""
    left, top, right, bottom = math.inf, math.inf, -math.inf, -math.inf
    in_front, behind = False, False
    for i in range(hom.shape[0]):
        w = hom[i, 2]
        if w < near:
            behind = True
        else:
            in_front = True
            u, v = hom[i, 0] / w, hom[i, 1] / w
            left, right = min(left, u), max(right, u)
            top, bottom = min(top, v), max(bottom, v)
    if in_front and behind:
        return -math.inf, -math.inf, math.inf, math.inf
    return left, top, right, bottom


@compiled(inline="always")
def _narrow(first: int, last: int, x0: int, slope: float, least: float) -> tuple[int, int]:
    """Narrow the columns ``first`` to ``last`` to those with ``slope·(column + x0) >= least``."""
    if slope != 0.0:
        # Far beyond the window's columns the integer conversion would overflow.
        edge = min(max(least / slope - x0, first - 1.0), last + 1.0)
        if slope > 0.0:
            first = max(first, math.ceil(edge - 1e-6))
        else:
            last = min(last, math.floor(edge + 1e-6))
    return first, last


@compiled()
def rasterise(
    hom: Array,
    faces: Array,
    cull: bool,
    near: float,
    origin: tuple[int, int],
    samples: Array,
    inverse_depth: Array,
    ids: Array,
    first_id: int,
) -> None:
    """Draw triangles into buffers of the nearest inverse depth (1/m, 0 = empty) and triangle id.

    ``hom`` are homogeneous pixels of the vertices, shape (V, 3), and the first of the ``faces`` has
    the id ``first_id``. With ``cull``, back faces are omitted (watertight meshes only). No sample
    is nearer than ``near`` metres. ``samples`` are offsets from a pixel's centre, at most 1/4,
    shape (S, 2). The buffers have the shape (height, width, S) and begin at pixel ``origin``.
    """
    height, width, num_samples = inverse_depth.shape
    x0, y0 = origin
    delta = np.empty((num_samples, 4))
    reach = np.abs(samples).max()
    nearest = 1.0 / near
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, aw = hom[a, 0], hom[a, 1], hom[a, 2]
        bx, by, bw = hom[b, 0], hom[b, 1], hom[b, 2]
        cx, cy, cw = hom[c, 0], hom[c, 1], hom[c, 2]
        if aw < near and bw < near and cw < near:
            continue
        e0x, e0y, e0c = by * cw - bw * cy, bw * cx - bx * cw, bx * cy - by * cx
        det = ax * e0x + ay * e0y + aw * e0c
        # Seen from outside, a counter-clockwise triangle has a negative determinant.
        if det == 0.0 or (cull and det > 0.0):
            continue
        left, right, top, bottom = 0, width - 1, 0, height - 1
        if aw >= near and bw >= near and cw >= near:
            au, bu, cu = ax / aw, bx / bw, cx / cw
            av, bv, cv = ay / aw, by / bw, cy / cw
            low, high = min(au, bu, cu) - x0 - reach, max(au, bu, cu) - x0 + reach
            if high < 0.0 or low > width - 1:
                continue
            left, right = max(left, math.ceil(low)), min(right, math.floor(high))
            low, high = min(av, bv, cv) - y0 - reach, max(av, bv, cv) - y0 + reach
            if high < 0.0 or low > height - 1:
                continue
            top, bottom = max(top, math.ceil(low)), min(bottom, math.floor(high))
            if left > right or top > bottom:
                continue
        # After scaling by 1/det, points inside have three values >= 0, whose sum is 1/z.
        scale = 1.0 / det
        e0x, e0y, e0c = e0x * scale, e0y * scale, e0c * scale
        e1x = (cy * aw - cw * ay) * scale
        e1y = (cw * ax - cx * aw) * scale
        e1c = (cx * ay - cy * ax) * scale
        e2x = (ay * bw - aw * by) * scale
        e2y = (aw * bx - ax * bw) * scale
        e2c = (ax * by - ay * bx) * scale
        for s in range(num_samples):
            dx, dy = samples[s, 0], samples[s, 1]
            delta[s, 0] = e0x * dx + e0y * dy
            delta[s, 1] = e1x * dx + e1y * dy
            delta[s, 2] = e2x * dx + e2y * dy
            delta[s, 3] = delta[s, 0] + delta[s, 1] + delta[s, 2]
        # A margin on the edge functions at the pixel's centre, so that no sample is missed.
        slack0 = -reach * (abs(e0x) + abs(e0y))
        slack1 = -reach * (abs(e1x) + abs(e1y))
        slack2 = -reach * (abs(e2x) + abs(e2y))
        wide = right - left > 3
        for j in range(top, bottom + 1):
            y = float(j + y0)
            first, last = left, right
            if wide:
                # Long slanted triangles fill little of their bounding box, so solve for the span.
                row0, row1, row2 = e0y * y + e0c, e1y * y + e1c, e2y * y + e2c
                first, last = _narrow(first, last, x0, e0x, slack0 - row0)
                first, last = _narrow(first, last, x0, e1x, slack1 - row1)
                first, last = _narrow(first, last, x0, e2x, slack2 - row2)
            x = float(first + x0)
            w0 = e0x * x + e0y * y + e0c
            w1 = e1x * x + e1y * y + e1c
            w2 = e2x * x + e2y * y + e2c
            for i in range(first, last + 1):
                if w0 >= slack0 and w1 >= slack1 and w2 >= slack2:
                    total = w0 + w1 + w2
                    for s in range(num_samples):
                        if (
                            w0 + delta[s, 0] >= 0.0
                            and w1 + delta[s, 1] >= 0.0
                            and w2 + delta[s, 2] >= 0.0
                        ):
                            inverse = np.float32(total + delta[s, 3])
                            if inverse > inverse_depth[j, i, s] and inverse <= nearest:
                                inverse_depth[j, i, s] = inverse
                                ids[j, i, s] = first_id + f
                w0 += e0x
                w1 += e1x
                w2 += e2x


@compiled(inline="always")
def edge_functions(hom: Array, a: int, b: int, c: int) -> EdgeFunctions:
    """Return the edge functions of the triangle of vertices a, b, c, as coefficients of (x, y, 1).

    An edge function at a pixel is the weight of the opposite corner, up to a common factor.
    """
    ax, ay, aw = hom[a, 0], hom[a, 1], hom[a, 2]
    bx, by, bw = hom[b, 0], hom[b, 1], hom[b, 2]
    cx, cy, cw = hom[c, 0], hom[c, 1], hom[c, 2]
    return (
        by * cw - bw * cy, bw * cx - bx * cw, bx * cy - by * cx,
        cy * aw - cw * ay, cw * ax - cx * aw, cx * ay - cy * ax,
        ay * bw - aw * by, aw * bx - ax * bw, ax * by - ay * bx,
    )  # fmt: skip


@compiled(fastmath=True)
def open_share(u: Scalar, v: Scalar, inverse: Scalar, inverse_depth: Array) -> Scalar:
    """Return the share of light in [0, 1] that reaches a point at column u, row v of a shadow map.

    ``inverse`` is the point's inverse depth from the light. The comparisons with the four texels
    are interpolated, not the depths (percentage-closer filtering). Points outside the map are lit.
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
    """Return :func:`open_share` at a point that ``P`` (3, 4) projects into the shadow map."""
    depth = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
    if depth <= _ZERO:
        return _ONE
    inverse = _ONE / depth
    u = (P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) * inverse
    v = (P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) * inverse
    return open_share(u, v, inverse, inverse_depth)


def scratch(name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return an uninitialised array, valid until this thread requests the same name again.

    Reusing memory saves 3 to 5 ms per 640×480 image, which clearing fresh pages would take.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    blocks: dict[str, NDArray[np.uint8]] = vars(_pool)
    if name not in blocks or len(blocks[name]) < size:
        blocks[name] = np.empty(size, np.uint8)
    return blocks[name][:size].view(dtype).reshape(shape)
