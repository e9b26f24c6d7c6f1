"""Mesh files and YCB-Video models, in metres, checked before use.

Triangles are oriented consistently, and no vertex is moved. To add a format, write a reader that
returns a :class:`RawMesh` and raises for a damaged file, and add it to :data:`READERS`.
"""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int

from dopepp.core.errors import UserError
from dopepp.core.files import read_limited
from dopepp.parts.mesh import Faces, Points, Vertices, connected, face_areas, weld
from dopepp.parts.mesh.library import read_3mf, read_glb, read_stl
from dopepp.parts.mesh.obj import read_obj, read_off
from dopepp.parts.mesh.ply import read_ply
from dopepp.parts.part import UNITS, Mesh, Part, RawMesh, make_part

logger = logging.getLogger(__name__)
ASSUMED_UNIT: Final = "mm"  # Unit of most CAD files that cannot state a unit
MAX_BYTES: Final = 250_000_000  # Largest file, about five million triangles; bounds memory
MAX_POINTS_BYTES: Final = 20_000_000  # Largest ``points.xyz``: half a million points
READERS: Final[dict[str, Callable[[Path], RawMesh]]] = {
    ".stl": read_stl,
    ".obj": read_obj,
    ".ply": read_ply,
    ".glb": read_glb,
    ".3mf": read_3mf,
    ".off": read_off,
}
"""Readers by suffix."""

MANY_CAVITIES: Final = 1000  # more than any part has; further inverted surfaces count as bodies


def read_mesh(path: str | Path, unit: str | None = None) -> Mesh:
    """Read an STL, OBJ, PLY, GLB, 3MF or OFF file, and convert it to metres.

    Duplicate STL vertices are merged, zero-area triangles dropped, and the others oriented
    consistently. Surfaces may have holes, and triangles may intersect each other. The unit is mm,
    cm, m or inch (default: as stated by a 3MF file, metres for GLB, and otherwise millimetres, with
    a warning). A texture must lie in the mesh's folder.

    Raises:
        UserError: The file is missing, too large, of another format or damaged; the unit is
            unknown; no face has an area; a coordinate is not finite; a texture is missing, damaged
            or outside the mesh's folder.
    """
    return read_in_unit(path, unit)[0]


def read_in_unit(path: str | Path, unit: str | None = None) -> tuple[Mesh, str]:
    """Like :func:`read_mesh`, but also return the unit in which the file was read."""
    path = Path(path)
    if unit is not None and unit not in UNITS:
        fix = "set the unit in which the file was exported, e.g. unit=mm"
        raise UserError(f"unit={unit!r} for {path}", ", ".join(UNITS), fix)
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        fix = "export the mesh in one of these formats, e.g. as STL"
        raise UserError(f"mesh {path}", f"files ending in {', '.join(READERS)}", fix)
    try:
        is_file = path.is_file()
    except OSError:  # e.g. a name that is too long
        is_file = False
    if not is_file:
        fix = "pass the path of an existing file"
        raise UserError(f"mesh {path}, no such file", "a mesh file", fix)
    if (size := path.stat().st_size) > MAX_BYTES:
        fix = "reduce its triangles, or write it as a binary file"
        raise _damage_error(path, f"{size / 1e6:.0f} MB", fix)
    try:
        raw = reader(path)
    except UserError:
        raise
    except Exception as error:  # parsers raise anything for a damaged file
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        raise _damage_error(path, f"{kind}{error}") from error
    applied = unit or raw.unit or ASSUMED_UNIT
    mesh = _clean_mesh(path, replace(raw, vertices=UNITS[applied] * raw.vertices))
    if unit is None and raw.unit is None:
        logger.warning("%s states no unit: assuming %s (override with unit=…)", path, ASSUMED_UNIT)
    elif raw.unit not in (None, applied):
        message = "%s is in %s by its format, but read in %s as requested"
        logger.warning(message, path, raw.unit, applied)
    return mesh, applied


def ycb_part(root: str | Path, name: str) -> Part:
    """Read an object (a folder in ``models``) from the files of YCB-Video at ``root``.

    ``points.xyz`` and ``textured.obj`` are in metres. Without a ``textured.obj`` the part has no
    mesh, and the ADD points determine its cuboid and diameter.

    Raises:
        UserError: The folder has no models, the name is unknown, or a file is damaged.
    """
    models = Path(root) / "models"
    names = sorted(path.parent.name for path in models.glob("*/points.xyz"))
    if not names:
        problem = f"{root}, which has no models/NAME/points.xyz"
        fix = "set data.root to the root of YCB-Video, or unpack YCB_Video_Models into it"
        raise UserError(problem, "the root of YCB-Video", fix)
    if name not in names:
        fix = "set data.objects to one or more of these names"
        raise UserError(f"unknown object {name!r}", ", ".join(names), fix)
    points_path, mesh_path = models / name / "points.xyz", models / name / "textured.obj"
    mesh = read_mesh(mesh_path, unit="m") if mesh_path.exists() else None
    return make_part(name, mesh, read_points(points_path), unit="m")


