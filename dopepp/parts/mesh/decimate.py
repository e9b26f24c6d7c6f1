"""Decimation of meshes that have more triangles than an image has pixels.

The vertices in each cell of a cubic grid become one vertex at the least-squares intersection of the
planes of all triangles in the cell (quadric error metric: Garland and Heckbert 1997; in grid cells:
Lindstrom 2000), so that flat sides stay flat and edges sharp. No point moves by more than a cell's
diagonal.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Int

from dopepp.parts.mesh import Faces, Vertices, connected, face_areas

MAX_FACES: Final = 200_000
"""Most triangles of a part's mesh: more than one for two pixels at 640×480."""

_WELL_USED: Final = 0.85  # Share of the limit at which the search stops


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
    """Replace triangles by at most ``max_faces`` larger triangles.

    All ``faces`` must have an area. ``values`` are texture coordinates or colours, which remain
    separate at seams.

    Returns:
        New vertices, faces and values, and the largest distance that a vertex moved.

    Raises:
        ValueError: No grid leaves a triangle, because all are tiny and far apart.
    """
    cells, remaining = _cluster(vertices, faces, max_faces)
    placed = _cell_positions(vertices, faces, cells)
    moved = float(np.sqrt(np.square(placed[cells] - vertices).sum(axis=1).max()))
    owners = cells if values is None else _islands(faces, cells)
    # Each group becomes a vertex at the cell's position, with the mean values of the group.
    used, index = np.unique(owners[faces[remaining]], return_inverse=True)
    first = np.empty(int(owners.max()) + 1, np.int64)
    first[owners] = np.arange(len(owners))
    if values is not None:
        values = _means(values, owners)[used]
    return placed[cells[first[used]]], index.reshape(-1, 3), values, moved


def _cluster(
    vertices: Vertices, faces: Faces, max_faces: int
) -> tuple[Int[np.ndarray, " vertices"], Int[np.ndarray, " kept"]]:
    """Return each vertex's cell and the indices of kept triangles, at most ``max_faces``."""
    # A surface through a cell becomes two triangles.
    side = float(np.sqrt(2 * face_areas(vertices, faces).sum() / max_faces))
    best_cells, best_kept = np.zeros(len(vertices), np.int64), np.zeros(0, np.int64)
    for _ in range(12):
        cells = _cells(vertices, side)
        remaining = _select_triangles(cells[faces])
        if len(best_kept) < len(remaining) <= max_faces:
            best_cells, best_kept = cells, remaining
        if _WELL_USED * max_faces <= len(remaining) <= max_faces:
            break
        # The number of triangles falls with the square of a cell's side.
        aim = (1 + _WELL_USED) / 2 * max_faces
        side *= float(np.clip(np.sqrt(len(remaining) / aim), 0.25, 4.0))
    if len(best_kept) == 0:
        raise ValueError(f"{len(faces)} triangles that cannot be reduced to {max_faces}")
    return best_cells, best_kept


def _cells(vertices: Vertices, side: float) -> Int[np.ndarray, " vertices"]:
    """Return each vertex's cell in a cubic grid; cells with vertices are numbered from 0."""
    offsets = vertices - vertices.min(axis=0)
    # At most a million cells along the longest side keep cell numbers within an int64.
    indices = (offsets / max(side, 1e-6 * float(offsets.max()))).astype(np.int64)
    counts = indices.max(axis=0) + 1
    keys = (indices[:, 0] * counts[1] + indices[:, 1]) * counts[2] + indices[:, 2]
    return np.asarray(np.unique(keys, return_inverse=True)[1].reshape(-1), np.int64)


def _select_triangles(corners: Faces) -> Int[np.ndarray, " kept"]:
    """Return the indices of triangles over three cells, one per cell triple and orientation."""
    a, b, c = corners.T
    candidates = np.flatnonzero((a != b) & (b != c) & (c != a))
    a, b, c = corners[candidates].T
    # Each triangle starts at its lowest corner, so that equal triangles compare equal.
    shift = np.where((b < a) & (b < c), 1, np.where((c < a) & (c < b), 2, 0))[:, None]
    ordered = np.take_along_axis(corners[candidates], (shift + np.arange(3)) % 3, axis=1)
    order = np.lexsort(ordered.T)
    new = np.ones(len(order), bool)
    new[1:] = (np.diff(ordered[order], axis=0) != 0).any(axis=1)
    return np.sort(candidates[order[new]])


def _means(
    values: Float[np.ndarray, "values width"], owners: Int[np.ndarray, " values"]
) -> Float[np.ndarray, "owners width"]:
    counts = np.maximum(np.bincount(owners), 1)
    sums = [np.bincount(owners, column) for column in values.T]
    return np.stack(sums, axis=1) / counts[:, None]


def _cell_positions(
    vertices: Vertices, faces: Faces, cells: Int[np.ndarray, " vertices"]
) -> Float[np.ndarray, "cells 3"]:
    """Return the point of each cell nearest to the planes of its triangles, weighted by area²."""
    # With area-weighted normals n and vectors o from the cell's mean to the triangles, the offset x
    # from the mean solves Σ n nᵀ x = Σ n (n·o). It is clipped to the box of the cell's vertices.
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
    # The mean of the vertices decides in directions that the planes leave undetermined.
    pull = 1e-3 * np.trace(matrices, axis1=1, axis2=2)
    # Vertices without a triangle stay at their mean.
    pull = np.where(pull > 0, pull, 1.0)
    matrices += pull[:, None, None] * np.eye(3)
    offsets = np.linalg.solve(matrices, targets[..., None])[..., 0]
    return np.asarray(np.clip(means + offsets, lower, upper))


def _islands(faces: Faces, cells: Int[np.ndarray, " vertices"]) -> Int[np.ndarray, " vertices"]:
    """Return each vertex's group; a group is connected by edges within one cell."""
    start, end = faces.reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    inside = cells[start] == cells[end]
    return connected(start[inside], end[inside], len(cells))[1]
