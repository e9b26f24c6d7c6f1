"""A part: a rigid object with its mesh, size, cuboid and symmetries, all in metres.

A record holds a part as JSON values in a checkpoint. Checkpoints are not trusted, so
:meth:`Part.from_record` checks every field.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Final, TypeAlias

import numpy as np
from jaxtyping import Float
from pydantic import Field

from dopepp.core.errors import UserError
from dopepp.core.validation import STRICT, parse
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.geometry.rotation import is_rigid
from dopepp.geometry.symmetry import ContinuousSymmetry
from dopepp.parts.mesh import (
    Colours,
    Faces,
    Points,
    SurfaceTree,
    Vertices,
    hash_triangles,
    largest_distance,
    sample_surface,
    weld,
)
from dopepp.parts.mesh.decimate import MAX_FACES, decimate

logger = logging.getLogger(__name__)

UNITS: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": 0.0254}  # Metres per unit of a mesh file
SMALLEST_DIAMETER: Final = 0.005
LARGEST_DIAMETER: Final = 5.0  # metres. Other diameters nearly always mean a wrong unit
MAX_NAME: Final = 200  # Characters; limits the text that a hostile file can print
MAX_POINTS: Final = 100_000
MAX_SYMMETRIES: Final = 1000
"""Far more than any real part has; bounds on the memory of a hostile file."""

MAX_LIGHT_FACES: Final = 4000
"""Most triangles of a record's mesh: edges of two pixels on a part of 100 pixels."""

_SAME_SHAPE: Final = 0.001  # Largest distance between equal surfaces, diameters
_FARTHEST: Final = 1e6  # Largest coordinate, metres; its square is finite


@dataclass(frozen=True)
class Mesh:
    """Triangles in the object frame.

    Attributes:
        vertices: Positions in metres, float64.
        faces: Vertex indices of each triangle, counter-clockwise from outside, int32.
        uv: Texture coordinates per vertex, v upwards as in OBJ; None without a texture.
        texture: RGB texture image, first row on top.
        colours: sRGB of each vertex, 0 – 255; None with a texture.
        normals: Normal of each vertex as in the file, of any length; may be zero or not finite.
    """

    vertices: Vertices
    faces: Faces
    uv: Float[np.ndarray, "vertices 2"] | None = None
    texture: RGBImage | None = None
    colours: Colours | None = None
    normals: Float[np.ndarray, "vertices 3"] | None = None


@dataclass(frozen=True)
class RawMesh(Mesh):
    """Triangles as read from a file, in its unit, before any check."""

    unit: str | None = None  # as stated by the file; None: not stated


