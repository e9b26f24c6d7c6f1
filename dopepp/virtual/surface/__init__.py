"""A mesh made ready for rendering: smooth normals with sharp creases, texture, open sky, hull."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Float, Int, UInt8

from dopepp.core.errors import UserError
from dopepp.geometry.rotation import Vector
from dopepp.parts.mesh.measure import Faces, Points, Vertices
from dopepp.parts.part import Mesh
from dopepp.virtual.surface.normals import corner_normals, is_closed, merge_vertices, smooth_patches
from dopepp.virtual.surface.occlusion import OpenSky, bake_open_sky, spread_directions
from dopepp.virtual.surface.texture import Texture, make_texture

CREASE_ANGLE_DEG: Final = 35.0
"""Faces that meet at a larger angle keep a sharp edge; a CAD cylinder has facets of 5° to 30°."""

_HULL_DIRECTIONS: Final = 400
"""Extreme points along so many directions stand for a mesh when its image size is measured."""

_NUM_POINTS: Final = 400
"""Points that stand for a mesh where a plane is darkened beside it."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles as the rasteriser takes them.

    Attributes:
        vertices: Object frame, metres, float64.
        faces: Vertex indices, int32.
        normals: Unit normal of every face's corner, object frame, float32.
        patches: Number of every face's smooth patch, int32: faces that connect without a crease.
        uv: Texture coordinates per vertex, v up; shape (0, 2) without a texture.
        closed: Watertight with outward winding, so back faces can be dropped.
        hull: Extreme vertices that bound the mesh's image, object frame, metres.
        points: Points spread evenly over the surface, object frame, metres.
        spacing: About the distance between neighbours among them, metres.
    """

    vertices: Vertices
    faces: Faces
    normals: Float[np.ndarray, "faces 3 3"]
    patches: Int[np.ndarray, "faces"]
    uv: Float[np.ndarray, "uvs 2"]
    texture: Texture | None
    sky: OpenSky
    closed: bool
    hull: Float[np.ndarray, "hull 3"]
    points: Points
    spacing: float

    @property
    def radius(self) -> float:
        """Largest distance of a vertex from the object frame's origin, metres."""
        return float(np.linalg.norm(self.hull, axis=1).max())

    @property
    def area(self) -> float:
        """Surface area, m²."""
        a, b, c = self.vertices[self.faces].transpose(1, 0, 2)
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)

    @property
    def uv_area(self) -> float:
        """Area of the faces in texture space (1 = the whole texture)."""
        if self.texture is None:
            return 0.0
        a, b, c = self.uv[self.faces].transpose(1, 0, 2)
        (along, across) = (b - a).T, (c - a).T
        return float(np.abs(along[0] * across[1] - along[1] * across[0]).sum() / 2)

    @property
    def textures(self) -> tuple[UInt8[np.ndarray, "_ _ 3"], ...]:
        """The texture and its halvings as images, the finest first; empty without one."""
        return () if self.texture is None else self.texture.images

    def scaled(self, scale: Vector) -> Surface:
        """Return the surface stretched along its axes by positive factors.

        The open sky stays that of the unstretched surface, which is near enough for stretches up
        to two.
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


def make_surface(mesh: Mesh, crease_angle_deg: float = CREASE_ANGLE_DEG) -> Surface:
    """Prepare a mesh for rendering (a quarter of a second; do it once per part).

    Raises:
        UserError: The mesh has no faces, a vertex or a texture coordinate that is not finite, or a
            face with a vertex that does not exist.
    """
    vertices = np.ascontiguousarray(mesh.vertices, np.float64)
    faces = np.ascontiguousarray(mesh.faces, np.int32)
    if len(faces) == 0 or not np.isfinite(vertices).all():
        raise UserError(
            f"a mesh of {len(vertices)} vertices and {len(faces)} faces to render",
            "at least one face and finite vertices",
            "repair the mesh or export it again",
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        # Compiled code does not check indices.
        raise UserError(
            f"a mesh with a face of vertices {faces.min()} to {faces.max()}",
            f"vertices 0 to {len(vertices) - 1}",
            "repair the mesh or export it again",
        )
    merged = merge_vertices(vertices)[faces]
    edges = vertices[faces[:, [1, 2, 0]]] - vertices[faces]
    doubled = np.cross(edges[:, 0], edges[:, 1])
    length = np.linalg.norm(doubled, axis=1)
    normals = corner_normals(merged, doubled, length, edges, crease_angle_deg)
    closed = is_closed(merged, vertices[faces])
    uv, texture = np.zeros((0, 2), np.float32), None
    if mesh.uv is not None and mesh.texture is not None:
        uv = np.ascontiguousarray(mesh.uv, np.float32)
        if len(uv) != len(vertices) or not np.isfinite(uv).all():
            raise UserError(
                f"{len(uv)} texture coordinates of a mesh of {len(vertices)} vertices",
                "one finite texture coordinate per vertex",
                "export the mesh again",
            )
        texture = make_texture(mesh.texture, uv, faces)
    return Surface(
        vertices=vertices,
        faces=faces,
        normals=normals,
        # Texture coordinates may differ where positions do not.
        patches=smooth_patches(merged if texture is None else faces, normals, length > 0),
        uv=uv,
        texture=texture,
        sky=bake_open_sky(vertices, faces, normals, closed),
        closed=closed,
        hull=_extremes(vertices[np.unique(faces)]),
        points=_spread_points(vertices[faces], length),
        spacing=float(np.sqrt(length.sum() / 2 / _NUM_POINTS)),
    )


def _extremes(vertices: Vertices) -> Float[np.ndarray, "hull 3"]:
    """Return the vertices that are extreme along directions spread over the sphere."""
    if len(vertices) <= _HULL_DIRECTIONS:
        return vertices
    # One direction after the other: all at once would take gigabytes for a large mesh.
    extreme = [int((vertices @ along).argmax()) for along in spread_directions(_HULL_DIRECTIONS)]
    return np.asarray(vertices[np.unique(extreme)])


def _spread_points(
    corners: Float[np.ndarray, "faces 3 3"], weights: Float[np.ndarray, "faces"]
) -> Points:
    """Return points evenly spread over triangles, by area; the corners of a mesh without any."""
    if weights.sum() <= 0.0:
        return corners.reshape(-1, 3)[:_NUM_POINTS]
    places = (np.arange(_NUM_POINTS) + 0.5) / _NUM_POINTS * weights.sum()
    chosen = np.minimum(np.searchsorted(np.cumsum(weights), places), len(weights) - 1)
    # A low-discrepancy sequence within the triangles (Roberts' R2), folded into each.
    share = (np.arange(1, _NUM_POINTS + 1)[:, None] * (0.7548776662466927, 0.5698402909980532)) % 1
    share = np.where(share.sum(axis=1, keepdims=True) > 1, 1 - share, share)
    a, b, c = corners[chosen].transpose(1, 0, 2)
    return np.asarray(a + share[:, :1] * (b - a) + share[:, 1:] * (c - a))
