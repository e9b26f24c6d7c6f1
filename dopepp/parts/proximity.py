"""How far points lie from a surface: exact distances to triangles, the nearest found by a tree."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from dopepp.parts.measure import face_areas

NUM_COVERING: Final = 60_000
"""Surface points in the tree, besides vertices: about 0.6 % of a compact part's diameter apart."""

_COVERING_SEED: Final = 17
_NUM_NEIGHBOURS: Final = 6
"""Surface points whose triangles are measured: the nearest point's own is not always the nearest
triangle along an edge."""


class Surface:
    """A triangle mesh that answers how far points are from it.

    A point is measured against the triangles of its nearest surface points, so that its distance
    is never too small, and too large by no more than the surface points are apart.

    Args:
        vertices: Positions in any unit.
        faces: Triangles.

    Raises:
        ValueError: The triangles have no area.
    """

    def __init__(
        self, vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
    ) -> None:
        areas = face_areas(vertices, faces)
        if not areas.sum() > 0:
            raise ValueError(f"{len(faces)} triangles with a total area of {areas.sum()}")
        self.triangles = np.asarray(vertices, np.float64)[faces[areas > 0]]
        a, b, c = self.triangles.swapaxes(0, 1)
        normals = np.cross(b - a, c - a)
        self.areas = np.linalg.norm(normals, axis=1) / 2
        self.normals = normals / (2 * self.areas[:, None])
        points, self._owners = self.spread(NUM_COVERING, _COVERING_SEED)
        own = np.arange(len(a))
        # Corners and centres give each triangle of a fine mesh a point of its own.
        self._tree = KDTree(
            np.concatenate([points, a, b, c, self.triangles.mean(axis=1)]), balanced_tree=False
        )
        self._owners = np.concatenate([self._owners, own, own, own, own])

    def spread(
        self, num_points: int, seed: int
    ) -> tuple[Float[np.ndarray, "points 3"], Int[np.ndarray, " points"]]:
        """Spread points over the surface, more evenly than at random, and name their triangles.

        The places along the summed area are equally spaced, those within the triangle random.
        """
        rng = np.random.default_rng(seed)
        cumulative = np.cumsum(self.areas)
        places = (np.arange(num_points) + rng.random()) / num_points * cumulative[-1]
        owners = np.searchsorted(cumulative[:-1], places, side="right")
        a, b, c = self.triangles[owners].swapaxes(0, 1)
        root, along = np.sqrt(rng.random((num_points, 1))), rng.random((num_points, 1))
        return (1 - root) * a + root * (1 - along) * b + root * along * c, owners

    def nearest(
        self, points: Float[np.ndarray, "points 3"]
    ) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points 3"]]:
        """Return the surface point nearest to each point, roughly, and the normal there."""
        owners = self._owners[self._tree.query(points)[1]]
        return _closest_on_triangles(points, self.triangles[owners]), self.normals[owners]

    def distances(
        self, points: Float[np.ndarray, "*batch 3"], neighbours: int = _NUM_NEIGHBOURS
    ) -> Float[np.ndarray, "*batch"]:
        """Return the distance of each point from the surface."""
        flat = points.reshape(-1, 3)
        found = self._tree.query(flat, k=np.arange(1, neighbours + 1))[1]
        triangles = self.triangles[self._owners[found]]
        closest = _closest_on_triangles(flat[:, None], triangles)
        lengths = np.linalg.norm(flat[:, None] - closest, axis=-1).min(axis=1)
        return np.asarray(lengths.reshape(points.shape[:-1]))


def _closest_on_triangles(
    points: Float[np.ndarray, "*#batch 3"], triangles: Float[np.ndarray, "*batch 3 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """Return the point of each triangle that is closest to a point.

    It is the foot of the perpendicular where that falls inside, else on one of the three edges.
    """
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
