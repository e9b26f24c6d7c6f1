"""Baked ambient occlusion: the open share of the sky above every point of a surface.

The mesh is rendered as depth maps from directions all around it, and the depth of points on its
triangles is compared with each map (as in Landis, "Production-ready global illumination", 2002).
Every triangle has a grid of points, because a CAD plate is two huge triangles whose corners do not
reflect a rib in the middle; small triangles have only their corners.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dopepp.core.compiled import Array, compiled
from dopepp.parts.mesh import Faces, Vertices
from dopepp.virtual.triangles import CENTRE_SAMPLE, lit_share, project_vertices, rasterise

_FINEST: Final = 1 / 96  # spacing of the points in mesh sizes; at most 96 steps per edge
_MAP_SIDE: Final = 192  # texels across a depth map


class _Points(NamedTuple):
    """Points on triangles: positions, unit normals, face indices; and unit normals of all faces."""

    points: Array
    upright: Array
    ground: Array
    flat: Array


@dataclass(frozen=True, eq=False)
class OpenSky:
    """Cosine-weighted share of each point's hemisphere that the mesh itself does not hide."""

    steps: Int[np.ndarray, "faces"]  # Number of grid steps along the edges of every triangle
    firsts: Int[np.ndarray, "faces"]  # Index of the first point of every triangle's grid
    # Shares at all points, on the front sides, then on the back sides.
    values: Float[np.ndarray, "2 points"]


_BAKED: Final[dict[bytes, OpenSky]] = {}  # Results of this process, by a hash of the mesh


def bake_open_sky(
    vertices: Vertices, faces: Faces, normals: Float[np.ndarray, "faces 3 3"], closed: bool
) -> OpenSky:
    """Return the ambient occlusion of a mesh; back sides of a closed mesh are not computed.

    Results are cached by a hash of the arguments, because a run prepares its parts repeatedly.
    """
    digest = hashlib.sha256(str((vertices.shape, closed)).encode())
    for array in (vertices, faces, normals):
        digest.update(np.ascontiguousarray(array).data)
    key = digest.digest()
    baked = _BAKED.get(key)
    if baked is None:
        if len(_BAKED) >= 256:  # a run has fewer parts
            _BAKED.pop(next(iter(_BAKED)), None)
        baked = _BAKED[key] = _bake_mesh(vertices, faces, normals, closed)
    return baked


