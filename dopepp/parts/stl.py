"""STL files, binary and text, with what a parser would let pass without a word refused."""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float, Int

from dopepp.parts.measure import RawMesh, weld

_FACET: Final = re.compile(rb"\bfacet\s+normal\b", re.IGNORECASE)
"""What begins a triangle in text."""

_STL_HEADER: Final = 80
_STL_TRIANGLE: Final = np.dtype(
    [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
)
"""A binary STL file is a header, the number of triangles (uint32), and 50 bytes per triangle."""


def read_stl(path: Path) -> RawMesh:
    """Read a binary or text STL file, with the corners that its triangles share merged.

    Raises:
        ValueError: The file is cut short, is longer than the number of its triangles says, or has a
            coordinate that is not finite.
    """
    data = path.read_bytes()
    start = _STL_HEADER + 4
    num_triangles = int.from_bytes(data[_STL_HEADER:start], "little")
    # Binary headers may begin with the text format's "solid"; the length cannot be mistaken.
    if len(data) == start + num_triangles * _STL_TRIANGLE.itemsize and num_triangles:
        corners = np.frombuffer(data, _STL_TRIANGLE, offset=start)["corners"].reshape(-1, 3)
        faces = np.arange(len(corners)).reshape(-1, 3)
        return RawMesh(*_welded(corners.astype(np.float64), faces))
    if b"\0" in data:  # never in text
        raise ValueError(
            f"{len(data)} bytes where its header promises {num_triangles} triangles, "
            f"{start + num_triangles * _STL_TRIANGLE.itemsize} bytes"
        )
    vertices, faces = _parse_text(data)
    # trimesh leaves out a text file's last solid if it is cut short.
    begun = sum(1 for _ in _FACET.finditer(data))
    if begun != len(faces):
        raise ValueError(f"{begun} facets begun and {len(faces)} ended")
    return RawMesh(*_welded(vertices, faces))


def _welded(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> tuple[Float[np.ndarray, "welded 3"], Int[np.ndarray, "faces 3"]]:
    """Merge shared corners; a corner nowhere is named here, where triangles have their numbers."""
    finite = np.isfinite(vertices).all(axis=1)
    if not finite.all():
        corner = int(np.flatnonzero(~finite[faces.reshape(-1)])[0])
        raise ValueError(
            f"a coordinate that is not a finite number, triangle {corner // 3 + 1}, "
            f"vertex {corner % 3 + 1}"
        )
    return weld(vertices, faces)


def _parse_text(
    data: bytes,
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Return vertices and faces; trimesh raises a different type for every kind of damage."""
    import trimesh  # takes a second: only for those who read such a file

    # An infinite corner is named later, not in the parser's own sums.
    with warnings.catch_warnings(), np.errstate(invalid="ignore", over="ignore"):
        # numpy stops at a damaged number with nothing but this warning.
        warnings.simplefilter("error", DeprecationWarning)
        # Bytes without a resolver: trimesh can reach no other file.
        loaded = trimesh.load(
            io.BytesIO(data),
            file_type="stl_ascii",
            force="mesh",
            process=False,
            skip_materials=True,
        )
    vertices = np.asarray(loaded.vertices, np.float64).reshape(-1, 3)
    return vertices, np.asarray(loaded.faces, np.int64).reshape(-1, 3)
