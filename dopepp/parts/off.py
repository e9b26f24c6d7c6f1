"""OFF files: text of vertices and polygons.

trimesh does not read them: of a file that is cut short it makes a smaller mesh, and with numpy 2 it
fails at polygons of more than four corners (``tests/parts/test_library.py``).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import numpy as np

from dopepp.parts.measure import RawMesh
from dopepp.parts.polygons import fans, first_folded_polygon

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
