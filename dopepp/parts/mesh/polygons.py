"""Polygons cut into triangles, and OFF files, which hold nothing else.

trimesh does not read OFF files: of one that is cut short it makes a smaller mesh, and it fails at
polygons of more than four corners (``tests/parts/mesh/test_library.py``).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Bool, Int

from dopepp.parts.mesh.measure import Faces, RawMesh, Vertices

MAX_BYTES: Final = 50_000_000
"""Of an OFF file: its words take fifteen times as much memory."""


class FoldedPolygonError(ValueError):
    """The polygon of a number, from 0, is not convex: its fan of triangles is not its area."""

    def __init__(self, number: int) -> None:
        super().__init__(f"a polygon that is not convex, face {number}")
        self.number = number


def read_off(path: Path) -> RawMesh:
    """Read an OFF file of triangles and convex polygons; colours are left out.

    Raises:
        ValueError: The file has other lines than it promises, a line fewer numbers than it
            promises, or a polygon is not convex.
    """
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"over {MAX_BYTES / 1e6:.0f} MB of text")
    header, mark, text = re.sub("#.*", "", path.read_text("utf-8")).partition("OFF")
    if not mark or header.strip() not in ("", "C"):
        raise ValueError("no OFF header")
    promised, *rows = [line.split() for line in text.splitlines() if line.strip()]
    num_vertices, num_faces = map(int, promised[:2])
    if min(num_vertices, num_faces) < 0 or len(rows) != num_vertices + num_faces:
        raise ValueError(
            f"{len(rows)} lines where its header promises {num_vertices} vertices and "
            f"{num_faces} faces"
        )
    vertices = np.array([row[:3] for row in rows[:num_vertices]], np.float64).reshape(-1, 3)
    polygons = [[int(word) for word in row[: int(row[0]) + 1]] for row in rows[num_vertices:]]
    for number, (count, *corners) in enumerate(polygons):
        if len(corners) != count:
            raise ValueError(f"face {number} of {count} corners, {len(corners)} in its line")
    counts = np.array([count for count, *_ in polygons], np.int64)
    row_of_corners = np.array([i for _, *corners in polygons for i in corners], np.int64)
    return RawMesh(vertices, row_of_corners[fans(vertices, row_of_corners, counts)])


def fans(
    vertices: Vertices, corners: Int[np.ndarray, " corners"], counts: Int[np.ndarray, " polygons"]
) -> Int[np.ndarray, "triangles 3"]:
    """Cut polygons into fans of triangles around their first corners, as places in ``corners``.

    ``corners`` has the vertex at each corner, one polygon behind the other; ``counts`` the corners
    of each.

    Raises:
        ValueError: A polygon has fewer than three corners or, as a :class:`FoldedPolygonError`, is
            not convex. A vertex that is not there is the caller's to name.
    """
    if (counts < 3).any():
        raise ValueError(f"face {int((counts < 3).argmax())} of fewer than 3 corners")
    polygons = np.repeat(np.arange(len(counts)), counts - 2)
    first = (np.cumsum(counts) - counts)[polygons]
    # The how-many-th triangle of its polygon each one is.
    turn = np.arange(len(polygons)) - (np.cumsum(counts - 2) - (counts - 2))[polygons]
    triangles = np.stack([first, first + turn + 1, first + turn + 2], axis=1)
    faces = corners[triangles]
    if (counts > 3).any() and 0 <= faces.min() <= faces.max() < len(vertices):
        folded = _folded(vertices, faces, polygons)
        if folded.any():
            raise FoldedPolygonError(int(polygons[folded.argmax()]))
    return triangles


def _folded(
    vertices: Vertices, faces: Faces, polygons: Int[np.ndarray, " faces"]
) -> Bool[np.ndarray, " faces"]:
    """Tell triangles that face against their polygon, or whose polygon cancels out."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    totals = np.zeros((int(polygons[-1]) + 1, 3))
    np.add.at(totals, polygons, normals)
    squared = np.einsum("pi,pi->p", totals, totals)
    # A triangle that is flat but for rounding may point anywhere.
    folded = np.einsum("fi,fi->f", normals, totals[polygons]) < -1e-9 * squared[polygons]
    # A bow tie's two halves cancel out.
    parts = np.bincount(polygons, np.einsum("fi,fi->f", normals, normals))
    tiny = 1e-12 * np.square(np.ptp(vertices, axis=0)).sum()
    cancelled = (squared <= 1e-9 * parts) & (parts > tiny * tiny)
    return np.asarray(folded | cancelled[polygons])
