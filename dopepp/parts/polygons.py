"""Polygons of a mesh file: cut into fans of triangles, where a fan is the polygon's area."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def fans(
    counts: Int[np.ndarray, " polygons"],
) -> tuple[Int[np.ndarray, "triangles 3"], Int[np.ndarray, " triangles"]]:
    """Cut polygons into fans around their first corner.

    Args:
        counts: Corners of each polygon.

    Returns:
        Triangles as places in the row of all polygons' corners; the polygon each is cut from.

    Raises:
        ValueError: A polygon has fewer than three corners.
    """
    if (counts < 3).any():
        raise ValueError(f"face {int((counts < 3).argmax())} of fewer than 3 corners")
    polygons = np.repeat(np.arange(len(counts)), counts - 2)
    first = (np.cumsum(counts) - counts)[polygons]
    # The how-many-th triangle of its polygon each one is.
    turn = np.arange(len(polygons)) - (np.cumsum(counts - 2) - (counts - 2))[polygons]
    return np.stack([first, first + turn + 1, first + turn + 2], axis=1), polygons


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
        The first such polygon's number in ``polygons``; None where there is none, or where a face
        has a vertex that is not there, which is the caller's to name.
    """
    polygon_ids, index = np.unique(polygons, return_inverse=True)
    if len(polygon_ids) == len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
        return None
    a, b, c = vertices[faces].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    totals = np.zeros((len(polygon_ids), 3))
    np.add.at(totals, index, normals)
    alignment = np.einsum("fi,fi->f", normals, totals[index])
    # A triangle that is flat but for rounding may point anywhere.
    folded = alignment < -1e-9 * np.einsum("pi,pi->p", totals, totals)[index]
    # A bow tie's two halves cancel out.
    parts = np.bincount(index, np.einsum("fi,fi->f", normals, normals))
    cancelled = np.einsum("pi,pi->p", totals, totals) <= 1e-9 * parts
    tiny = 1e-12 * np.square(np.ptp(vertices, axis=0)).sum()
    folded |= (cancelled & (parts > tiny * tiny))[index]
    return int(polygons[folded.argmax()]) if folded.any() else None
