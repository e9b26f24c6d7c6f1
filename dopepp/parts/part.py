"""A part: a rigid object with its mesh, size, cuboid and symmetries, all in metres."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int, UInt8

from dopepp.errors import UserError
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.parts.decimate import MAX_FACES, decimate
from dopepp.parts.measure import hash_triangles, largest_distance, sample_surface
from dopepp.parts.record import check_name, check_record

logger = logging.getLogger(__name__)

UNITS: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": 0.0254}
"""Metres per unit of a mesh file."""

SMALLEST_DIAMETER: Final = 0.005
LARGEST_DIAMETER: Final = 5.0
"""Metres. Outside these, a part is far more likely to have been read in the wrong unit."""


@dataclass(frozen=True)
class Mesh:
    """Triangles in the object frame.

    Attributes:
        vertices: Positions in metres, float64.
        faces: Vertex indices of each triangle, counter-clockwise from outside, int32.
        uv: Texture coordinates per vertex, v upwards as in OBJ; None without a texture.
        texture: RGB texture image, uint8, first row on top; None for an untextured part.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    uv: Float[np.ndarray, "vertices 2"] | None = None
    texture: UInt8[np.ndarray, "height width 3"] | None = None


@dataclass(frozen=True)
class Part:
    """A rigid object the network can learn.

    Attributes:
        name: Unique name; the label of its instances.
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
    points: Float[np.ndarray, "points 3"]
    mesh: Mesh | None = None
    mesh_hash: str = ""
    symmetries_discrete: Float[np.ndarray, "symmetries 4 4"] | None = None
    symmetries_continuous: tuple[tuple[tuple[float, ...], tuple[float, ...]], ...] = ()

    def to_record(self) -> dict[str, Any]:
        """Return everything but the mesh as plain lists, floats and strings.

        This is the part's row in a checkpoint's objects table.
        """
        discrete = self.symmetries_discrete
        continuous = self.symmetries_continuous
        return {
            "name": self.name,
            "cuboid": self.cuboid.tolist(),
            "diameter": float(self.diameter),
            "points": self.points.tolist(),
            "mesh_hash": self.mesh_hash,
            "symmetries_discrete": None if discrete is None else discrete.tolist(),
            "symmetries_continuous": [[list(axis), list(offset)] for axis, offset in continuous],
        }

    @classmethod
    def from_record(cls, record: object) -> Part:
        """Make a part, without its mesh, from what :meth:`to_record` returned.

        Args:
            record: A mapping from a file that anybody may have written.

        Raises:
            UserError: A field is missing, unknown, or not what ``to_record`` writes.
        """
        return cls(**check_record(record))


def make_part(
    name: str,
    mesh: Mesh | None,
    points: Float[np.ndarray, "points 3"] | None = None,
    *,
    symmetries_discrete: Float[np.ndarray, "symmetries 4 4"] | None = None,
    symmetries_continuous: tuple[tuple[tuple[float, ...], tuple[float, ...]], ...] = (),
    unit: str = "m",
) -> Part:
    """Measure a mesh and make the part it describes.

    A mesh of over 200,000 triangles is measured as it is, so that poses, errors and the hash do not
    depend on it, and then decimated for rendering, which the log says.

    Args:
        name: The label of the part's instances.
        mesh: Triangles in metres; None for an object known by its points only.
        points: ADD points in metres; by default 2,000 fixed-seed samples of the surface.
        symmetries_discrete: Rigid transforms that map the part onto itself.
        symmetries_continuous: Axes of rotational symmetry.
        unit: The unit of the file the mesh was read from, named when the size is unlikely.

    Raises:
        UserError: The name is empty or too long, the diameter lies outside 5 mm – 5 m, or the mesh
            has too many triangles of which no larger ones can be made.
        ValueError: There is neither a mesh nor points.
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
