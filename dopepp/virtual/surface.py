"""A mesh made ready for rendering: smooth normals with sharp creases, texture levels, hull."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from dopepp.errors import UserError
from dopepp.parts.part import Mesh
from dopepp.virtual.compiled import Array, compiled

CREASE_ANGLE_DEG: Final = 35.0
"""Faces that meet at a larger angle keep a sharp edge; a CAD cylinder has facets of 5° to 30°."""

_MERGE_SHARE: Final = 1e-7
"""Vertices closer than this share of the mesh's size are one (STL and UV seams split them)."""

_HULL_DIRECTIONS: Final = 400
"""Extreme points along so many directions stand for a mesh when its image size is measured."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles as the rasteriser takes them.

    Attributes:
        vertices: Object frame, metres, float64.
        faces: Vertex indices, int32.
        normals: Unit normal of every face's corner, object frame, float32.
        uv: Texture coordinates per vertex, v up; shape (0, 2) without a texture.
        textures: RGB texture and its halvings down to one texel; one unread texel without uv.
        closed: Watertight with outward winding, so back faces can be dropped.
        hull: Extreme vertices that bound the mesh's image, object frame, metres.
        area: Surface area, m².
        uv_area: Area of the faces in texture space (1 = the whole texture).
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    normals: Float[np.ndarray, "faces 3 3"]
    uv: Float[np.ndarray, "uvs 2"]
    textures: tuple[UInt8[np.ndarray, "_ _ 3"], ...]
    closed: bool
    hull: Float[np.ndarray, "hull 3"]
    area: float
    uv_area: float

    @property
    def radius(self) -> float:
        """Largest distance of a vertex from the object frame's origin, metres."""
        return float(np.linalg.norm(self.hull, axis=1).max())

    def scaled(self, scale: Float[np.ndarray, "3"]) -> Surface:
        """Return the surface stretched along its axes by positive factors."""
        normals = self.normals / np.asarray(scale, np.float32)
        normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-20)
        return replace(
            self, vertices=self.vertices * scale, hull=self.hull * scale, normals=normals
        )


def make_surface(mesh: Mesh, crease_angle_deg: float = CREASE_ANGLE_DEG) -> Surface:
    """Prepare a mesh for rendering (milliseconds; do it once per part).

    Raises:
        UserError: The mesh has no faces, or a vertex that is not finite.
    """
    vertices = np.ascontiguousarray(mesh.vertices, np.float64)
    faces = np.ascontiguousarray(mesh.faces, np.int32)
    if len(faces) == 0 or not np.isfinite(vertices).all():
        raise UserError(
            f"a mesh of {len(vertices)} vertices and {len(faces)} faces to render",
            "at least one face and finite vertices",
            "repair the mesh or export it again",
        )
    merged = _merge(vertices)[faces]
    edges = vertices[faces[:, [1, 2, 0]]] - vertices[faces]
    doubled = np.cross(edges[:, 0], edges[:, 1])
    length = np.linalg.norm(doubled, axis=1)
    has_texture = mesh.uv is not None and mesh.texture is not None
    uv = np.ascontiguousarray(mesh.uv, np.float32) if has_texture else np.zeros((0, 2), np.float32)
    textures = _halvings(mesh.texture) if has_texture else (np.zeros((1, 1, 3), np.uint8),)
    uv_area = 0.0
    if has_texture:
        along, across = uv[faces[:, 1]] - uv[faces[:, 0]], uv[faces[:, 2]] - uv[faces[:, 0]]
        uv_area = float(np.abs(along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]).sum() / 2)
    return Surface(
        vertices=vertices,
        faces=faces,
        normals=_normals(merged, doubled, length, edges, crease_angle_deg),
        uv=uv,
        textures=textures,
        closed=_is_closed(merged, vertices[faces]),
        hull=_extremes(vertices[np.unique(faces)]),
        area=float(length.sum() / 2),
        uv_area=uv_area,
    )


def _merge(vertices: Float[np.ndarray, "vertices 3"]) -> Int[np.ndarray, "vertices"]:
    """Number vertices so that equal positions share a number."""
    step = max(float(np.ptp(vertices, axis=0).max()), 1e-12) * _MERGE_SHARE
    keys = np.round((vertices - vertices.min(axis=0)) / step).astype(np.int64)
    return np.asarray(np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1), np.int64)


