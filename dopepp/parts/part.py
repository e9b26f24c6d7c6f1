"""A part: a rigid object with its mesh, size, cuboid and symmetries, all in metres.

A part's record, a plain mapping, may come from a file that anybody has written, so
:meth:`Part.from_record` checks every field.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import Picture
from dopepp.geometry.cuboid import NUM_KEYPOINTS, cuboid_keypoints
from dopepp.geometry.rotation import is_rotation
from dopepp.geometry.symmetry import ContinuousSymmetry
from dopepp.parts.mesh.decimate import MAX_FACES, decimate
from dopepp.parts.mesh.measure import (
    Faces,
    Points,
    Vertices,
    hash_triangles,
    largest_distance,
    sample_surface,
)

logger = logging.getLogger(__name__)

UNITS: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": 0.0254}
"""Metres per unit of a mesh file."""

SMALLEST_DIAMETER: Final = 0.005
LARGEST_DIAMETER: Final = 5.0
"""Metres. Outside these, a part is far more likely to have been read in the wrong unit."""

MAX_POINTS: Final = 100_000
MAX_SYMMETRIES: Final = 1000
MAX_NAME: Final = 200
"""Far above any real part (YCB-Video: 2,621 points); they bound memory for a hostile file."""

FARTHEST: Final = 1e6
"""Metres. No part reaches out this far, and squares of such lengths stay finite."""


@dataclass(frozen=True)
class Mesh:
    """Triangles in the object frame.

    Attributes:
        vertices: Positions in metres, float64.
        faces: Vertex indices of each triangle, counter-clockwise from outside, int32.
        uv: Texture coordinates per vertex, v upwards as in OBJ; None without a texture.
        texture: RGB texture image, uint8, first row on top; None for an untextured part.
    """

    vertices: Vertices
    faces: Faces
    uv: Float[np.ndarray, "vertices 2"] | None = None
    texture: Picture | None = None


@dataclass(frozen=True)
class Part:
    """A rigid object the network can learn.

    Attributes:
        cuboid: Eight bounding-box corners in NDDS order and the centre, metres, object frame.
        diameter: Largest distance between two vertices, metres.
        points: ADD points in the object frame, metres.
        mesh: Triangles to render, at most 200,000; None when the part comes out of a checkpoint.
        mesh_hash: SHA-256 of the vertices and faces that the part was made from, hex.
        symmetries_discrete: BOP-style rigid transforms that map the part onto itself, without the
            identity, shape (S, 4, 4).
        symmetries_continuous: BOP-style axes of rotational symmetry as (axis, offset) pairs.
    """

    name: str
    cuboid: Float[np.ndarray, "9 3"]
    diameter: float
    points: Points
    mesh: Mesh | None = None
    mesh_hash: str = ""
    symmetries_discrete: Float[np.ndarray, "symmetries 4 4"] | None = None
    symmetries_continuous: tuple[ContinuousSymmetry, ...] = ()

    def to_record(self) -> dict[str, Any]:
        """Return all but the mesh as plain values, for a checkpoint's objects table."""
        discrete = self.symmetries_discrete
        return {
            "name": self.name,
            "cuboid": self.cuboid.tolist(),
            "diameter": float(self.diameter),
            "points": self.points.tolist(),
            "mesh_hash": self.mesh_hash,
            "symmetries_discrete": None if discrete is None else discrete.tolist(),
            "symmetries_continuous": [[*map(list, pair)] for pair in self.symmetries_continuous],
        }

    @classmethod
    def from_record(cls, record: object) -> Part:
        """Make a part, without its mesh, from what :meth:`to_record` returned, or a UserError."""
        if not isinstance(record, dict) or {*record} != {*FIELDS}:
            got = type(record).__name__
            if isinstance(record, dict):
                got = f"a mapping with {', '.join(sorted(map(repr, record))[:12]) or 'no fields'}"
            raise _bad(got, f"a mapping with the fields {', '.join(FIELDS)}")
        discrete = record["symmetries_discrete"]
        return cls(
            name=check_name(record["name"]),
            cuboid=_cuboid(record["cuboid"]),
            diameter=_diameter(record["diameter"]),
            points=_numbers("points", record["points"], MAX_POINTS, 3, fewest=1),
            mesh_hash=_hash(record["mesh_hash"]),
            symmetries_discrete=None if discrete is None else _transforms(discrete),
            symmetries_continuous=_axes(record["symmetries_continuous"]),
        )


