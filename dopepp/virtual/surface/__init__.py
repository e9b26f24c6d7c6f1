"""Surfaces: meshes prepared for rendering, with normals, texture, ambient occlusion and hull."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from dopepp.core.compiled import Array, compiled
from dopepp.core.errors import UserError
from dopepp.geometry.rotation import Vector
from dopepp.parts.mesh import Faces, Points, Vertices, connected, largest_distance
from dopepp.parts.mesh.read import find_topology
from dopepp.parts.part import Mesh
from dopepp.virtual.sensor import SRGB_TO_LINEAR
from dopepp.virtual.surface.occlusion import OpenSky, bake_open_sky, spread_directions
from dopepp.virtual.surface.texture import Texture, make_texture

Corners = Float[np.ndarray, "faces 3 3"]
PerFace = Float[np.ndarray, "faces"]

_CREASE_ANGLE_DEG: Final = 35.0
"""Faces that meet at a larger angle keep a sharp edge; a CAD cylinder has facets of 5° to 30°."""

_HULL_DIRECTIONS: Final = 400  # search directions for the extreme points of a large mesh
_NUM_POINTS: Final = 400  # surface points that cast a mesh's shadow on a plane
_MAX_CORNERS: Final = 1024  # most triangles at a vertex with averaged normals (quadratic time)


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles for the renderers; positions in the object frame, metres."""

    vertices: Vertices  # float64; ``faces`` are their indices, int32
    faces: Faces
    normals: Corners  # Unit normal of every face's corner, object frame, float32
    # Index of every face's smooth patch, int32: faces that connect without a crease.
    patches: Int[np.ndarray, "faces"]
    # Texture coordinates per vertex, v up; shape (0, 2) without a texture.
    uv: Float[np.ndarray, "uvs 2"]
    # Linear albedo per vertex; shape (0, 3) without colours or with a texture.
    colours: Float32[np.ndarray, "colours 3"]
    texture: Texture | None
    sky: OpenSky
    closed: bool  # Whether it is watertight with outward winding, so that back faces can be omitted
    hull: Float[np.ndarray, "hull 3"]  # Extreme vertices that bound the mesh's image
    points: Points  # Points spread evenly over the surface, about ``spacing`` apart
    spacing: float

    @property
    def is_coloured(self) -> bool:
        """Whether the surface has a texture or vertex colours."""
        return self.texture is not None or len(self.colours) > 0

    @property
    def radius(self) -> float:
        """Largest distance of a vertex from the centre of the bounding box, metres."""
        return float(np.linalg.norm(self.hull - self.centre, axis=1).max())

    @cached_property
    def centre(self) -> Vector:
        """Centre of the bounding box, object frame, metres."""
        return np.asarray((self.hull.min(axis=0) + self.hull.max(axis=0)) / 2)

    @cached_property
    def diameter(self) -> float:
        """Largest distance between two vertices, metres."""
        return largest_distance(self.hull)

    def scaled(self, scale: Vector) -> Surface:
        """Return the surface stretched along the object's x, y and z by positive factors.

        Ambient occlusion is not recomputed, which is accurate enough for factors up to two.
        """
        normals = self.normals / np.asarray(scale, np.float32)
        normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-20)
        return replace(
            self,
            vertices=self.vertices * scale,
            hull=self.hull * scale,
            normals=normals,
            points=self.points * scale,
            spacing=self.spacing * float(np.max(scale)),
        )


