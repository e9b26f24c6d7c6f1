"""The fields of a part's record: plain values of a file that anybody may have written, checked."""

from __future__ import annotations

import math
import re
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.geometry.cuboid import NUM_KEYPOINTS, cuboid_keypoints
from dopepp.geometry.rotation import is_rotation
from dopepp.geometry.symmetry import ContinuousSymmetry
from dopepp.parts.mesh.measure import Faces, Vertices

MAX_POINTS: Final = 100_000
MAX_SYMMETRIES: Final = 1000
"""Far above any real part (YCB-Video: 2,621 points); they bound memory for a hostile file."""

MAX_FACES: Final = 4000
"""Triangles of a record's mesh, and of an outline's: their edges are two pixels long on a part of
100 pixels."""

FARTHEST: Final = 1e6
"""Metres. No part reaches out this far, and squares of such lengths stay finite."""


def parse_mesh(record: object) -> tuple[Vertices, Faces, float]:
    """Return the vertices, metres, the triangles, and how far any vertex had been moved, metres."""
    if not isinstance(record, dict) or {*record} != {"vertices", "faces", "deviation"}:
        raise bad("a mesh with other fields", "its vertices, faces and deviation")
    vertices = parse_numbers("mesh vertices", record["vertices"], 3 * MAX_FACES, 3, fewest=3)
    corners = parse_numbers("mesh faces", record["faces"], MAX_FACES, 3, fewest=1)
    faces = corners.astype(np.int32)
    if (faces != corners).any() or faces.min() < 0 or faces.max() >= len(vertices):
        raise bad("a mesh with a face of other than its vertices", f"0 to {len(vertices) - 1}")
    deviation = _number(record["deviation"])
    if not 0 <= deviation <= FARTHEST:
        raise bad(f"mesh deviation {record['deviation']!r:.50}", "a number of metres, 0 or more")
    return vertices, faces, deviation


def bad(got: str, allowed: str) -> UserError:
    """Return the error about a record of which something is not as it must be."""
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


def parse_numbers(
    field: str, rows: object, most: int, width: int, fewest: int
) -> Float[np.ndarray, "rows width"]:
    """Return a list of equally long lists of finite numbers as an array."""
    allowed = f"{fewest} – {most} lists of {width} finite numbers"
    if not isinstance(rows, list | tuple) or not fewest <= len(rows) <= most:
        raise bad(f"{field} of {_describe(rows)}", allowed)
    if not all(isinstance(row, list | tuple) and len(row) == width for row in rows):
        raise bad(f"{field} with a row of another length", allowed)
    array = np.array([[_number(x) for x in row] for row in rows], np.float64)
    if not (np.abs(array) <= FARTHEST).all():
        raise bad(f"{field} with a value that is no number of metres", allowed)
    return array.reshape(-1, width)


def _describe(value: object) -> str:
    return (
        f"{len(value)} rows" if isinstance(value, list | tuple) else f"type {type(value).__name__}"
    )


def parse_cuboid(rows: object) -> Float[np.ndarray, "9 3"]:
    """Return a box's corners and centre, metres."""
    cuboid = parse_numbers("cuboid", rows, NUM_KEYPOINTS, 3, fewest=NUM_KEYPOINTS)
    lower, upper = cuboid.min(axis=0), cuboid.max(axis=0)
    # Another order of corners would give wrong poses without any error; 1e-6 is float32's rounding.
    if not np.abs(cuboid - cuboid_keypoints(lower, upper)).max() <= 1e-6 * np.ptp(cuboid):
        raise bad("a cuboid that is no axis-aligned box", "eight corners in NDDS order, the centre")
    return cuboid


def parse_diameter(value: object) -> float:
    """Return metres."""
    diameter = _number(value)
    if not (math.isfinite(diameter) and diameter > 0):
        raise bad(f"diameter {value!r:.50}", "a finite number of metres above 0")
    return diameter


def parse_hash(value: object) -> str:
    """Return a SHA-256 in hex, or nothing."""
    if isinstance(value, str) and re.fullmatch(r"([0-9a-f]{64})?", value):
        return value
    raise bad(f"mesh_hash {value!r:.80}", "64 hexadecimal digits, or none without a mesh")


def parse_transforms(matrices: object) -> Float[np.ndarray, "symmetries 4 4"]:
    """Return the rigid transforms of discrete symmetries."""
    if not isinstance(matrices, list | tuple) or len(matrices) > MAX_SYMMETRIES:
        raise bad(f"symmetries_discrete of {_describe(matrices)}", f"≤ {MAX_SYMMETRIES} matrices")
    checked = [parse_numbers("symmetries_discrete", m, 4, 4, fewest=4) for m in matrices]
    for matrix in checked:
        if not is_rotation(matrix[:3, :3]) or (matrix[3] != [0, 0, 0, 1]).any():
            raise bad("a symmetry that is no rigid transform", "[R t; 0 0 0 1] with a rotation R")
    return np.array(checked, np.float64).reshape(-1, 4, 4)


def parse_axes(pairs: object) -> tuple[ContinuousSymmetry, ...]:
    """Return the axes of continuous symmetries with their offsets."""
    if not isinstance(pairs, list | tuple) or len(pairs) > MAX_SYMMETRIES:
        raise bad(f"symmetries_continuous of {_describe(pairs)}", f"≤ {MAX_SYMMETRIES} pairs")
    checked = [parse_numbers("symmetries_continuous", pair, 2, 3, fewest=2) for pair in pairs]
    if any(not axis.any() for axis, _ in checked):
        raise bad("a symmetry axis of length 0", "[axis, offset] with an axis other than 0")
    return tuple((tuple(axis.tolist()), tuple(offset.tolist())) for axis, offset in checked)
