"""PLY files: text and both byte orders, polygons, any further elements and properties.

trimesh is not used here (``tests/parts/mesh/test_library.py``): it refuses or misreads binary files
of triangles and quads, reads a truncated text as a smaller mesh, and orders a quad's triangles
differently, which changes the mesh's hash. plyfile's licence is the GPL.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dopepp.parts.mesh.obj import companion_path, fans, read_texture
from dopepp.parts.part import RawMesh

TYPES: Final = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
"""Numpy's names of PLY's types."""

ORDERS: Final = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
"""Byte order of each format; text is converted to little-endian doubles first."""

_MAX_HEADER_BYTES: Final = 100_000  # hundreds of properties; more could take hours to parse

MAX_UNEVEN_ROWS: Final = 2_000_000
"""Most rows with lists of different lengths, which are read singly (seconds, 0.5 GB)."""

COLOURS: Final = ("red", "green", "blue")
NORMALS: Final = ("nx", "ny", "nz")
COORDINATES: Final = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
"""Names of a vertex's colour, normal and texture coordinates."""

_ROUNDING: Final = 1e-3  # Share of the range by which a colour may exceed it, due to rounding


class PlyProperty(NamedTuple):
    """A property: name, number type (double in text), list length type or None, declared type."""

    name: str
    number: np.dtype[Any]
    length: np.dtype[Any] | None
    declared: str


class Element(NamedTuple):
    """A table of vertices, faces or other items, with the number of rows in the header."""

    name: str
    num_rows: int
    columns: list[PlyProperty]


Table = dict[str, NDArray[Any]]
"""Values of each property; for a list, all values concatenated, and lengths under ``NAME#``."""


def read_ply(path: Path) -> RawMesh:
    """Read a PLY file with its vertices' colours and normals.

    A texture, named by a ``TextureFile`` comment, replaces the colours.

    Raises:
        UserError: The texture is missing, damaged or outside the mesh's folder.
        ValueError: The file is damaged or has no vertices or faces, a polygon is not convex, a
            colour is out of range, or there are several textures or no texture coordinates.
    """
    header, body = _split(path.read_bytes())
    lines = [line.split() for line in header.decode("utf-8", "surrogateescape").splitlines()]
    tables: dict[str, Table] = {}
    start, (is_text, elements) = 0, _parse_header(lines)
    body = _doubles(body) if is_text else body
    for element in elements:
        tables[element.name], start = _read_table(body, start, element)
    if start != len(body):
        raise ValueError(f"{len(body) - start} bytes more than stated in its header")
    vertex, face = tables.get("vertex", {}), tables.get("face", {})
    list_name = "vertex_indices" if "vertex_indices" in face else "vertex_index"
    if not {"x", "y", "z"} <= set(vertex) or f"{list_name}#" not in face:
        raise ValueError("no vertex table with x, y, z or no face table with vertex_indices")
    vertices = np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(np.float64)
    corners = face[list_name].astype(np.int64)
    if (corners != face[list_name]).any():
        raise ValueError("a vertex index that is not an integer")
    faces = corners[fans(vertices, corners, face[f"{list_name}#"].astype(np.int64))]
    names = [" ".join(words[2:]) for words in lines if words[:2] == ["comment", "TextureFile"]]
    normals = _vectors(vertex, NORMALS)
    if not names:
        colours = _colours(vertex, elements)
        return RawMesh(vertices, faces, colours=colours, normals=normals)
    pairs = [pair for pair in COORDINATES if {*pair} <= set(vertex)]
    if len(names) > 1 or not pairs:
        raise ValueError(f"{len(names)} textures, {'one set of' if pairs else 'no'} uv per vertex")
    uv = np.stack([vertex[axis] for axis in pairs[0]], axis=1).astype(np.float64)
    texture = read_texture(companion_path(path, names[0], "TextureFile"))
    return RawMesh(vertices, faces, uv, texture, normals=normals)


def _vectors(vertex: Table, names: Sequence[str]) -> NDArray[np.float64] | None:
    if not {*names} <= set(vertex):
        return None
    return np.stack([vertex[name] for name in names], axis=1).astype(np.float64)


def _colours(vertex: Table, elements: Sequence[Element]) -> NDArray[np.uint8] | None:
    """Return sRGB vertex colours, 0 – 255; None if missing or uniform grey, a common default."""
    values = _vectors(vertex, COLOURS)
    if values is None or not len(values):
        return None
    columns = [column for e in elements if e.name == "vertex" for column in e.columns]
    kinds = {column.declared for column in columns if column.name in COLOURS}
    most = 255.0
    if kinds <= {"float", "float32", "double", "float64"}:
        most = 1.0
    elif kinds <= {"ushort", "uint16"} and values.max() > most:
        most = 65_535.0
    if not (np.abs(values / most - 0.5) <= 0.5 + _ROUNDING).all():
        raise ValueError(f"a vertex colour that is not from 0 to {most:g}")
    colours = np.rint(np.clip(values * (255.0 / most), 0, 255)).astype(np.uint8)
    return None if (colours == colours[0, 0]).all() else colours


