"""STL and PLY readers: trimesh parses, and what it would let pass without a word is refused.

Readers return vertices in the file's unit, faces, uv and texture, and raise for a damaged file; to
:func:`~dopepp.parts.mesh.read_mesh`, which calls them, any exception means a damaged file.
"""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from dopepp.parts.measure import weld
from dopepp.parts.texture import companion_path, read_texture

RawMesh = tuple[
    Float[np.ndarray, "vertices 3"],
    Int[np.ndarray, "faces 3"],
    Float[np.ndarray, "vertices 2"] | None,
    UInt8[np.ndarray, "height width 3"] | None,
]


def read_stl(path: Path) -> RawMesh:
    """Read a binary or text STL file, with the corners that its triangles share merged.

    Raises:
        ValueError: The file is cut short.
    """
    data = path.read_bytes()
    vertices, faces, _ = _parse(data, "stl")
    # A binary file's length follows from its header; trimesh leaves out a text file's last solid
    # if it is cut short.
    is_binary = len(data) == 84 + 50 * int.from_bytes(data[80:84], "little")
    written = len(faces) if is_binary else data.lower().count(b"facet normal")
    if written != len(faces):
        raise ValueError(f"{written} facets begun and {len(faces)} ended")
    return *weld(vertices, faces), None, None


def read_ply(path: Path) -> RawMesh:
    """Read a binary or text PLY file and the texture it names in a ``TextureFile`` comment.

    Raises:
        UserError: The texture is missing, damaged or outside of the folder.
        ValueError: The file is cut short, names several textures, or one without coordinates.
    """
    data = path.read_bytes()
    header, _, body = data.partition(b"end_header")
    lines = [line.split() for line in header.decode("utf-8", "surrogateescape").splitlines()]
    if ["format", "ascii"] in [words[:2] for words in lines]:
        _check_text_ply(lines, body)
    vertices, faces, uv = _parse(data, "ply")
    names = [" ".join(words[2:]) for words in lines if words[:2] == ["comment", "TextureFile"]]
    if not names:
        return vertices, faces, None, None
    if len(names) > 1 or uv is None:
        raise ValueError(f"{len(names)} textures, {'no' if uv is None else 'one set of'} uv")
    return vertices, faces, uv, read_texture(companion_path(path, names[0], "TextureFile"))


def _check_text_ply(header: list[list[str]], body: bytes) -> None:
    """Raise where lines or a last face's corners are missing: trimesh returns the rest."""
    elements = [words for words in header if words[:1] == ["element"]]
    declared = sum(int(words[2]) for words in elements)
    lines = [line for line in body.splitlines() if line.strip()]
    if len(lines) < declared:
        raise ValueError(f"{len(lines)} of {declared} lines of data")
    if elements and elements[-1][1] == "face" and lines:
        num_corners, *corners = lines[-1].split()
        if len(corners) < int(num_corners):
            raise ValueError(f"{len(corners)} of {int(num_corners)} corners of the last face")


def _parse(
    data: bytes, file_type: str
) -> tuple[
    Float[np.ndarray, "vertices 3"],
    Int[np.ndarray, "faces 3"],
    Float[np.ndarray, "vertices 2"] | None,
]:
    """Return vertices, faces and uv; trimesh raises a different type for every kind of damage."""
    import trimesh  # takes a second: only for those who read such a file

    with warnings.catch_warnings():
        # numpy stops at a damaged number with nothing but this warning.
        warnings.simplefilter("error", DeprecationWarning)
        # Bytes without a resolver: trimesh can reach no other file.
        loaded = trimesh.load(
            io.BytesIO(data),
            file_type=file_type,
            force="mesh",
            process=False,
            skip_materials=True,
        )
    vertices = np.asarray(loaded.vertices, np.float64).reshape(-1, 3)
    faces = np.asarray(loaded.faces, np.int64).reshape(-1, 3)
    return vertices, faces, getattr(loaded.visual, "uv", None)
