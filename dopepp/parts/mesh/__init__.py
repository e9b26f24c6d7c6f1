"""Measures of triangles: areas, samples, the largest distance, a hash, and distances to a surface.

The functions take arrays, so that triangles can be measured before they are checked. The modules of
this package read mesh files.
"""

from __future__ import annotations

import hashlib
from typing import Final

import numpy as np
import scipy  # SciPy loads its submodules on first use
from jaxtyping import Float, Int, UInt8
from numpy.random import Generator

Vertices = Float[np.ndarray, "vertices 3"]
Faces = Int[np.ndarray, "faces 3"]
Points = Float[np.ndarray, "points 3"]
Colours = UInt8[np.ndarray, "vertices 3"]
"""Positions of vertices, vertex indices of triangles, any positions, sRGB of vertices."""

NUM_SURFACE_POINTS: Final = 2000  # ADD points of a CAD part, fixed so that results are comparable
SURFACE_SEED: Final = 2000  # fixed so that a mesh always has the same ADD points
_FEW_CORNERS: Final = 5000
"""Largest hull with an exhaustive search for the largest distance (a quarter of a second)."""


NUM_COVERING: Final = 60_000
"""Surface points of a :class:`SurfaceTree`, about 0.6 % of a compact part's diameter apart."""

_NUM_NEIGHBOURS: Final = 6
"""Surface points whose triangles are compared: near an edge, the nearest point's triangle may not
be the nearest triangle."""