def make_surface(mesh: Mesh) -> Surface:
    """Prepare a mesh for rendering; takes a quarter of a second, so call it once per part.

    Raises:
        UserError: The mesh has no faces, a value that is not finite, or a wrong vertex index.
    """
    vertices = np.ascontiguousarray(mesh.vertices, np.float64)
    faces = np.array(mesh.faces, np.int32, order="C")  # read-only faces would compile again
    fix = "repair the mesh or export it again"
    if len(faces) == 0 or not np.isfinite(vertices).all():
        problem = f"a mesh of {len(vertices)} vertices and {len(faces)} faces to render"
        raise UserError(problem, "at least one face and finite vertices", fix)
    if faces.min() < 0 or faces.max() >= len(vertices):  # compiled code does not check indices
        problem = f"a mesh with a face of vertices {faces.min()} to {faces.max()}"
        raise UserError(problem, f"vertices 0 to {len(vertices) - 1}", fix)
    merged = _merge_vertices(vertices)[faces]
    edges = vertices[faces[:, [1, 2, 0]]] - vertices[faces]
    doubled = np.cross(edges[:, 0], edges[:, 1])
    length = np.linalg.norm(doubled, axis=1)
    normals = _corner_normals(merged, doubled, length, edges)
    if mesh.normals is not None:
        _use_file_normals(normals, mesh.normals[faces], doubled, length)
    closed = _is_closed(merged, vertices[faces])
    uv, texture = np.zeros((0, 2), np.float32), None
    colours = np.zeros((0, 3), np.float32)
    if mesh.uv is not None and mesh.texture is not None:
        uv = np.ascontiguousarray(mesh.uv, np.float32)
        if len(uv) != len(vertices) or not np.isfinite(uv).all():
            problem = f"{len(uv)} texture coordinates of a mesh of {len(vertices)} vertices"
            raise UserError(problem, "one finite texture coordinate per vertex", fix)
        texture = make_texture(mesh.texture, uv, faces)
    elif mesh.colours is not None:
        colours = SRGB_TO_LINEAR[mesh.colours]
    # Vertices at the same position may have different texture coordinates.
    patches = _smooth_patches(merged if texture is None else faces, normals, length > 0)
    sky = bake_open_sky(vertices, faces, normals, closed)
    hull = vertices[np.unique(faces)]
    if len(hull) > _HULL_DIRECTIONS:
        # Directions are processed singly; together they would need gigabytes for a large mesh.
        extreme = [int((hull @ along).argmax()) for along in spread_directions(_HULL_DIRECTIONS)]
        hull = hull[np.unique(extreme)]
    spacing = float(np.sqrt(length.sum() / 2 / _NUM_POINTS))
    points = _spread_points(vertices[faces], length)
    return Surface(
        vertices, faces, normals, patches, uv, colours, texture, sky, closed, hull, points, spacing
    )


def _spread_points(corners: Corners, weights: PerFace) -> Points:
    """Return points spread over triangles in proportion to ``weights``; corners if all are 0."""
    if weights.sum() <= 0.0:
        return corners.reshape(-1, 3)[:_NUM_POINTS]
    levels = (np.arange(_NUM_POINTS) + 0.5) / _NUM_POINTS * weights.sum()
    chosen = np.minimum(np.searchsorted(np.cumsum(weights), levels), len(weights) - 1)
    # A low-discrepancy sequence within the triangles (Roberts' R2), folded into each.
    share = (np.arange(1, _NUM_POINTS + 1)[:, None] * (0.7548776662466927, 0.5698402909980532)) % 1
    share = np.where(share.sum(axis=1, keepdims=True) > 1, 1 - share, share)
    a, b, c = corners[chosen].transpose(1, 0, 2)
    return np.asarray(a + share[:, :1] * (b - a) + share[:, 1:] * (c - a))


def _merge_vertices(vertices: Vertices) -> Int[np.ndarray, "vertices"]:
    """Return an index per vertex that vertices at equal positions share."""
    # STL and UV seams split vertices, so vertices in the same cell of a fine grid are merged. Three
    # coordinates of 21 bits fit into an integer of 64 bits.
    step = max(float(np.ptp(vertices, axis=0).max()), 1e-12) / (2**21 - 1)
    cells = np.round((vertices - vertices.min(axis=0)) / step).astype(np.int64)
    keys = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
    return np.asarray(np.unique(keys, return_inverse=True)[1].reshape(-1), np.int64)


def _is_closed(merged: Faces, triangles: Corners) -> bool:
    """Return whether each edge has two faces of consistent winding, and the volume is positive."""
    collapsed = (merged == merged[:, [1, 2, 0]]).any(axis=1)
    topology = find_topology(merged[~collapsed])
    if collapsed.all() or not topology.is_closed or topology.opposed.any():
        return False
    a, b, c = (triangles - triangles.reshape(-1, 3).mean(axis=0)).transpose(1, 0, 2)
    return bool(np.einsum("ij,ij->", a, np.cross(b, c)) > 0)