def _split(data: bytes) -> tuple[bytes, bytes]:
    """Split the header, whose last line ends in LF, CR LF or CR, from the body."""
    header, mark, rest = data.partition(b"end_header")
    if not mark or not data.startswith(b"ply"):
        raise ValueError("no PLY header")
    if len(header) > _MAX_HEADER_BYTES:
        raise ValueError(f"a header of {len(header)} bytes, over {_MAX_HEADER_BYTES}")
    for line_end in (b"\r\n", b"\n", b"\r"):
        if rest.startswith(line_end):
            return header, rest[len(line_end) :]
    raise ValueError("a header without an end")


def _parse_header(lines: list[list[str]]) -> tuple[bool, list[Element]]:
    formats = [words[1] for words in lines if words[:1] == ["format"]]
    if len(formats) != 1 or formats[0] not in ORDERS:
        raise ValueError(f"format {formats}, not one of {', '.join(ORDERS)}")
    is_text, order = formats[0] == "ascii", ORDERS[formats[0]]
    elements: list[Element] = []
    for words in lines:
        if words[:1] == ["element"]:
            elements.append(Element(words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            is_list = words[1] == "list"
            written = [order + TYPES[name] for name in words[2 if is_list else 1 : -1]]
            types = [np.dtype("<f8" if is_text else name) for name in written]
            column = PlyProperty(words[-1], types[-1], types[0] if is_list else None, words[-2])
            elements[-1].columns.append(column)
    for name, num_rows, columns in elements:
        names = [column.name for column in columns]
        if num_rows < 0 or not names or len(set(names)) < len(names):
            raise ValueError(f"element {name} with {num_rows} rows of {names}")
    return is_text, elements


def _doubles(text: bytes) -> bytes:
    """Convert the numbers of a text body to the bytes of little-endian doubles."""
    with warnings.catch_warnings():
        # numpy stops at a damaged number with a warning only.
        warnings.simplefilter("error", DeprecationWarning)
        numbers = np.fromstring(text.decode("ascii").strip() or "0", np.float64, sep=" ")
    return numbers.astype("<f8").tobytes() if text.strip() else b""


def _read_table(body: bytes, start: int, element: Element) -> tuple[Table, int]:
    """Read all rows of an element from byte ``start``; also return the byte after the last row.

    If all rows have lists of equal length, they are read at once, otherwise one by one.
    """
    name, num_rows, columns = element
    too_short = ValueError(f"less data than {num_rows} rows of element {name}")
    smallest_row = sum((c.number if c.length is None else c.length).itemsize for c in columns)
    if start + num_rows * smallest_row > len(body):
        raise too_short
    fields: list[tuple[Any, ...]] = []
    for name, number, length, _ in columns:
        shape: tuple[int, ...] = ()
        if length is not None:
            list_start = start + np.dtype(fields).itemsize
            shape = (_length(body, list_start, length) if num_rows else 0,)
            fields.append((f"{name}#", length))
        fields.append((name, number, shape))
    row = np.dtype(fields)
    end = start + num_rows * row.itemsize
    if end <= len(body):
        rows = np.frombuffer(body, row, num_rows, start)
        counts = [rows[f"{c.name}#"] for c in columns if c.length is not None]
        if all((count == count[:1]).all() for count in counts):
            return {name: rows[name].reshape(-1) for name in row.names or ()}, end
    if num_rows > MAX_UNEVEN_ROWS:
        raise ValueError(f"over {MAX_UNEVEN_ROWS} rows with lists of different lengths")
    values: dict[str, list[bytes]] = {c.name: [] for c in columns}
    lengths: dict[str, list[int]] = {f"{c.name}#": [] for c in columns if c.length is not None}
    for _ in range(num_rows):
        for name, number, length, _ in columns:
            num_values = 1
            if length is not None:
                num_values = _length(body, start, length)
                lengths[f"{name}#"].append(num_values)
                start += length.itemsize
            end = start + num_values * number.itemsize
            if end > len(body):
                raise too_short
            values[name].append(body[start:end])
            start = end
    table = {c.name: np.frombuffer(b"".join(values[c.name]), c.number) for c in columns}
    return table | {name: np.array(counts) for name, counts in lengths.items()}, start


def _length(body: bytes, start: int, kind: np.dtype[Any]) -> int:
    written = np.frombuffer(body, kind, 1, start)[0].item()
    if written != int(written) or not 0 <= written <= len(body):
        raise ValueError(f"a list of {written} values")
    return int(written)
