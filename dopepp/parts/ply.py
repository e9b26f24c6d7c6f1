"""A strict PLY reader: text and both byte orders, polygons, any further elements and properties.

A reader of its own, because PLY files in the wild mix triangles with larger polygons, and because a
header's promises must be held against the file's length before anything is allocated.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray

from dopepp.parts.measure import RawMesh, first_folded_polygon
from dopepp.parts.ply_tables import Element, Property, read_tables
from dopepp.parts.texture import companion_path, read_texture

TYPES: Final = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
"""Numpy's names of PLY's types."""

ORDERS: Final = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
"""Byte order of each format; text is turned into little-endian doubles before it is read."""

_MAX_HEADER_BYTES: Final = 100_000
"""Hundreds of properties, and comments; a longer header would take hours to be understood."""

COORDINATES: Final = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
"""Names that programs give to a vertex's texture coordinates."""


def read_ply(path: Path) -> RawMesh:
    """Read a PLY file and the texture it names in a ``TextureFile`` comment.

    Raises:
        UserError: The texture is missing, damaged or outside of the folder.
        ValueError: The file is damaged, has no vertices or faces, has a polygon that is not convex,
            or names several textures, or one without texture coordinates per vertex.
    """
    header, body = _split(path.read_bytes())
    lines = [line.split() for line in header.decode("utf-8", "surrogateescape").splitlines()]
    is_text, elements = _parse_header(lines)
    tables = read_tables(_doubles(body) if is_text else body, elements)
    vertex, face = tables.get("vertex", {}), tables.get("face", {})
    list_name = "vertex_indices" if "vertex_indices" in face else "vertex_index"
    if not {"x", "y", "z"} <= set(vertex) or f"{list_name}#" not in face:
        raise ValueError("no vertex table with x, y, z or no face table with vertex_indices")
    vertices = np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], axis=1)
    faces, polygons = _fans(face[list_name], face[f"{list_name}#"])
    # A wrong index is the caller's to name.
    if faces.size and faces.min() >= 0 and faces.max() < len(vertices):
        folded = first_folded_polygon(vertices, faces, polygons)
        if folded is not None:
            raise ValueError(f"a polygon that is not convex, face {folded}")
    names = [" ".join(words[2:]) for words in lines if words[:2] == ["comment", "TextureFile"]]
    if not names:
        return vertices, faces, None, None
    pairs = [pair for pair in COORDINATES if {*pair} <= set(vertex)]
    if len(names) > 1 or not pairs:
        raise ValueError(f"{len(names)} textures, {'one set of' if pairs else 'no'} uv per vertex")
    uv = np.stack([np.asarray(vertex[axis], np.float64) for axis in pairs[0]], axis=1)
    return vertices, faces, uv, read_texture(companion_path(path, names[0], "TextureFile"))


def _split(data: bytes) -> tuple[bytes, bytes]:
    """Cut behind the header's last line, which ends in LF, CR LF or CR."""
    header, mark, rest = data.partition(b"end_header")
    if not mark or not data.startswith(b"ply"):
        raise ValueError("no PLY header")
    if len(header) > _MAX_HEADER_BYTES:
        raise ValueError(f"a header of {len(header)} bytes, over {_MAX_HEADER_BYTES}")
    line_end = b"\r\n" if rest.startswith(b"\r\n") else rest[:1]
    if line_end not in (b"\r\n", b"\n", b"\r"):
        raise ValueError("a header without an end")
    return header, rest[len(line_end) :]


def _parse_header(lines: list[list[str]]) -> tuple[bool, list[Element]]:
    """Return whether the body is text, and its elements."""
    formats = [words[1] for words in lines if words[:1] == ["format"]]
    if len(formats) != 1 or formats[0] not in ORDERS:
        raise ValueError(f"format {formats} where one of {', '.join(ORDERS)} must stand")
    is_text, order = formats[0] == "ascii", ORDERS[formats[0]]
    elements: list[Element] = []
    for words in lines:
        if words[:1] == ["element"]:
            elements.append(Element(words[1], int(words[2]), ()))
        elif words[:1] == ["property"]:
            types = words[2:-1] if words[1] == "list" else words[1:-1]
            dtypes = [order + TYPES[name] for name in types]
            dtypes = ["<f8"] * len(dtypes) if is_text else dtypes
            count_type = dtypes[0] if words[1] == "list" else None
            column = Property(words[-1], dtypes[-1], count_type)
            last = elements.pop()
            elements.append(Element(last.name, last.num_rows, (*last.properties, column)))
    for element in elements:
        names = [column.name for column in element.properties]
        if element.num_rows < 0 or not names or len(set(names)) < len(names):
            raise ValueError(f"element {element.name} with {element.num_rows} rows of {names}")
    return is_text, elements


def _doubles(text: bytes) -> bytes:
    """Turn a text body into its numbers, one behind the other."""
    with warnings.catch_warnings():
        # Numpy stops at what is no number with nothing but this warning.
        warnings.simplefilter("error", DeprecationWarning)
        numbers = np.fromstring(text.decode("ascii").strip() or "0", np.float64, sep=" ")
    return numbers.astype("<f8").tobytes() if text.strip() else b""


def _fans(
    indices: NDArray[Any], counts: NDArray[Any]
) -> tuple[Int[np.ndarray, "faces 3"], Int[np.ndarray, " faces"]]:
    """Cut polygons into fans around their first corner; return the polygon of each triangle too."""
    counts = counts.astype(np.int64)
    if (counts < 3).any():
        raise ValueError(f"face {int((counts < 3).argmax())} of fewer than 3 corners")
    if (indices != indices.astype(np.int64)).any():
        raise ValueError("a vertex index that is no integer")
    starts = np.cumsum(counts) - counts
    polygons = np.repeat(np.arange(len(counts)), counts - 2)
    first = starts[polygons]
    # The how-many-th triangle of its polygon each one is.
    turn = np.arange(len(polygons)) - (np.cumsum(counts - 2) - (counts - 2))[polygons]
    corners = np.stack([first, first + turn + 1, first + turn + 2], axis=1)
    return indices.astype(np.int64)[corners], polygons
