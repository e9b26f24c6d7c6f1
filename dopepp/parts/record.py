"""The check of a part's record: a plain mapping from a file that anybody may have written."""

from __future__ import annotations

import math
import re
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from dopepp.errors import UserError
from dopepp.geometry.cuboid import NUM_KEYPOINTS, cuboid_keypoints
from dopepp.geometry.rotation import is_rotation

MAX_POINTS: Final = 100_000
MAX_SYMMETRIES: Final = 1000
MAX_NAME: Final = 200
"""Far above any real part (YCB-Video: 2,621 points); they bound memory for a hostile file."""

FARTHEST: Final = 1e6
"""Metres. No part reaches out this far, and squares of such lengths stay finite."""

FIELDS: Final = (
    "name",
    "cuboid",
    "diameter",
    "points",
    "mesh_hash",
    "symmetries_discrete",
    "symmetries_continuous",
)


def check_record(record: object) -> dict[str, Any]:
    """Return a record's fields as a part's arguments.

    Raises:
        UserError: The record is not a mapping with exactly :data:`FIELDS`, or a field has the
            wrong type, shape or range.
    """
    if not isinstance(record, dict) or {*record} != {*FIELDS}:
        got = type(record).__name__
        if isinstance(record, dict):
            got = f"a mapping with {', '.join(sorted(map(repr, record))[:12]) or 'no fields'}"
        raise _bad(f"{got}", f"a mapping with the fields {', '.join(FIELDS)}")
    discrete = record["symmetries_discrete"]
    return {
        "name": check_name(record["name"]),
        "cuboid": _cuboid(record["cuboid"]),
        "diameter": _diameter(record["diameter"]),
        "points": _numbers("points", record["points"], MAX_POINTS, 3, fewest=1),
        "mesh_hash": _hash(record["mesh_hash"]),
        "symmetries_discrete": None if discrete is None else _transforms(discrete),
        "symmetries_continuous": _axes(record["symmetries_continuous"]),
    }


def check_name(name: object) -> str:
    """Return a part's name after checking that it can label instances.

    Raises:
        UserError: It is no text, empty, over 200 characters or has characters that do not print.
    """
    if isinstance(name, str) and 0 < len(name) <= MAX_NAME and name.isprintable():
        return name
    got = (
        f"part name {name[:50]!r}" if isinstance(name, str) else f"a part name that is {name!r:.50}"
    )
    raise UserError(got, f"1–{MAX_NAME} printable characters", "rename the part or its file")


def _bad(got: str, allowed: str) -> UserError:
    return UserError(
        f"part record: {got}", allowed, "load a file that this version of dopepp has written"
    )


def _number(value: object) -> float:
    """Return a plain finite number, NaN for anything else (bool included)."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return math.nan
    try:
        return float(value)
    except OverflowError:  # an int above 1e308
        return math.nan


def _numbers(
    field: str, rows: object, most: int, width: int, fewest: int
) -> Float[np.ndarray, "rows width"]:
    """Return a list of equally long lists of finite numbers as an array."""
    allowed = f"{fewest} – {most} lists of {width} finite numbers"
    if not isinstance(rows, list | tuple) or not fewest <= len(rows) <= most:
        raise _bad(f"{field} of {_describe(rows)}", allowed)
    if not all(isinstance(row, list | tuple) and len(row) == width for row in rows):
        raise _bad(f"{field} with a row of another length", allowed)
    array = np.array([[_number(x) for x in row] for row in rows], np.float64)
    if not (np.abs(array) <= FARTHEST).all():
        raise _bad(f"{field} with a value that is no number of metres", allowed)
    return array.reshape(-1, width)


def _describe(value: object) -> str:
    return (
        f"{len(value)} rows" if isinstance(value, list | tuple) else f"type {type(value).__name__}"
    )


def _cuboid(rows: object) -> Float[np.ndarray, "9 3"]:
    cuboid = _numbers("cuboid", rows, NUM_KEYPOINTS, 3, fewest=NUM_KEYPOINTS)
    lower, upper = cuboid.min(axis=0), cuboid.max(axis=0)
    # Another order of corners would give wrong poses without any error; 1e-6 is float32's rounding.
    if not np.abs(cuboid - cuboid_keypoints(lower, upper)).max() <= 1e-6 * np.ptp(cuboid):
        raise _bad(
            "a cuboid that is no axis-aligned box", "eight corners in NDDS order, the centre"
        )
    return cuboid


def _diameter(value: object) -> float:
    diameter = _number(value)
    if not (math.isfinite(diameter) and diameter > 0):
        raise _bad(f"diameter {value!r:.50}", "a finite number of metres above 0")
    return diameter


def _hash(value: object) -> str:
    if isinstance(value, str) and re.fullmatch(r"([0-9a-f]{64})?", value):
        return value
    raise _bad(f"mesh_hash {value!r:.80}", "64 hexadecimal digits, or none without a mesh")


def _transforms(matrices: object) -> Float[np.ndarray, "symmetries 4 4"]:
    if not isinstance(matrices, list | tuple) or len(matrices) > MAX_SYMMETRIES:
        raise _bad(f"symmetries_discrete of {_describe(matrices)}", f"≤ {MAX_SYMMETRIES} matrices")
    checked = [_numbers("symmetries_discrete", m, 4, 4, fewest=4) for m in matrices]
    for matrix in checked:
        if not is_rotation(matrix[:3, :3]) or (matrix[3] != [0, 0, 0, 1]).any():
            raise _bad("a symmetry that is no rigid transform", "[R t; 0 0 0 1] with a rotation R")
    return np.array(checked, np.float64).reshape(-1, 4, 4)


def _axes(pairs: object) -> tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]:
    if not isinstance(pairs, list | tuple) or len(pairs) > MAX_SYMMETRIES:
        raise _bad(f"symmetries_continuous of {_describe(pairs)}", f"≤ {MAX_SYMMETRIES} pairs")
    checked = [_numbers("symmetries_continuous", pair, 2, 3, fewest=2) for pair in pairs]
    if any(not axis.any() for axis, _ in checked):
        raise _bad("a symmetry axis of length 0", "[axis, offset] with an axis other than 0")
    return tuple((tuple(axis.tolist()), tuple(offset.tolist())) for axis, offset in checked)