FIELDS: Final = tuple(field.name for field in fields(Part) if field.name != "mesh")
"""Of a part's record: all but the mesh."""

Parts = Sequence[Part]


def make_part(
    name: str,
    mesh: Mesh | None,
    points: Points | None = None,
    *,
    symmetries_discrete: Float[np.ndarray, "symmetries 4 4"] | None = None,
    symmetries_continuous: tuple[ContinuousSymmetry, ...] = (),
    unit: str = "m",
) -> Part:
    """Measure a mesh and make the part it describes.

    A mesh of over 200,000 triangles is measured as it is, so that poses, errors and the hash do not
    depend on it, and then decimated for rendering, which the log says. ``mesh`` is None for an
    object known by its ADD points only; ``points`` are by default 2,000 fixed-seed samples of the
    surface; ``unit`` is that of the file, named when the size is unlikely.

    Raises:
        UserError: The name is empty or too long, the diameter lies outside 5 mm – 5 m, or the mesh
            has too many triangles of which no larger ones can be made.
    """
    check_name(name)
    outline = points if mesh is None else mesh.vertices
    if outline is None:
        raise ValueError("a part needs a mesh or points, got neither")
    shape = np.asarray(outline, np.float64)
    diameter = largest_distance(shape)
    _check_diameter(diameter, name, unit)
    if points is None and mesh is not None:
        points = sample_surface(shape, mesh.faces)
    return Part(
        name=name,
        cuboid=cuboid_keypoints(shape.min(axis=0), shape.max(axis=0)),
        diameter=diameter,
        points=np.asarray(points, np.float64),
        mesh=None if mesh is None else _renderable(mesh, name),
        mesh_hash="" if mesh is None else hash_triangles(shape, mesh.faces),
        symmetries_discrete=symmetries_discrete,
        symmetries_continuous=symmetries_continuous,
    )


def _renderable(mesh: Mesh, name: str) -> Mesh:
    """Return a mesh of at most ``MAX_FACES`` triangles."""
    if len(mesh.faces) <= MAX_FACES:
        return mesh
    try:
        vertices, faces, uv, moved = decimate(mesh.vertices, mesh.faces, mesh.uv)
    except ValueError as error:
        raise UserError(
            f"part {name!r}: {error}", f"up to {MAX_FACES} triangles", "reduce its triangles"
        ) from error
    logger.warning(
        "part %r: %d triangles decimated to %d to render; no point moved by more than %.2g mm",
        name, len(mesh.faces), len(faces), 1000 * moved,
    )  # fmt: skip
    return Mesh(vertices, faces.astype(np.int32), uv, mesh.texture)


def _check_diameter(diameter: float, name: str, unit: str) -> None:
    """Refuse a diameter (metres) that nearly always means a wrong unit, and name likely ones."""
    if SMALLEST_DIAMETER <= diameter <= LARGEST_DIAMETER:
        return
    written = diameter / UNITS[unit]
    likely = [u for u, s in UNITS.items() if SMALLEST_DIAMETER <= written * s <= LARGEST_DIAMETER]
    raise UserError(
        f"part {name!r} with a diameter of {diameter:.4g} m, its file read with unit={unit}",
        "a diameter of 5 mm – 5 m",
        f"state the file's unit: unit={likely[0]}" if likely else "check the file's size",
    )


def check_name(name: object) -> str:
    """Return a name that can label instances: a text of 1 to 200 printable characters."""
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


def _axes(pairs: object) -> tuple[ContinuousSymmetry, ...]:
    if not isinstance(pairs, list | tuple) or len(pairs) > MAX_SYMMETRIES:
        raise _bad(f"symmetries_continuous of {_describe(pairs)}", f"≤ {MAX_SYMMETRIES} pairs")
    checked = [_numbers("symmetries_continuous", pair, 2, 3, fewest=2) for pair in pairs]
    if any(not axis.any() for axis, _ in checked):
        raise _bad("a symmetry axis of length 0", "[axis, offset] with an axis other than 0")
    return tuple((tuple(axis.tolist()), tuple(offset.tolist())) for axis, offset in checked)
