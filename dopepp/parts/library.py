"""STL files: checked to be whole, then read by trimesh.

trimesh takes a file that ends too early for a smaller mesh; ``tests/parts/test_library.py`` holds
the cases. To add a format that trimesh reads, check its file first and hand it to
:func:`read_scene`.
"""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from dopepp.parts.measure import RawMesh, weld

MAX_TRIANGLES: Final = 5_000_000
"""Of all pieces, each counted as often as it is shown."""

_STL_HEADER: Final = 84
_STL_TRIANGLE: Final = 50
"""Bytes. A binary STL file is a title, the number of triangles (uint32), and the triangles."""

_FACET: Final = re.compile(rb"\bfacet\s+normal\b", re.IGNORECASE)
"""What begins a triangle in text."""


def read_scene(data: bytes, kind: str) -> tuple[RawMesh, int]:
    """Let trimesh read a file's content; without a path it can reach no other file.

    Returns:
        The meshes that it shows as one, with the unit as it names it, and their number.

    Raises:
        ValueError: A face has a vertex that its mesh has not, or there are too many triangles.
        Exception: Whatever trimesh makes of a damaged file.
    """
    import trimesh  # takes a while: only for those who read such a file

    # An infinite corner is named later, not in trimesh's own sums.
    with warnings.catch_warnings(), np.errstate(invalid="ignore", over="ignore"):
        # numpy stops at a damaged number with nothing but this warning.
        warnings.simplefilter("error", DeprecationWarning)
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False)
    vertices, faces = [np.empty((0, 3))], [np.empty((0, 3), np.int64)]
    uvs: list[Any] = []
    start = num_triangles = 0
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not hasattr(mesh, "faces"):
            continue  # lines and points
        if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
            raise ValueError(f"a face index outside of its {len(mesh.vertices)} vertices")
        num_triangles += len(mesh.faces)
        if num_triangles > MAX_TRIANGLES:
            raise ValueError(f"over {MAX_TRIANGLES} triangles")
        vertices.append(_moved(np.asarray(mesh.vertices), transform))
        faces.append(np.asarray(mesh.faces) + start)
        uvs.append(getattr(mesh.visual, "uv", None))
        start += len(mesh.vertices)
    uv = None if not uvs or any(uv is None for uv in uvs) else np.concatenate(uvs)
    if uv is not None and uv.shape != (start, 2):
        raise ValueError(f"{len(uv)} texture coordinates of {start} vertices")
    unit = scene.metadata.get("units")
    return RawMesh(np.concatenate(vertices), np.concatenate(faces), uv, unit=unit), len(uvs)


def _moved(
    vertices: Float[np.ndarray, "vertices 3"], transform: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "vertices 3"]:
    if (transform == np.eye(4)).all():
        return vertices  # as they are: a product would make NaN of an infinite one's neighbours
    # Not a product of matrices, whose last digits depend on the processor.
    rows = zip(vertices.T, transform[:3, :3].T, strict=True)
    return np.asarray(sum(x[:, None] * row for x, row in rows) + transform[:3, 3])


def read_stl(path: Path) -> RawMesh:
    """Read a binary or text STL file, with the corners that its triangles share merged.

    Raises:
        ValueError: The file is cut short, is longer than the number of its triangles says, or has a
            coordinate that is not finite.
    """
    data = path.read_bytes()
    num_triangles = int.from_bytes(data[_STL_HEADER - 4 : _STL_HEADER], "little")
    promised = _STL_HEADER + _STL_TRIANGLE * num_triangles
    # Binary headers may begin with the text format's "solid"; the length cannot be mistaken.
    is_text = len(data) != promised or not num_triangles
    if is_text and b"\0" in data:  # never in text
        raise ValueError(
            f"{len(data)} bytes where its header promises {num_triangles} triangles, "
            f"{promised} bytes"
        )
    (vertices, faces, *_), _ = read_scene(data, "stl")
    # trimesh leaves out a text file's last solid if it is cut short.
    begun = sum(1 for _ in _FACET.finditer(data)) if is_text else len(faces)
    if begun != len(faces):
        raise ValueError(f"{begun} facets begun and {len(faces)} ended")
    finite = np.isfinite(vertices).all(axis=1)
    if not finite.all():  # named here, where triangles have their numbers
        corner = int(np.flatnonzero(~finite[faces.reshape(-1)])[0])
        raise ValueError(
            f"a coordinate that is not a finite number, triangle {corner // 3 + 1}, "
            f"vertex {corner % 3 + 1}"
        )
    return RawMesh(*weld(vertices, faces))
