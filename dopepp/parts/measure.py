"""What is measured on triangles: areas, surface samples, the largest distance, a hash.

Lengths come out in the unit they go in. Arrays rather than a :class:`~dopepp.parts.part.Mesh`, so
that a file's raw triangles can be measured before they are known to be a usable mesh.
"""

from __future__ import annotations

import hashlib
from typing import Final

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull
from scipy.spatial.distance import cdist

NUM_SURFACE_POINTS: Final = 2000
"""ADD points of a CAD part, a fixed number so that the results of two runs compare."""

SURFACE_SEED: Final = 2000
"""Fixed seed of the surface samples: the same mesh has the same ADD points everywhere."""


def face_areas(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, " faces"]:
    """Return the area of each triangle."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


def sample_surface(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    num_points: int = NUM_SURFACE_POINTS,
    seed: int = SURFACE_SEED,
) -> Float[np.ndarray, "points 3"]:
    """Draw points uniformly over the surface: by area, and the same ones for the same seed.

    Raises:
        ValueError: The triangles have no area.
    """
    rng = np.random.default_rng(seed)
    cumulative = np.cumsum(face_areas(vertices, faces))
    if not cumulative[-1] > 0:
        raise ValueError(f"{len(faces)} triangles with a total area of {cumulative[-1]}")
    # Without the last bound, a product that rounds up to the total still falls into a triangle.
    bounds = cumulative[:-1]
    chosen = np.searchsorted(bounds, rng.random(num_points) * cumulative[-1], side="right")
    a, b, c = vertices[faces[chosen]].swapaxes(0, 1)
    # √ makes the share of points between a and a parallel to bc equal to the share of area there.
    root, along = np.sqrt(rng.random((num_points, 1))), rng.random((num_points, 1))
    return np.asarray((1 - root) * a + root * (1 - along) * b + root * along * c)


def largest_distance(points: Float[np.ndarray, "points 3"]) -> float:
    """Return the exact largest distance between two points.

    The two farthest points are vertices of the convex hull. Flat and straight sets have no hull in
    space, so it is taken in the subspace that the points span.
    """
    offsets = points - points.mean(axis=0)
    _, spread, axes = np.linalg.svd(offsets, full_matrices=False)
    # Leaving out a thickness of 1e-6 of the length changes the distance by 1e-12 of it.
    rank = int((spread > 1e-6 * spread[0]).sum())
    if rank == 0:
        return 0.0
    if rank == 1:
        along = offsets @ axes[0]
        corners = points[[along.argmin(), along.argmax()]]
    else:
        corners = points[ConvexHull(offsets @ axes[:rank].T).vertices]
    # 512 rows at a time keep the distances of a 100,000-vertex hull under 0.5 GB.
    blocks = (corners[start : start + 512] for start in range(0, len(corners), 512))
    return float(max(cdist(block, corners).max() for block in blocks))


def hash_triangles(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> str:
    """Return the SHA-256 of vertices (float64) and faces (int32) as little-endian bytes, hex."""
    digest = hashlib.sha256(np.ascontiguousarray(vertices, "<f8").tobytes())
    digest.update(np.ascontiguousarray(faces, "<i4").tobytes())
    return digest.hexdigest()


def weld(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> tuple[Float[np.ndarray, "welded 3"], Int[np.ndarray, "faces 3"]]:
    """Merge vertices at the same position; faces that lose a corner by it remain, flat."""
    # Adding 0.0 turns −0.0 into 0.0, which sorting would keep apart.
    welded, index = np.unique(vertices + 0.0, axis=0, return_inverse=True)
    return welded, index.reshape(-1)[faces]


def first_folded_polygon(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    polygons: Int[np.ndarray, " faces"],
) -> int | None:
    """Return a polygon whose fan of triangles folds over, so that it is not the polygon's area.

    Args:
        vertices: Positions.
        faces: The fans' triangles.
        polygons: The polygon each triangle was cut from.

    Returns:
        The first such polygon's number in ``polygons``, None where there is none.
    """
    polygon_ids, index = np.unique(polygons, return_inverse=True)
    if len(polygon_ids) == len(faces):
        return None
    a, b, c = vertices[faces].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    totals = np.zeros((len(polygon_ids), 3))
    np.add.at(totals, index, normals)
    alignment = np.einsum("fi,fi->f", normals, totals[index])
    # A triangle that is flat but for rounding may point anywhere.
    folded = alignment < -1e-9 * np.einsum("pi,pi->p", totals, totals)[index]
    return int(polygons[folded.argmax()]) if folded.any() else None