def read_points(path: Path) -> Points:
    """Read a text file of points, with x, y and z in each line.

    Raises:
        UserError: The file is missing, too large or damaged.
    """
    try:
        content = read_limited(path, MAX_POINTS_BYTES)
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # numpy only warns of an empty file
            points = np.loadtxt(io.BytesIO(content), ndmin=2)
        if points.shape[1] != 3 or not np.isfinite(points).all():
            raise ValueError(f"shape {points.shape}, or not finite")
    except (OSError, ValueError, UserWarning) as error:
        allowed = "three finite numbers per line"
        raise UserError(f"{path}: {error}", allowed, "unpack the model again") from error
    return np.asarray(points, np.float64)


def _clean_mesh(path: Path, raw: RawMesh) -> Mesh:
    """Check a mesh, drop zero-area triangles and unused vertices, and orient the triangles."""
    vertices, faces, uv = raw.vertices, raw.faces, raw.uv
    if not len(vertices) or not len(faces):
        raise _damage_error(path, f"{len(vertices)} vertices and {len(faces)} faces")
    for values in (vertices, uv):
        if values is not None and not np.isfinite(values).all():
            bad = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
            raise _damage_error(path, f"a coordinate that is not a finite number, vertex {bad + 1}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise _damage_error(path, f"a face index outside of its {len(vertices)} vertices")
    # A triangle of a millionth of the mesh's size has no meaningful normal.
    smallest = 1e-12 * np.square(np.ptp(vertices, axis=0)).sum()
    proper = face_areas(vertices, faces) > smallest
    if not proper.any():
        raise _damage_error(path, f"{len(faces)} faces, none with an area")
    if not proper.all():
        logger.info("%s: dropped %d triangles without area", path, (~proper).sum())
    used, index = np.unique(faces[proper], return_inverse=True)
    vertices, faces = vertices[used], index.reshape(-1, 3)
    topology = find_topology(weld(vertices, faces)[1])
    if not topology.is_closed:
        message = "%s is not watertight: %d open edges, %d edges of more than two triangles"
        logger.info(message, path, topology.num_open, topology.num_crowded)
    inverted = misoriented_faces(vertices, faces, topology)
    if inverted.any():
        logger.info("%s: flipped %d triangles that faced the wrong way", path, inverted.sum())
    return Mesh(
        vertices=vertices,
        faces=flip_faces(faces, inverted).astype(np.int32),
        uv=None if uv is None else np.asarray(uv, np.float64)[used],
        texture=raw.texture,
        colours=None if raw.colours is None else raw.colours[used],
        normals=None if raw.normals is None else raw.normals[used],
    )


def _damage_error(path: Path, problem: str, fix: str = "export the mesh again") -> UserError:
    content = "triangles, finite coordinates and colours of their range"
    allowed = f"a complete mesh with {content}, under {MAX_BYTES / 1e6:.0f} MB"
    return UserError(f"mesh {path} with {problem}", allowed, fix)


@dataclass(frozen=True)
class Topology:
    """Edges of a triangle mesh whose vertices at one position are merged.

    Attributes:
        num_open: Number of edges of a single triangle (rims of holes).
        num_crowded: Number of edges of more than two triangles.
        neighbours: Pairs of triangles that share an edge of exactly two triangles.
        opposed: Whether the triangles of each pair have opposite orientations.
    """

    num_open: int
    num_crowded: int
    neighbours: Int[np.ndarray, "edges 2"]
    opposed: Bool[np.ndarray, " edges"]

    @property
    def is_closed(self) -> bool:
        """Whether every edge has exactly two triangles."""
        return self.num_open == self.num_crowded == 0


def find_topology(corners: Faces) -> Topology:
    """Find the edges of triangles with three different corners; equal positions share an index."""
    start, end = corners.reshape(-1), corners[:, [1, 2, 0]].reshape(-1)
    # Both directions of an edge have the same number, which fits into an int64.
    edges = np.minimum(start, end) * (np.int64(corners.max(initial=0)) + 1) + np.maximum(start, end)
    order = np.argsort(edges, kind="stable")
    first = np.flatnonzero(np.diff(edges[order], prepend=-1))
    uses = np.diff(first, append=len(edges))
    pairs = first[uses == 2]
    corner, opposite = order[pairs], order[pairs + 1]
    return Topology(
        num_open=int((uses == 1).sum()),
        num_crowded=int((uses > 2).sum()),
        neighbours=np.stack([corner // 3, opposite // 3], axis=1),
        opposed=start[corner] == start[opposite],
    )


def misoriented_faces(
    vertices: Vertices, faces: Faces, topology: Topology
) -> Bool[np.ndarray, " faces"]:
    """Find the triangles to flip for consistent surfaces that face outwards if closed.

    Within a connected surface, the orientation with less area is flipped; a Möbius strip remains
    unchanged. A closed surface that faces inwards is flipped, and then every body that faces
    inwards, except cavities, which lie in the box of another body.
    """
    inverted = np.zeros(len(faces), bool)
    if topology.opposed.any():
        inverted = _find_minority(face_areas(vertices, faces), topology)
    if topology.is_closed:
        if _signed_volumes(vertices, flip_faces(faces, inverted)).sum() < 0:
            inverted = ~inverted
        oriented = flip_faces(faces, inverted)
        first_face, second_face = topology.neighbours.T
        count, bodies = connected(first_face, second_face, len(faces))
        volumes = np.bincount(bodies, _signed_volumes(vertices, oriented), minlength=count)
        corner_bodies = np.repeat(bodies, 3)
        boxes = _bounding_boxes(vertices[oriented].reshape(-1, 3), corner_bodies, count)
        enclosed = _find_enclosed(*boxes, np.flatnonzero(volumes < 0))
        inverted ^= ((volumes < 0) & ~enclosed)[bodies]
    return inverted


def flip_faces(faces: Faces, inverted: Bool[np.ndarray, " faces"]) -> Faces:
    """Reverse the order of the corners of the marked triangles."""
    return np.where(inverted[:, None], faces[:, ::-1], faces)


def _find_minority(
    areas: Float[np.ndarray, " faces"], topology: Topology
) -> Bool[np.ndarray, " faces"]:
    """Mark the triangles that face against most of the area of their connected surface."""
    # Each triangle is two nodes of a graph, as it is and flipped, and links join nodes that face
    # the same way. An orientable surface has two components, one per orientation, and triangle f is
    # flipped if the component of its flipped node has more area.
    num_faces = len(areas)
    first_face, second_face = topology.neighbours.T
    swap = np.where(topology.opposed, num_faces, 0)
    start = np.concatenate([first_face, first_face + num_faces])
    end = np.concatenate([second_face + swap, second_face + num_faces - swap])
    count, components = connected(start, end, 2 * num_faces)
    as_is, flipped = components.reshape(2, num_faces)
    weight = np.bincount(as_is, areas, minlength=count)
    flip_is_better = weight[flipped] > weight[as_is]
    tied = (weight[flipped] == weight[as_is]) & (flipped < as_is)
    return np.asarray(flip_is_better | tied)


def body_extents(vertices: Vertices, faces: Faces) -> list[Float[np.ndarray, "3"]]:
    """Return the sides of each separate body's bounding box, by decreasing volume of the box.

    A body is a connected surface (corners at one position are merged) other than a cavity. A cavity
    faces inwards and lies in the box of another body.
    """
    positions, corners = weld(vertices, faces)
    start, end = corners.reshape(-1), corners[:, [1, 2, 0]].reshape(-1)
    count, of_vertex = connected(start, end, len(positions))
    if count == 1:
        return [np.ptp(positions, axis=0)]
    lower, upper = _bounding_boxes(positions, of_vertex, count)
    bodies = of_vertex[corners[:, 0]]
    # Measured from the body's own centre, an open surface has a meaningful sign too.
    a, b, c = (positions[corners] - ((lower + upper) / 2)[bodies][:, None]).swapaxes(0, 1)
    volumes = np.bincount(bodies, np.einsum("ij,ij->i", a, np.cross(b, c)), minlength=count)
    is_body = ~_find_enclosed(lower, upper, np.flatnonzero(volumes < 0))
    extents = (upper - lower)[is_body]
    return list(extents[np.argsort(-extents.prod(axis=1), kind="stable")])


def _bounding_boxes(
    points: Points, bodies: Int[np.ndarray, " points"], count: int
) -> tuple[Float[np.ndarray, "bodies 3"], Float[np.ndarray, "bodies 3"]]:
    """Return the lower and upper corners of the axis-aligned box of each body's points."""
    lower, upper = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(lower, bodies, points)
    np.maximum.at(upper, bodies, points)
    return lower, upper


def _find_enclosed(
    lower: Float[np.ndarray, "bodies 3"],
    upper: Float[np.ndarray, "bodies 3"],
    candidates: Int[np.ndarray, " candidates"],
) -> Bool[np.ndarray, " bodies"]:
    """Mark the first ``MANY_CAVITIES`` candidates whose box lies in the box of another body."""
    enclosed = np.zeros(len(lower), bool)
    for body in candidates[:MANY_CAVITIES]:
        around = (lower < lower[body]).all(axis=1) & (upper > upper[body]).all(axis=1)
        enclosed[body] = around.any()
    return enclosed


def _signed_volumes(vertices: Vertices, faces: Faces) -> Float[np.ndarray, " faces"]:
    """Return the volume between each triangle and the mean vertex, negative if facing it."""
    a, b, c = (vertices - vertices.mean(axis=0))[faces].swapaxes(0, 1)
    return np.asarray(np.einsum("ij,ij->i", a, np.cross(b, c)) / 6)