def _corner_normals(
    merged: Faces, doubled: Float[np.ndarray, "faces 3"], length: PerFace, edges: Corners
) -> Corners:
    """Return angle-weighted corner normals (Thürmer and Wüthrich 1998), not averaged over creases.

    ``doubled`` is the cross product of two edges of every face, and ``length`` its length.
    """
    face_normals = doubled / np.maximum(length, 1e-300)[:, None]
    unit = edges / np.maximum(np.linalg.norm(edges, axis=2, keepdims=True), 1e-300)
    cosines = -(unit * unit[:, [2, 0, 1]]).sum(axis=2)
    weights = np.arccos(np.clip(cosines, -1.0, 1.0)) * (length > 0)[:, None]
    corners = np.argsort(merged.reshape(-1), kind="stable")
    counts = np.bincount(merged.reshape(-1), minlength=int(merged.max()) + 1)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    normals = np.empty((len(merged), 3, 3), np.float32)
    cosine = float(np.cos(np.radians(_CREASE_ANGLE_DEG)))
    _average_normals(face_normals, weights, offsets, corners, cosine, normals)
    return normals


def _use_file_normals(
    normals: Corners, in_file: Corners, doubled: Float[np.ndarray, "faces 3"], length: PerFace
) -> None:
    """Replace computed normals by the file's normals that are close to the face's normal.

    Files also average normals over sharp edges; such normals are over half the crease angle away
    from the face's normal.
    """
    with np.errstate(all="ignore"):  # normals may be zero or not finite
        unit = in_file / np.linalg.norm(in_file, axis=2, keepdims=True)
        facing = np.einsum("fki,fi->fk", unit, doubled / np.maximum(length, 1e-300)[:, None])
        near = facing >= math.cos(math.radians(_CREASE_ANGLE_DEG / 2))
    normals[near] = unit[near]


@compiled()
def _average_normals(
    face_normals: Array, weights: Array, offsets: Array, corners: Array, cosine: float, out: Array
) -> None:
    """Average normals at every corner over the faces around its vertex that meet without a crease.

    Vertex v has the corners from ``offsets[v]`` to ``offsets[v + 1]`` of ``corners``, numbered
    3·face + k. Normals of degenerate faces are zero. ``cosine`` is that of the crease angle.
    """
    for vertex in range(offsets.shape[0] - 1):
        for p in range(offsets[vertex], offsets[vertex + 1]):
            face, k = corners[p] // 3, corners[p] % 3
            nx, ny, nz = face_normals[face, 0], face_normals[face, 1], face_normals[face, 2]
            sx, sy, sz = 0.0, 0.0, 0.0
            # All pairs of a vertex's faces are compared; a hub of a million faces stays flat.
            first, last = offsets[vertex], offsets[vertex + 1]
            if last - first > _MAX_CORNERS:
                first, last = p, p + 1
            for q in range(first, last):
                other, m = corners[q] // 3, corners[q] % 3
                ox, oy, oz = face_normals[other, 0], face_normals[other, 1], face_normals[other, 2]
                if nx * ox + ny * oy + nz * oz >= cosine:
                    sx += weights[other, m] * ox
                    sy += weights[other, m] * oy
                    sz += weights[other, m] * oz
            norm = math.sqrt(sx * sx + sy * sy + sz * sz)
            if norm > 0.0:
                out[face, k, 0], out[face, k, 1], out[face, k, 2] = sx / norm, sy / norm, sz / norm
            else:
                out[face, k, 0], out[face, k, 1], out[face, k, 2] = nx, ny, nz


def _smooth_patches(
    corners: Faces, normals: Corners, usable: Bool[np.ndarray, "faces"]
) -> Int[np.ndarray, "faces"]:
    """Return each face's smooth patch: faces connected by edges without a crease share an index.

    Normals of corners are equal across a smooth edge. Only ``usable`` faces connect other faces.
    """
    count = int(corners.max()) + 1
    start, end = corners, corners[:, [1, 2, 0]]
    keys = (np.minimum(start, end) * np.int64(count) + np.maximum(start, end)).reshape(-1)
    order = np.argsort(keys, kind="stable")
    shared = np.flatnonzero(np.diff(keys[order]) == 0)
    first, second = order[shared] // 3, order[shared + 1] // 3
    meet = corners[first][:, :, None] == corners[second][:, None]
    products = normals[first][:, :, None] * normals[second][:, None]
    agree = products.sum(axis=-1, dtype=np.float64) > 0.999
    smooth = usable[first] & usable[second] & (agree | ~meet).all(axis=(1, 2))
    return connected(first[smooth], second[smooth], len(corners))[1].astype(np.int32)
