"""The tables in a PLY file's body: rows of numbers and lists, as the header declares them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

MAX_UNEVEN_ROWS: Final = 2_000_000
"""Rows with lists of different lengths are read one by one: seconds, and 0.5 GB, for so many."""


@dataclass(frozen=True)
class Property:
    """A column: a number, or a list whose length ``count_type`` tells.

    Attributes:
        name: Its name.
        dtype: Numpy type of the number or the list's numbers.
        count_type: Numpy type of a list's length; None for a number.
    """

    name: str
    dtype: str
    count_type: str | None = None


@dataclass(frozen=True)
class Element:
    """A table: vertices, faces or anything else.

    Attributes:
        name: Its name.
        num_rows: How many rows the header promises.
        properties: Its columns.
    """

    name: str
    num_rows: int
    properties: tuple[Property, ...]


Columns = dict[str, NDArray[Any]]
"""Values of each property; of a list all values in a row, and its lengths under ``NAME#``."""


def read_tables(body: bytes, elements: list[Element]) -> dict[str, Columns]:
    """Read every element's rows.

    Raises:
        ValueError: The body is shorter or longer than its elements, or a list's length is none.
    """
    tables, start = {}, 0
    for element in elements:
        smallest = sum(np.dtype(c.count_type or c.dtype).itemsize for c in element.properties)
        if start + element.num_rows * smallest > len(body):
            raise ValueError(f"less data than {element.num_rows} rows of element {element.name}")
        columns, start = _even_rows(body, start, element) or _uneven_rows(body, start, element)
        tables[element.name] = columns
    if start != len(body):
        raise ValueError(f"{len(body) - start} bytes more than its header promises")
    return tables


def _even_rows(body: bytes, start: int, element: Element) -> tuple[Columns, int] | None:
    """Read a table whose lists are as long in every row as in the first; None for another."""
    fields: list[tuple[Any, ...]] = []
    for column in element.properties:
        if column.count_type is None:
            fields.append((column.name, column.dtype))
            continue
        length = 0
        if element.num_rows:
            place = start + np.dtype(fields).itemsize
            length = _length(np.frombuffer(body, column.count_type, 1, place)[0], body)
        fields += [(f"{column.name}#", column.count_type), (column.name, column.dtype, (length,))]
    row = np.dtype(fields)
    if start + element.num_rows * row.itemsize > len(body):
        return None
    rows = np.frombuffer(body, row, element.num_rows, start)
    names = [name for name in rows.dtype.names or () if name.endswith("#")]
    if any((rows[name] != rows[name][:1]).any() for name in names):
        return None
    columns = {name: rows[name].reshape(-1) for name in rows.dtype.names or ()}
    return columns, start + element.num_rows * row.itemsize


def _uneven_rows(body: bytes, start: int, element: Element) -> tuple[Columns, int]:
    """Read a table row by row."""
    if element.num_rows > MAX_UNEVEN_ROWS:
        raise ValueError(f"over {MAX_UNEVEN_ROWS} rows with lists of different lengths")
    view = memoryview(body)
    pieces: dict[str, list[memoryview]] = {column.name: [] for column in element.properties}
    lengths: dict[str, list[int]] = {c.name: [] for c in element.properties if c.count_type}
    sizes = [
        (c, np.dtype(c.dtype).itemsize, np.dtype(c.count_type) if c.count_type else None)
        for c in element.properties
    ]
    for _ in range(element.num_rows):
        for column, size, count_type in sizes:
            length = 1
            if count_type is not None:
                length = _length(np.frombuffer(body, count_type, 1, start)[0], body)
                lengths[column.name].append(length)
                start += count_type.itemsize
            if start + length * size > len(body):
                raise ValueError(f"less data than {element.num_rows} rows of {element.name}")
            pieces[column.name].append(view[start : start + length * size])
            start += length * size
    columns: Columns = {
        column.name: np.frombuffer(b"".join(pieces[column.name]), column.dtype)
        for column in element.properties
    }
    columns |= {f"{name}#": np.array(counts, np.int64) for name, counts in lengths.items()}
    return columns, start


def _length(written: np.generic, body: bytes) -> int:
    """Return a list's length as it is written, which may be a float or negative."""
    length = int(written.item())
    if length != written.item() or not 0 <= length <= len(body):
        raise ValueError(f"a list of {written.item()} values")
    return length
