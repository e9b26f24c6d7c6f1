"""A strict PLY reader: text and both byte orders, polygons, any further elements and properties.

trimesh does not read them, as only who reads a file's every list can tell that it is whole:
trimesh refuses a binary file of triangles and quads, or takes it for others where their sizes
happen to agree, and of a text that ends too early it makes a smaller mesh
(``tests/parts/test_library.py``).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dopepp.parts.mesh.measure import RawMesh
from dopepp.parts.mesh.obj import companion_path, read_texture
from dopepp.parts.mesh.polygons import fans, first_folded_polygon

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

MAX_UNEVEN_ROWS: Final = 2_000_000
"""Rows with lists of different lengths are read one by one: seconds, and 0.5 GB, for so many."""

COORDINATES: Final = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
"""Names that programs give to a vertex's texture coordinates."""

Columns = dict[str, NDArray[Any]]
"""Values of each property; of a list all values in a row, and its lengths under ``NAME#``."""


@dataclass(frozen=True)
class Element:
    """A table: vertices, faces or anything else.

    Attributes:
        name: Its name.
        num_rows: How many rows the header promises.
        columns: Of each property the name, its numbers' type, and that of a list's length.
    """

    name: str
    num_rows: int
    columns: list[tuple[str, np.dtype[Any], np.dtype[Any] | None]] = field(default_factory=list)


def read_ply(path: Path) -> RawMesh:
    """Read a PLY file and the texture it names in a ``TextureFile`` comment.

    Raises:
        UserError: The texture is missing, damaged or outside of the folder.
        ValueError: The file is damaged, has no vertices or faces, has a polygon that is not convex,
            or names several textures, or one without texture coordinates per vertex.
    """
    header, body = _split(path.read_bytes())
    lines = [line.split() for line in header.decode("utf-8", "surrogateescape").splitlines()]
    tables, start = {}, 0
    is_text, elements = _parse_header(lines)
    body = _doubles(body) if is_text else body
    for element in elements:
        tables[element.name], start = _read_table(body, start, element)
    if start != len(body):
        raise ValueError(f"{len(body) - start} bytes more than its header promises")
    vertex, face = tables.get("vertex", {}), tables.get("face", {})
    list_name = "vertex_indices" if "vertex_indices" in face else "vertex_index"
    if not {"x", "y", "z"} <= set(vertex) or f"{list_name}#" not in face:
        raise ValueError("no vertex table with x, y, z or no face table with vertex_indices")
    vertices = np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(np.float64)
    triangles, polygons = fans(face[f"{list_name}#"].astype(np.int64))
    faces = face[list_name].astype(np.int64)[triangles]
    if (faces != face[list_name][triangles]).any():
        raise ValueError("a vertex index that is no integer")
    folded = first_folded_polygon(vertices, faces, polygons)
    if folded is not None:
        raise ValueError(f"a polygon that is not convex, face {folded}")
    names = [" ".join(words[2:]) for words in lines if words[:2] == ["comment", "TextureFile"]]
    if not names:
        return RawMesh(vertices, faces)
    pairs = [pair for pair in COORDINATES if {*pair} <= set(vertex)]
    if len(names) > 1 or not pairs:
        raise ValueError(f"{len(names)} textures, {'one set of' if pairs else 'no'} uv per vertex")
    uv = np.stack([vertex[axis] for axis in pairs[0]], axis=1).astype(np.float64)
    return RawMesh(vertices, faces, uv, read_texture(companion_path(path, names[0], "TextureFile")))


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
            elements.append(Element(words[1], int(words[2])))
        elif words[:1] == ["property"]:
            is_list = words[1] == "list"
            written = [order + TYPES[name] for name in words[2 if is_list else 1 : -1]]
            types = [np.dtype("<f8" if is_text else name) for name in written]
            elements[-1].columns.append((words[-1], types[-1], types[0] if is_list else None))
    for element in elements:
        names = [name for name, _, _ in element.columns]
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


def _read_table(body: bytes, start: int, element: Element) -> tuple[Columns, int]:
    """Read a table at once if its lists are as long in every row as in the first, else by rows."""
    promise = f"less data than {element.num_rows} rows of element {element.name}"
    smallest = sum((n if c is None else c).itemsize for _, n, c in element.columns)
    if start + element.num_rows * smallest > len(body):
        raise ValueError(promise)
    fields: list[tuple[Any, ...]] = []
    for name, number, count in element.columns:
        length: tuple[int, ...] = ()
        if count is not None:
            place = start + np.dtype(fields).itemsize
            length = (_length(body, place, count) if element.num_rows else 0,)
            fields.append((f"{name}#", count))
        fields.append((name, number, length))
    row = np.dtype(fields)
    end = start + element.num_rows * row.itemsize
    if end <= len(body):
        rows = np.frombuffer(body, row, element.num_rows, start)
        if all(
            (rows[f"{n}#"] == rows[f"{n}#"][:1]).all()
            for n, _, c in element.columns
            if c is not None
        ):
            return {name: rows[name].reshape(-1) for name in row.names or ()}, end
    if element.num_rows > MAX_UNEVEN_ROWS:
        raise ValueError(f"over {MAX_UNEVEN_ROWS} rows with lists of different lengths")
    pieces: dict[str, list[bytes]] = {name: [] for name, _, _ in element.columns}
    lengths: dict[str, list[int]] = {
        f"{name}#": [] for name, _, c in element.columns if c is not None
    }
    for _ in range(element.num_rows):
        for name, number, count in element.columns:
            num_values = 1
            if count is not None:
                num_values = _length(body, start, count)
                lengths[f"{name}#"].append(num_values)
                start += count.itemsize
            end = start + num_values * number.itemsize
            if end > len(body):
                raise ValueError(promise)
            pieces[name].append(body[start:end])
            start = end
    columns = {n: np.frombuffer(b"".join(pieces[n]), number) for n, number, _ in element.columns}
    return columns | {name: np.array(counts) for name, counts in lengths.items()}, start


def _length(body: bytes, start: int, kind: np.dtype[Any]) -> int:
    """Return a list's length as it is written, which may be a fraction or negative."""
    written = np.frombuffer(body, kind, 1, start)[0].item()
    if written != int(written) or not 0 <= written <= len(body):
        raise ValueError(f"a list of {written} values")
    return int(written)