@dataclass(frozen=True)
class Part:
    """A rigid object that a network can detect.

    Attributes:
        cuboid: Eight bounding-box corners in NDDS order and the centre, metres, object frame.
        diameter: Largest distance between two vertices, metres.
        points: Surface points for the ADD metric, object frame, metres.
        mesh: At most 200,000 triangles to render (from a checkpoint: :attr:`light_mesh`); None for
            an object with ADD points only.
        mesh_deviation: Largest distance of the mesh from the file's triangles, metres.
        mesh_hash: SHA-256 of the original vertices and faces, hex; empty without a mesh.
        symmetries_discrete: BOP-style rigid transforms (S, 4, 4), metres, without the identity.
        symmetries_continuous: BOP-style axes of revolution: (direction, point in metres) pairs.
        unit: Unit of the part's file; empty without a file.
    """

    name: str
    cuboid: Float[np.ndarray, "9 3"]
    diameter: float
    points: Points
    mesh: Mesh | None = None
    mesh_deviation: float = 0.0
    mesh_hash: str = ""
    symmetries_discrete: Float[np.ndarray, "symmetries 4 4"] | None = None
    symmetries_continuous: tuple[ContinuousSymmetry, ...] = ()
    unit: str = ""

    @property
    def has_symmetries(self) -> bool:
        """Whether the part has symmetries besides the identity."""
        discrete = self.symmetries_discrete
        return bool(self.symmetries_continuous) or (discrete is not None and len(discrete) > 0)

    def has_shape_of(self, other: Part) -> bool:
        """Return whether the surfaces differ by at most 0.1 % of the diameter, decimation aside.

        If either part has no mesh, the mesh hashes are compared.
        """
        if self.mesh_hash == other.mesh_hash or self.mesh is None or other.mesh is None:
            return self.mesh_hash == other.mesh_hash
        most = _SAME_SHAPE * self.diameter + self.mesh_deviation + other.mesh_deviation
        pairs = ((self.mesh, other.points), (other.mesh, self.points))
        trees = ((SurfaceTree(mesh.vertices, mesh.faces), points) for mesh, points in pairs)
        return all(bool((tree.distances(points) <= most).all()) for tree, points in trees)

    def appearance_hash(self) -> str:
        """Return the SHA-256 (hex) of the mesh's texture, colours and normals."""
        digest, mesh = hashlib.sha256(), self.mesh
        arrays = () if mesh is None else (mesh.uv, mesh.texture, mesh.colours, mesh.normals)
        for array in arrays:
            if array is not None:
                digest.update(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    @cached_property
    def light_mesh(self) -> tuple[Mesh, float] | None:
        """At most 4,000 untextured triangles for a checkpoint, and their largest deviation, metres.

        The deviation is from the file's triangles. Lengths are rounded to 0.1 µm. None without a
        mesh or if decimation fails.
        """
        if self.mesh is None:
            return None
        vertices, faces = weld(np.round(self.mesh.vertices, 7), self.mesh.faces)
        deviation = self.mesh_deviation
        if len(faces) > MAX_LIGHT_FACES:
            try:
                fewer, corners, *_ = decimate(vertices, faces, None, MAX_LIGHT_FACES)
            except ValueError as error:
                logger.warning("part %r has no mesh in checkpoints: %s", self.name, error)
                return None
            deviation += float(SurfaceTree(fewer, corners).distances(vertices).max())
            vertices, faces = weld(np.round(fewer, 7), corners)
        return Mesh(vertices, faces.astype(np.int32)), deviation

    def to_record(self) -> dict[str, Any]:
        """Return the fields as JSON values for a checkpoint; the mesh is :attr:`light_mesh`."""
        discrete = self.symmetries_discrete
        mesh = None
        if self.light_mesh is not None:
            light, deviation = self.light_mesh
            vertices, faces = light.vertices.tolist(), light.faces.tolist()
            mesh = {"vertices": vertices, "faces": faces, "deviation": deviation}
        return {
            "name": self.name,
            "cuboid": self.cuboid.tolist(),
            "diameter": float(self.diameter),
            "points": self.points.tolist(),
            "mesh": mesh,
            "mesh_hash": self.mesh_hash,
            "symmetries_discrete": None if discrete is None else discrete.tolist(),
            "symmetries_continuous": [[*map(list, pair)] for pair in self.symmetries_continuous],
        }

    @classmethod
    def from_record(cls, record: object) -> Part:
        """Create a part from a record of :meth:`to_record`.

        Raises:
            UserError: A field is invalid.
        """
        values = parse(_Record, record, "part", _FIX)
        cuboid = np.array(values.cuboid, np.float64)
        expected = cuboid_keypoints(cuboid.min(axis=0), cuboid.max(axis=0))
        transforms = None
        if values.symmetries_discrete is not None:
            transforms = np.array(values.symmetries_discrete, np.float64).reshape(-1, 4, 4)
        mesh, deviation = None, 0.0
        if values.mesh is not None:
            faces = np.array(values.mesh.faces, np.int32)
            mesh = Mesh(np.array(values.mesh.vertices, np.float64), faces)
            deviation = values.mesh.deviation
        for is_valid, problem, allowed in (
            (
                # Another order of corners would silently give wrong poses; 1e-6 is for float32.
                np.abs(cuboid - expected).max() <= 1e-6 * np.ptp(cuboid),
                "cuboid that is not an axis-aligned box",
                "eight corners in NDDS order, then the centre",
            ),
            (
                transforms is None or all(map(is_rigid, transforms)),
                "symmetries_discrete with a matrix that is not a rigid transform",
                "[R t; 0 0 0 1] with a rotation R",
            ),
            (
                all(any(axis) for axis, _ in values.symmetries_continuous),
                "symmetries_continuous with an axis of length 0",
                "[axis, offset] with an axis other than 0",
            ),
            (
                mesh is None or mesh.faces.max() < len(mesh.vertices),
                "mesh whose faces use a missing vertex",
                "indices of its vertices",
            ),
        ):
            if not is_valid:
                raise UserError(f"part.{problem}", allowed, _FIX)
        return cls(
            name=check_name(values.name),
            cuboid=cuboid,
            diameter=values.diameter,
            points=np.array(values.points, np.float64),
            mesh=mesh,
            mesh_deviation=deviation,
            mesh_hash=values.mesh_hash,
            symmetries_discrete=transforms,
            symmetries_continuous=tuple(values.symmetries_continuous),
        )


_FIX: Final = "load a file written by this version of dopepp"

_Metres: TypeAlias = Annotated[float, Field(ge=-_FARTHEST, le=_FARTHEST)]
_Point: TypeAlias = tuple[_Metres, _Metres, _Metres]
_Corner: TypeAlias = Annotated[int, Field(ge=0, lt=3 * MAX_LIGHT_FACES)]
_Row: TypeAlias = tuple[_Metres, _Metres, _Metres, _Metres]


@dataclass(frozen=True)
class _MeshRecord:
    """Triangles of a record, and their largest distance from the file's triangles, metres."""

    __pydantic_config__ = STRICT
    vertices: Annotated[list[_Point], Field(min_length=3, max_length=3 * MAX_LIGHT_FACES)]
    faces: Annotated[
        list[tuple[_Corner, _Corner, _Corner]], Field(min_length=1, max_length=MAX_LIGHT_FACES)
    ]
    deviation: Annotated[float, Field(ge=0, le=_FARTHEST)]


@dataclass(frozen=True)
class _Record:
    __pydantic_config__ = STRICT
    name: str
    cuboid: Annotated[list[_Point], Field(min_length=9, max_length=9)]
    diameter: Annotated[float, Field(gt=0, le=_FARTHEST)]
    points: Annotated[list[_Point], Field(min_length=1, max_length=MAX_POINTS)]
    mesh: _MeshRecord | None
    mesh_hash: Annotated[str, Field(pattern="^([0-9a-f]{64})?$")]
    symmetries_discrete: (
        Annotated[list[tuple[_Row, _Row, _Row, _Row]], Field(max_length=MAX_SYMMETRIES)] | None
    )
    symmetries_continuous: Annotated[list[tuple[_Point, _Point]], Field(max_length=MAX_SYMMETRIES)]


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
    """Create a part from a mesh or, without a mesh, from ADD points (default: from the surface).

    A mesh of over 200,000 triangles is measured first and then decimated for rendering. All
    lengths are in metres; ``unit`` is that of the file, for messages.

    Raises:
        UserError: The name is empty or too long, the diameter is outside 5 mm – 5 m, or the mesh
            cannot be decimated.
        ValueError: Neither a mesh nor points are given.
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
    renderable, moved = (None, 0.0) if mesh is None else _renderable(mesh, name)
    return Part(
        name=name,
        cuboid=cuboid_keypoints(shape.min(axis=0), shape.max(axis=0)),
        diameter=diameter,
        points=np.asarray(points, np.float64),
        mesh=renderable,
        mesh_deviation=moved,
        mesh_hash="" if mesh is None else hash_triangles(shape, mesh.faces),
        symmetries_discrete=symmetries_discrete,
        symmetries_continuous=symmetries_continuous,
    )


def _renderable(mesh: Mesh, name: str) -> tuple[Mesh, float]:
    """Return a mesh of at most ``MAX_FACES`` triangles, and the largest vertex shift, metres."""
    if len(mesh.faces) <= MAX_FACES:
        return mesh, 0.0
    values = mesh.uv if mesh.colours is None else mesh.colours.astype(np.float64)
    try:
        vertices, faces, values, moved = decimate(mesh.vertices, mesh.faces, values)
    except ValueError as error:
        allowed = f"up to {MAX_FACES} triangles"
        fix = "reduce the triangles in the CAD program or Blender (Decimate)"
        raise UserError(f"part {name!r}: {error}", allowed, fix) from error
    counts = f"{len(mesh.faces)} triangles decimated to {len(faces)}"
    logger.warning("part %r: %s; vertices moved by up to %.2g mm", name, counts, 1000 * moved)
    if mesh.colours is None or values is None:
        return Mesh(vertices, faces.astype(np.int32), values, mesh.texture), moved
    colours = np.rint(values).astype(np.uint8)
    return Mesh(vertices, faces.astype(np.int32), colours=colours), moved


def _check_diameter(diameter: float, name: str, unit: str) -> None:
    """Raise a ``UserError`` with likely units if a diameter (metres) is outside 5 mm – 5 m."""
    if SMALLEST_DIAMETER <= diameter <= LARGEST_DIAMETER:
        return
    written, fix = diameter / UNITS[unit], "export the part at its real size"
    likely = [u for u, s in UNITS.items() if SMALLEST_DIAMETER <= written * s <= LARGEST_DIAMETER]
    if likely:
        fix = f"state the file's unit: unit={likely[0]}"
    problem = f"part {name!r} with a diameter of {diameter:.4g} m, from a mesh with unit={unit}"
    raise UserError(problem, "a diameter of 5 mm – 5 m", fix)


def check_name(name: object) -> str:
    """Return the name of a part if it has 1 to 200 printable characters.

    Raises:
        UserError: The name is invalid.
    """
    if isinstance(name, str) and 0 < len(name) <= MAX_NAME and name.isprintable():
        return name
    allowed = f"1–{MAX_NAME} printable characters"
    raise UserError(f"part name {name!r:.50}", allowed, "rename the part or its file")