def _normals(
    merged: Int[np.ndarray, "faces 3"],
    doubled: Float[np.ndarray, "faces 3"],
    length: Float[np.ndarray, "faces"],
    edges: Float[np.ndarray, "faces 3 3"],
    crease_angle_deg: float,
) -> Float[np.ndarray, "faces 3 3"]:
    """Return angle-weighted corner normals (Thürmer and Wüthrich 1998) with creases."""
    face_normals = doubled / np.maximum(length, 1e-300)[:, None]
    unit = edges / np.maximum(np.linalg.norm(edges, axis=2, keepdims=True), 1e-300)
    cosines = -(unit * unit[:, [2, 0, 1]]).sum(axis=2)
    weights = np.arccos(np.clip(cosines, -1.0, 1.0)) * (length > 0)[:, None]
    corners = np.argsort(merged.reshape(-1), kind="stable")
    counts = np.bincount(merged.reshape(-1), minlength=int(merged.max()) + 1)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    normals = np.empty((len(merged), 3, 3), np.float32)
    cosine = float(np.cos(np.radians(crease_angle_deg)))
    _average_normals(face_normals, weights, offsets, corners, cosine, normals)
    return normals


@compiled()
def _average_normals(
    face_normals: Array, weights: Array, offsets: Array, corners: Array, cosine: float, out: Array
) -> None:
    """Average, at every corner, the normals of the faces around its vertex within an angle.

    Args:
        face_normals: Unit normal of every face, shape (F, 3), zero for degenerate ones.
        weights: Weight of every corner (its angle in the triangle), shape (F, 3).
        offsets: Start of every vertex's corners in ``corners``, shape (V + 1,).
        corners: Corner numbers 3·face + k sorted by vertex, shape (3F,).
        cosine: Cosine of the crease angle; faces that differ by more are not averaged.
        out: Normals, shape (F, 3, 3), float32.
    """
    for vertex in range(offsets.shape[0] - 1):
        for p in range(offsets[vertex], offsets[vertex + 1]):
            face, k = corners[p] // 3, corners[p] % 3
            nx, ny, nz = face_normals[face, 0], face_normals[face, 1], face_normals[face, 2]
            sx, sy, sz = 0.0, 0.0, 0.0
            for q in range(offsets[vertex], offsets[vertex + 1]):
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


def _is_closed(
    merged: Int[np.ndarray, "faces 3"], triangles: Float[np.ndarray, "faces 3 3"]
) -> bool:
    """Tell whether every directed edge has exactly one opposite and the volume is positive."""
    collapsed = (merged == merged[:, [1, 2, 0]]).any(axis=1)
    start, end = merged[~collapsed], merged[~collapsed][:, [1, 2, 0]]
    count = int(merged.max()) + 1
    forward, backward = (start * count + end).reshape(-1), (end * count + start).reshape(-1)
    if len(np.unique(forward)) != len(forward):
        return False
    if not np.array_equal(np.sort(forward), np.sort(backward)):
        return False
    a, b, c = (triangles - triangles.reshape(-1, 3).mean(axis=0)).transpose(1, 0, 2)
    return bool(np.einsum("ij,ij->", a, np.cross(b, c)) > 0)


def _extremes(vertices: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "hull 3"]:
    """Return the vertices that are extreme along directions spread over the sphere."""
    if len(vertices) <= _HULL_DIRECTIONS:
        return vertices
    # A Fibonacci spiral spreads directions evenly.
    k = np.arange(_HULL_DIRECTIONS) + 0.5
    z, angle = 1 - 2 * k / _HULL_DIRECTIONS, k * np.pi * (1 + np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    directions = np.stack([ring * np.cos(angle), ring * np.sin(angle), z])
    return np.asarray(vertices[np.unique((vertices @ directions).argmax(axis=0))])


def _halvings(texture: UInt8[np.ndarray, "_ _ 3"] | None) -> tuple[UInt8[np.ndarray, "_ _ 3"], ...]:
    """Return a texture and its successive halvings (mip levels), the finest first."""
    levels = [np.ascontiguousarray(texture, np.uint8)]
    while max(levels[-1].shape[:2]) > 1:
        height, width = (max(side // 2, 1) for side in levels[-1].shape[:2])
        level = cv2.resize(levels[-1], (width, height), interpolation=cv2.INTER_AREA)
        levels.append(np.ascontiguousarray(level))
    return tuple(levels)
