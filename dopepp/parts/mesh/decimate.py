"""Fewer triangles for a mesh that has more of them than any image has pixels for.

The vertices of each cell of a cubic grid become one, placed where it is nearest, in the least
squares, to the planes of all triangles that reach into the cell (quadric error metric: Garland and
Heckbert 1997; in the cells of a grid: Lindstrom 2000), so that flat sides stay flat and edges
sharp. This takes any triangles at all, with holes or without connection, in seconds, and moves no
point further than a cell's diagonal.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import scipy  # its parts load when they are used
from jaxtyping import Float, Int

from dopepp.parts.mesh import Faces, Vertices, face_areas

MAX_FACES: Final = 200_000
"""Triangles of a part's mesh: on a part that fills 640×480 pixels, over one for two pixels."""

_WELL_USED: Final = 0.85  # Share of the limit that is good enough to stop trying


def decimate(
    vertices: Vertices,
    faces: Faces,
    values: Float[np.ndarray, "vertices width"] | None,
    max_faces: int = MAX_FACES,
) -> tuple[
    Float[np.ndarray, "fewer 3"],
    Int[np.ndarray, "kept 3"],
    Float[np.ndarray, "fewer width"] | None,
    float,
]:
    """Replace triangles, which all have an area, by at most ``max_faces`` larger ones.

    ``values`` are texture coordinates or colours; vertices on both sides of a seam keep values of
    their own. The last of the returned values is the farthest move of a vertex.

    Raises:
        ValueError: No grid leaves a triangle, because all of them are tiny and apart.
    """
    cells, kept = _cluster(vertices, faces, max_faces)
    placed = _place(vertices, faces, cells)
    moved = float(np.sqrt(np.square(placed[cells] - vertices).sum(axis=1).max()))
    owners = cells if values is None else _islands(faces, cells)
    # One vertex per owner: its cell gives the position, the mean of its vertices the values.
    used, index = np.unique(owners[faces[kept]], return_inverse=True)
    first = np.empty(int(owners.max()) + 1, np.int64)
    first[owners] = np.arange(len(owners))
    if values is not None:
        values = _means(values, owners)[used]
    return placed[cells[first[used]]], index.reshape(-1, 3), values, moved


def _cluster(
    vertices: Vertices, faces: Faces, max_faces: int
) -> tuple[Int[np.ndarray, " vertices"], Int[np.ndarray, " kept"]]:
    """Return the cells, of the grid that leaves most triangles under the limit, and these."""
    # A square of a surface that passes through a cell becomes two triangles.
    side = float(np.sqrt(2 * face_areas(vertices, faces).sum() / max_faces))
    best_cells, best_kept = np.zeros(len(vertices), np.int64), np.zeros(0, np.int64)
    for _ in range(12):
        cells = _cells(vertices, side)
        kept = _surviving(cells[faces])
        if len(best_kept) < len(kept) <= max_faces:
            best_cells, best_kept = cells, kept
        if _WELL_USED * max_faces <= len(kept) <= max_faces:
            break
        # Their number falls with the square of the side; aim at the middle of the good range.
        aim = (1 + _WELL_USED) / 2 * max_faces
        side *= float(np.clip(np.sqrt(len(kept) / aim), 0.25, 4.0))
    if len(best_kept) == 0:
        raise ValueError(f"no {max_faces} triangles can stand for its {len(faces)}")
    return best_cells, best_kept


def _cells(vertices: Vertices, side: float) -> Int[np.ndarray, " vertices"]:
    """Return each vertex's cell in a grid; cells that hold a vertex are numbered from 0."""
    offsets = vertices - vertices.min(axis=0)
    # A million cells along the longest side keep the numbers of cells within an int64.
    places = (offsets / max(side, 1e-6 * float(offsets.max()))).astype(np.int64)
    counts = places.max(axis=0) + 1
    keys = (places[:, 0] * counts[1] + places[:, 1]) * counts[2] + places[:, 2]
    return np.asarray(np.unique(keys, return_inverse=True)[1].reshape(-1), np.int64)


def _surviving(corners: Faces) -> Int[np.ndarray, " kept"]:
    """Return one triangle for every three cells and direction around them."""
    a, b, c = corners.T
    candidates = np.flatnonzero((a != b) & (b != c) & (c != a))
    a, b, c = corners[candidates].T
    # Start at the lowest corner: a triangle's three ways to be written become one.
    turn = np.where((b < a) & (b < c), 1, np.where((c < a) & (c < b), 2, 0))[:, None]
    ordered = np.take_along_axis(corners[candidates], (turn + np.arange(3)) % 3, axis=1)
    order = np.lexsort(ordered.T)
    new = np.ones(len(order), bool)
    new[1:] = (np.diff(ordered[order], axis=0) != 0).any(axis=1)
    return np.sort(candidates[order[new]])


def _means(
    values: Float[np.ndarray, "values width"], owners: Int[np.ndarray, " values"]
) -> Float[np.ndarray, "owners width"]:
    """Return the mean of the values of each owner."""
    counts = np.maximum(np.bincount(owners), 1)
    sums = [np.bincount(owners, column) for column in values.T]
    return np.stack(sums, axis=1) / counts[:, None]


def _place(
    vertices: Vertices, faces: Faces, cells: Int[np.ndarray, " vertices"]
) -> Float[np.ndarray, "cells 3"]:
    """Return each cell's point nearest to the planes of the triangles in it, by squared area."""
    # With normals n of a triangle's area and o from the cell's mean to the triangle, the offset x
    # from that mean solves Σ n nᵀ x = Σ n (n·o). It stays within the box of the cell's vertices.
    means = _means(vertices, cells)
    lower, upper = means.copy(), means.copy()
    np.minimum.at(lower, cells, vertices)
    np.maximum.at(upper, cells, vertices)
    a, b, c = vertices[faces].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    products = normals[:, :, None] * normals[:, None, :]
    matrices, targets = np.zeros((len(means), 3, 3)), np.zeros((len(means), 3))
    for corner in range(3):
        owners = cells[faces[:, corner]]
        heights = np.einsum("fi,fi->f", normals, a - means[owners])
        for i in range(3):
            targets[:, i] += np.bincount(owners, normals[:, i] * heights, minlength=len(means))
            for j in range(3):
                matrices[:, i, j] += np.bincount(owners, products[:, i, j], minlength=len(means))
    # Where the planes leave a direction open, as on a flat side, the mean of the vertices decides.
    pull = 1e-3 * np.trace(matrices, axis1=1, axis2=2)
    # Vertices without any triangle stay at their mean.
    pull = np.where(pull > 0, pull, 1.0)
    matrices += pull[:, None, None] * np.eye(3)
    offsets = np.linalg.solve(matrices, targets[..., None])[..., 0]
    return np.asarray(np.clip(means + offsets, lower, upper))


def _islands(faces: Faces, cells: Int[np.ndarray, " vertices"]) -> Int[np.ndarray, " vertices"]:
    """Number the groups of vertices that edges within one cell connect."""
    start, end = faces.reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    inside = cells[start] == cells[end]
    edges = (np.ones(int(inside.sum()), bool), (start[inside], end[inside]))
    joined = scipy.sparse.coo_array(edges, shape=(len(cells), len(cells)))
    return np.asarray(
        scipy.sparse.csgraph.connected_components(joined, directed=False)[1], np.int64
    )