def _bake_mesh(vertices: Array, faces: Array, normals: Array, closed: bool) -> OpenSky:
    """Compute the ambient occlusion of a mesh from depth maps in 24 to 256 directions."""
    corners = vertices[faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-300)
    # A convex mesh cannot hide its own sky; the test is quadratic.
    if len(faces) <= 1000 and _is_convex(corners, flat, closed):
        steps, firsts = np.ones(len(faces), np.int32), np.zeros(len(faces), np.int64)
        return OpenSky(steps, firsts, np.ones((2, 3), np.float32))
    used = corners.reshape(-1, 3)
    centre = (used.min(axis=0) + used.max(axis=0)) / 2
    radius = math.sqrt(float(((used - centre) ** 2).sum(axis=1).max()))
    steps, firsts, count = _grids(corners, 2 * radius)
    grid = _Points(*_spread(corners, normals, steps, firsts, count), flat)
    sums = np.zeros((4, count), np.float32)
    # A huge mesh is drawn from fewer directions.
    directions = spread_directions(int(np.clip(6_000_000 // len(faces), 24, 256)))
    _bake(vertices, faces, closed, centre, radius, directions, CENTRE_SAMPLE, grid, sums)
    # A point on a face without area counts as open.
    values = np.where(sums[1::2] > 0, sums[::2] / np.maximum(sums[1::2], 1e-9), 1.0)
    return OpenSky(steps, firsts, values.astype(np.float32))


def _is_convex(corners: Array, flat: Array, closed: bool) -> bool:
    """Return whether all corners lie behind every face's plane or, for an open mesh, on it."""
    points = corners.reshape(-1, 3)
    slack = 1e-4 * float(np.ptp(points, axis=0).max())
    heights = points @ flat.T - (corners[:, 0] * flat).sum(axis=1)
    return bool(heights.max() <= slack and (closed or heights.min() >= -slack))


def _grids(corners: Array, size: float) -> tuple[Array, Array, int]:
    """Return each triangle's steps, the index of its first point, and the number of all points.

    The spacing grows from ``_FINEST`` until there are 3 points per triangle plus 40,000 at most.
    """
    longest = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2).max(axis=1)
    spacing, most = _FINEST * size, 3 * len(corners) + 40_000
    for _ in range(13):
        steps = np.ceil(longest / spacing).clip(1, round(1 / _FINEST)).astype(np.int32)
        sizes = (steps.astype(np.int64) + 1) * (steps + 2) // 2
        if sizes.sum() <= most:
            break
        spacing = min(spacing * 1.3, size)
    firsts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    return steps, firsts, int(sizes.sum())


def spread_directions(count: int) -> Float[np.ndarray, "directions 3"]:
    """Return unit vectors spread evenly over the sphere (a Fibonacci spiral)."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, k * np.pi * (1 + np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)


def _spread(
    corners: Array, normals: Array, steps: Array, firsts: Array, count: int
) -> tuple[Array, Array, Array]:
    """Return the points of all triangles' grids, their unit normals and their triangles."""
    points, upright = np.empty((2, count, 3), np.float32)
    ground = np.empty(count, np.int32)
    for n in np.unique(steps).tolist():
        j, i = np.nonzero(np.add.outer(np.arange(n + 1), np.arange(n + 1)) <= n)
        # Points lie slightly inside the triangle: in a corner of the mesh, they would lie on two
        # walls.
        inset = 0.1 / n
        k1, k2 = (inset / 3 + (1 - inset) * step[:, None] / n for step in (i, j))
        k0 = 1.0 - k1 - k2
        faces = np.flatnonzero(steps == n)
        index = firsts[faces, None] + np.arange(len(i))
        ground[index] = faces[:, None]
        for source, out in ((corners, points), (normals, upright)):
            a, b, c = source[faces].transpose(1, 0, 2)[:, :, None]
            out[index] = k0 * a + k1 * b + k2 * c
    return points, upright, ground


@compiled()
def _bake(
    vertices: Array,
    faces: Array,
    closed: bool,
    centre: Array,
    radius: float,
    directions: Array,
    samples: Array,
    grid: _Points,
    sums: Array,
) -> None:
    """Sum the cosines between each point's normal and directions, blocked by one depth map each.

    ``centre`` and ``radius`` are a sphere around the mesh. The rows of ``sums`` are over unblocked
    and over all directions on the front side, then on the back side.
    """
    points, upright, ground, flat = grid
    side = _MAP_SIDE
    distance = 20.0 * radius  # almost parallel rays
    focal = 0.5 * (side - 4) * distance / radius
    K = np.array([[focal, 0.0, 0.5 * side], [0.0, focal, 0.5 * side], [0.0, 0.0, 1.0]])
    # A point lifted by more than √2 texels is not hidden by its own plane.
    lift = 1.5 * 2.0 * radius / side
    cam, hom = np.empty_like(vertices), np.empty_like(vertices)
    depth = np.empty((side, side, 1), np.float32)
    ids = np.empty((side, side, 1), np.int32)
    T, P = np.zeros((4, 4)), np.empty((3, 4), np.float32)
    zero = 0 * side  # a literal would compile the rasteriser again
    for k in range(directions.shape[0]):
        dx, dy, dz = directions[k]
        # The camera's x and y axes are arbitrary.
        if abs(dz) < 0.9:
            norm = 1.0 / math.sqrt(dx * dx + dy * dy)
            rx, ry, rz = -dy * norm, dx * norm, 0.0
        else:
            norm = 1.0 / math.sqrt(dy * dy + dz * dz)
            rx, ry, rz = 0.0, -dz * norm, dy * norm
        T[0, 0], T[0, 1], T[0, 2] = rx, ry, rz
        # The camera looks along −d: its third axis; the second is third × first.
        T[1, 0], T[1, 1], T[1, 2] = -(dy * rz - dz * ry), -(dz * rx - dx * rz), -(dx * ry - dy * rx)
        T[2, 0], T[2, 1], T[2, 2] = -dx, -dy, -dz
        for r in range(3):
            T[r, 3] = -(T[r, 0] * centre[0] + T[r, 1] * centre[1] + T[r, 2] * centre[2])
        T[2, 3] += distance
        project_vertices(vertices, T, K, cam, hom)
        for r in range(3):
            for c in range(4):
                P[r, c] = K[r, 0] * T[0, c] + K[r, 1] * T[1, c] + K[r, 2] * T[2, c]
        depth[:] = 0.0
        rasterise(
            hom, faces, closed, distance - 2.0 * radius, (zero, zero), samples, depth, ids, zero
        )
        for p in range(points.shape[0]):
            f = ground[p]
            facing = flat[f, 0] * dx + flat[f, 1] * dy + flat[f, 2] * dz
            cosine = upright[p, 0] * dx + upright[p, 1] * dy + upright[p, 2] * dz
            if facing < 0.0:
                if closed:
                    continue
                facing, cosine = -facing, -cosine
                back, up = 2, -lift
            else:
                back, up = 0, lift
            if facing < 1e-3 or cosine <= 0.0:
                continue
            sums[back + 1, p] += cosine
            x = np.float32(points[p, 0] + up * flat[f, 0])
            y = np.float32(points[p, 1] + up * flat[f, 1])
            z = np.float32(points[p, 2] + up * flat[f, 2])
            sums[back, p] += cosine * lit_share(x, y, z, depth, P)


@compiled(fastmath=True)
def look_up_sky(
    face: Array, share: Array, steps: Array, firsts: Array, values: Array, out: Array
) -> None:
    """Interpolate the unhidden share of the sky at an object's fragments into ``out``.

    ``face`` and ``share`` are fields of :class:`Fragments`; ``steps``, ``firsts`` and ``values``
    are fields of :class:`OpenSky`.
    """
    for p in range(face.shape[0]):
        f, side = (face[p], 0) if face[p] >= 0 else (~face[p], 1)
        n, first = steps[f], firsts[f]
        x, y = n * share[1, p], n * share[2, p]
        i, j = min(int(x), n - 1), min(int(y), n - 1)
        if i + j > n - 1:
            # A point on the far edge may be rounded into the next cell.
            i, j = max(i - 1, 0), j if i > 0 else j - 1
        x, y = x - i, y - j
        # Row j starts after n + 1, n, n − 1, … points.
        low = first + j * (n + 1) - j * (j - 1) // 2 + i
        high = low + n + 1 - j
        if x + y <= 1.0 or i + j == n - 1:
            out[p] = (
                (1.0 - x - y) * values[side, low]
                + x * values[side, low + 1]
                + y * values[side, high]
            )
        else:
            out[p] = (
                (x + y - 1.0) * values[side, high + 1]
                + (1.0 - x) * values[side, high]
                + (1.0 - y) * values[side, low + 1]
            )
