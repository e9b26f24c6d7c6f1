"""OFF files: text of vertices and polygons.

trimesh does not read them: of a file that is cut short it makes a smaller mesh, and with numpy 2 it
fails at polygons of more than four corners (``tests/parts/test_library.py``).

Polygons of a mesh file: cut into fans of triangles, where a fan is the polygon's area.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float, Int

from dopepp.parts.mesh.measure import RawMesh


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


MAX_BYTES: Final = 50_000_000
"""Its words take fifteen times as much memory."""


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
    triangles, index = fans(np.array([count for count, *_ in polygons], np.int64))
    faces = np.array([i for _, *corners in polygons for i in corners], np.int64)[triangles]
    folded = first_folded_polygon(vertices, faces, index)
    if folded is not None:
        raise ValueError(f"a polygon that is not convex, face {folded}")
    return RawMesh(vertices, faces)