def face_areas(vertices: Vertices, faces: Faces) -> Float[np.ndarray, " faces"]:
    """Return the area of each triangle."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


def sample_surface(
    vertices: Vertices, faces: Faces, num_points: int = NUM_SURFACE_POINTS, seed: int = SURFACE_SEED
) -> Points:
    """Return random points, sampled uniformly over the area of a mesh.

    Raises:
        ValueError: The triangles have no area.
    """
    rng = np.random.default_rng(seed)
    cumulative = np.cumsum(face_areas(vertices, faces))
    if not cumulative[-1] > 0:
        raise ValueError(f"{len(faces)} triangles with a total area of {cumulative[-1]}")
    # The last bound is excluded, so that a product rounded up to the total selects a triangle.
    chosen = np.searchsorted(cumulative[:-1], rng.random(num_points) * cumulative[-1], side="right")
    return _points_inside(vertices[faces[chosen]], rng)


def _points_inside(
    triangles: Float[np.ndarray, "triangles 3 3"], rng: Generator
) -> Float[np.ndarray, "triangles 3"]:
    """Sample a point uniformly from each triangle."""
    a, b, c = triangles.swapaxes(0, 1)
    # √ makes the density of points independent of the distance from corner a.
    root, along = np.sqrt(rng.random((len(a), 1))), rng.random((len(a), 1))
    return np.asarray((1 - root) * a + root * (1 - along) * b + root * along * c)


def largest_distance(points: Points) -> float:
    """Return the largest distance between two points.

    The result is exact for convex hulls of up to 5,000 corners, otherwise up to 0.09 % too small.
    """
    # The farthest points are corners of the convex hull, which flat and straight sets have only in
    # the subspace that they span.
    offsets = points - points.mean(axis=0)
    _, spread, axes = np.linalg.svd(offsets, full_matrices=False)
    # Ignoring a thickness of 1e-6 of the length changes the distance by a factor of 1 − 1e-12.
    rank = int((spread > 1e-6 * spread[0]).sum())
    if rank == 0:
        return 0.0
    if rank == 1:
        along = offsets @ axes[0]
        return float(np.linalg.norm(points[along.argmax()] - points[along.argmin()]))
    flat = offsets @ axes[:rank].T
    corners = points if _is_round(flat) else points[scipy.spatial.ConvexHull(flat).vertices]
    if len(corners) > _FEW_CORNERS:
        corners = corners[_extremes(corners)]
    # 512 rows at a time keep the distances of 5,000 corners in a fast cache.
    blocks = (corners[start : start + 512] for start in range(0, len(corners), 512))
    return max(float(scipy.spatial.distance.cdist(block, corners).max()) for block in blocks)


def _is_round(points: Float[np.ndarray, "points axes"]) -> bool:
    """Return whether most points lie on their convex hull, which is then slow to compute."""
    if len(points) <= _FEW_CORNERS:
        return False
    sample = points[:: len(points) // _FEW_CORNERS + 1]
    # "QJ" moves points slightly, so that a planar sample has a hull too.
    return 2 * len(scipy.spatial.ConvexHull(sample, qhull_options="QJ").vertices) > len(sample)


def _extremes(points: Points) -> Int[np.ndarray, " extremes"]:
    """Return the indices of the first and last points along 2,500 directions."""
    # Along a direction at an angle φ to the diameter, the distance is at least cos φ diameters, and
    # with 2,500 directions φ is below 2.42°. Single precision suffices and halves the time.
    directions = half_sphere(2500).astype(np.float32)
    columns = np.ascontiguousarray((points - points.mean(axis=0)).T, np.float32)
    ends: set[int] = set()
    for start in range(0, len(directions), 16):
        along = directions[start : start + 16] @ columns
        ends.update(along.argmin(axis=1).tolist(), along.argmax(axis=1).tolist())
    return np.array(sorted(ends))


def half_sphere(num_directions: int) -> Float[np.ndarray, "directions 3"]:
    """Return unit vectors spread evenly over the half sphere z > 0, on a golden-angle spiral."""
    number = np.arange(num_directions) + 0.5
    z, angle = number / num_directions, np.pi * (3 - np.sqrt(5)) * number
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)


def hash_triangles(vertices: Vertices, faces: Faces) -> str:
    """Return the SHA-256 of vertices (float64) and faces (int32) as little-endian bytes, hex."""
    digest = hashlib.sha256(np.ascontiguousarray(vertices, "<f8").tobytes())
    digest.update(np.ascontiguousarray(faces, "<i4").tobytes())
    return digest.hexdigest()


def weld(vertices: Vertices, faces: Faces) -> tuple[Float[np.ndarray, "welded 3"], Faces]:
    """Merge vertices at exactly one position; faces that become degenerate remain."""
    # Adding 0.0 turns −0.0 into 0.0. np.unique(axis=0) would take ten times as long.
    positions = vertices + 0.0
    order = np.lexsort(positions.T[::-1])  # sort by x, then y, then z
    ranked = positions[order]
    new = np.ones(len(ranked), bool)
    new[1:] = (ranked[1:] != ranked[:-1]).any(axis=1)
    index = np.empty(len(ranked), np.int64)
    index[order] = np.cumsum(new) - 1
    return ranked[new], index[faces]


def connected(
    start: Int[np.ndarray, " links"], end: Int[np.ndarray, " links"], num_nodes: int
) -> tuple[int, Int[np.ndarray, " nodes"]]:
    """Return the number of connected components of a graph, and the component of each node."""
    links = (np.ones(len(start), bool), (start, end))
    graph = scipy.sparse.coo_array(links, shape=(num_nodes, num_nodes))
    count, components = scipy.sparse.csgraph.connected_components(graph, directed=False)
    return int(count), np.asarray(components, np.int64)


class SurfaceTree:
    """A triangle mesh for distance queries.

    A distance is computed to the triangles of the nearest surface points: it is never too small,
    and too large by at most the spacing of the surface points.

    Raises:
        ValueError: The triangles have no area.
    """

    def __init__(self, vertices: Vertices, faces: Faces) -> None:
        areas = face_areas(vertices, faces)
        if not areas.sum() > 0:
            raise ValueError(f"{len(faces)} triangles with a total area of {areas.sum()}")
        self.triangles = np.asarray(vertices, np.float64)[faces[areas > 0]]
        a, b, c = self.triangles.swapaxes(0, 1)
        normals = np.cross(b - a, c - a)
        self.areas = np.linalg.norm(normals, axis=1) / 2
        self.normals = normals / (2 * self.areas[:, None])
        points, self._owners = self.spread(NUM_COVERING, seed=17)
        # With corners and centres, every triangle of a fine mesh has a point.
        self._tree = scipy.spatial.KDTree(
            np.concatenate([points, a, b, c, self.triangles.mean(axis=1)]), balanced_tree=False
        )
        self._owners = np.concatenate([self._owners, *[np.arange(len(a))] * 4])

    def spread(self, num_points: int, seed: int) -> tuple[Points, Int[np.ndarray, " points"]]:
        """Return random surface points of nearly uniform density, and their triangle indices."""
        rng = np.random.default_rng(seed)
        cumulative = np.cumsum(self.areas)
        positions = (np.arange(num_points) + rng.random()) / num_points * cumulative[-1]
        owners = np.searchsorted(cumulative[:-1], positions, side="right")
        return _points_inside(self.triangles[owners], rng), owners

    def nearest(self, points: Points) -> tuple[Points, Points]:
        """Return approximately the nearest surface point to each point, and its unit normal."""
        owners = self._owners[self._tree.query(points)[1]]
        return _closest_on_triangles(points, self.triangles[owners]), self.normals[owners]

    def distances(
        self, points: Float[np.ndarray, "*batch 3"], neighbours: int = _NUM_NEIGHBOURS
    ) -> Float[np.ndarray, "*batch"]:
        """Return each point's distance to the triangles of ``neighbours`` nearby surface points."""
        flat = points.reshape(-1, 3)
        neighbour = self._tree.query(flat, k=np.arange(1, neighbours + 1))[1]
        triangles = self.triangles[self._owners[neighbour]]
        closest = _closest_on_triangles(flat[:, None], triangles)
        lengths = np.linalg.norm(flat[:, None] - closest, axis=-1).min(axis=1)
        return np.asarray(lengths.reshape(points.shape[:-1]))


def _closest_on_triangles(
    points: Float[np.ndarray, "*#batch 3"], triangles: Float[np.ndarray, "*batch 3 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """Return the point of each triangle that is closest to the corresponding point."""
    # The closest point is the foot of the perpendicular if inside, otherwise a point on an edge.
    a, b, c = triangles[..., 0, :], triangles[..., 1, :], triangles[..., 2, :]
    normal = np.cross(b - a, c - a)
    offset = points - a
    squared = (normal * normal).sum(-1)
    # Barycentric coordinates of the foot of the perpendicular.
    along_c = (np.cross(b - a, offset) * normal).sum(-1) / squared
    along_b = (np.cross(offset, c - a) * normal).sum(-1) / squared
    inside = (along_b >= 0) & (along_c >= 0) & (along_b + along_c <= 1)
    best = a + along_b[..., None] * (b - a) + along_c[..., None] * (c - a)
    shortest = np.where(inside, ((points - best) ** 2).sum(-1), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        share = ((points - start) * edge).sum(-1) / (edge * edge).sum(-1)
        on_edge = start + np.clip(share, 0, 1)[..., None] * edge
        length = ((points - on_edge) ** 2).sum(-1)
        closer = ~inside & (length < shortest)
        best = np.where(closer[..., None], on_edge, best)
        shortest = np.where(closer, length, shortest)
    return np.asarray(best)
