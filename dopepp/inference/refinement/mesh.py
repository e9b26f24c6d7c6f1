"""A part's triangles, few enough for outlines, with what tells which of their edges are one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from dopepp.parts.mesh import Faces, Vertices, face_areas, weld
from dopepp.parts.mesh.decimate import decimate
from dopepp.parts.part import MAX_LIGHT_FACES


@dataclass(frozen=True, eq=False)
class OutlineMesh:
    """Triangles with what their outlines need.

    Attributes:
        vertices: Positions, metres.
        faces: Corners of each triangle.
        planes: Normal of each triangle (of any length) and its product with a corner.
        edges: The two vertices of each edge.
        sides: The two triangles at it; the second is −1 where there is one only.
        opposed: 1 where these two run along it in the same direction, else 0.
        is_closed: Whether the triangles that face the camera hide all others.
    """

    vertices: Vertices
    faces: Faces
    planes: Float[np.ndarray, "faces 4"]
    edges: Int[np.ndarray, "edges 2"]
    sides: Int[np.ndarray, "edges 2"]
    opposed: UInt8[np.ndarray, "edges"]
    is_closed: bool


def make_outline_mesh(
    vertices: Vertices, faces: Faces, max_faces: int = MAX_LIGHT_FACES
) -> OutlineMesh:
    """Prepare triangles; more than ``max_faces`` of them are replaced by fewer.

    Raises:
        ValueError: The triangles have no area.
    """
    vertices, faces = weld(np.asarray(vertices, np.float64), np.asarray(faces, np.int64))
    faces = faces[face_areas(vertices, faces) > 0]
    if not len(faces):
        raise ValueError("no triangle with an area")
    if len(faces) > max_faces:
        vertices, faces, *_ = decimate(vertices, faces, None, max_faces)
        faces = faces[face_areas(vertices, faces) > 0]
    a, b, c = vertices[faces].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    planes = np.column_stack([normals, (normals * a).sum(axis=1)])
    start, end = faces.reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    keys = np.minimum(start, end) * len(vertices) + np.maximum(start, end)
    order = np.argsort(keys, kind="stable")
    first = np.flatnonzero(np.diff(keys[order], prepend=-1))
    uses = np.diff(first, append=len(keys))
    one, other = order[first], order[np.where(uses > 1, first + 1, first)]
    opposed = (start[one] == start[other]) & (uses > 1)
    return OutlineMesh(
        vertices, faces, planes,
        edges=np.stack([start[one], end[one]], axis=1),
        sides=np.stack([one // 3, np.where(uses > 1, other // 3, -1)], axis=1),
        opposed=opposed.astype(np.uint8),
        is_closed=bool((uses == 2).all() and not opposed.any()),
    )  # fmt: skip
