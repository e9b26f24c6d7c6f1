"""A mesh at a pose: where its vertices are on the picture, and which pixels it covers.

The triangles of a closed mesh that face the camera cover all that the mesh covers, and each covers
a pixel once. So does their common border wind around it as often as they cover it, and few edges
are on that border: they are crossed row by row. Of an open mesh every triangle is filled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, UInt8

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.camera import CameraMatrix, Transform
from dopepp.inference.refinement.mesh import OutlineMesh

NEAR: Final = 1e-3
"""Metres before the camera that every vertex must keep."""


@dataclass(frozen=True, eq=False)
class Posed:
    """A mesh at a pose.

    Attributes:
        T_cam_obj: The pose.
        arms: Vertices from the object's origin, camera axes, metres.
        pixels: Where they are on the picture.
        front: Which triangles face the camera.
    """

    T_cam_obj: Transform
    arms: Float[np.ndarray, "vertices 3"]
    pixels: Float[np.ndarray, "vertices 2"]
    front: Bool[np.ndarray, "faces"]


def posed(mesh: OutlineMesh, T_cam_obj: Transform, K: CameraMatrix) -> Posed | None:
    """Put a mesh at a pose; None where some of it is not before the camera."""
    arms, pixels = np.empty_like(mesh.vertices), np.empty((len(mesh.vertices), 2))
    front = np.empty(len(mesh.faces), np.bool_)
    if not _pose(mesh.vertices, mesh.planes, T_cam_obj, K, arms, pixels, front):
        return None
    return Posed(T_cam_obj, arms, pixels, front)


def filled_mask(
    mesh: OutlineMesh, at: Posed, size: tuple[int, int]
) -> UInt8[np.ndarray, "height width"]:
    """Return 1 at the pixels of (width, height) whose centres a posed mesh covers, else 0."""
    width, height = size
    mask = np.zeros((height, width), np.uint8)
    if mesh.is_closed:
        turns = np.zeros((height, width + 1), np.int32)
        _wind(at.pixels, mesh.edges, mesh.sides, at.front, turns, mask)
    else:
        _fill(at.pixels, mesh.faces, mask)
    return mask


@compiled()
def _pose(
    vertices: Array, planes: Array, T: Array, K: Array, arms: Array, pixels: Array, front: Array
) -> bool:
    """Write arms, pixels and facing; False where a vertex is not before the camera."""
    for i in range(len(vertices)):
        for r in range(3):
            arms[i, r] = (
                T[r, 0] * vertices[i, 0] + T[r, 1] * vertices[i, 1] + T[r, 2] * vertices[i, 2]
            )
        z = arms[i, 2] + T[2, 3]
        if not z > NEAR:
            return False
        pixels[i, 0] = K[0, 0] * (arms[i, 0] + T[0, 3]) / z + K[0, 2]
        pixels[i, 1] = K[1, 1] * (arms[i, 1] + T[1, 3]) / z + K[1, 2]
    # The camera's place in the object's frame.
    x = -(T[0, 0] * T[0, 3] + T[1, 0] * T[1, 3] + T[2, 0] * T[2, 3])
    y = -(T[0, 1] * T[0, 3] + T[1, 1] * T[1, 3] + T[2, 1] * T[2, 3])
    z = -(T[0, 2] * T[0, 3] + T[1, 2] * T[1, 3] + T[2, 2] * T[2, 3])
    for f in range(len(planes)):
        front[f] = planes[f, 0] * x + planes[f, 1] * y + planes[f, 2] * z > planes[f, 3]
    return True


@compiled()
def _fill(pixels: Array, faces: Array, mask: Array) -> None:
    """Set the pixels whose centres lie in a triangle, row by row."""
    height, width = mask.shape
    left, right = np.empty(height), np.empty(height)
    for f in range(len(faces)):
        top, bottom = height, -1
        for c in range(3):
            y = pixels[faces[f, c], 1]
            top, bottom = min(top, max(0.0, math.ceil(y))), max(bottom, math.floor(y))
        first, last = int(top), int(min(bottom, height - 1.0))
        for v in range(first, last + 1):
            left[v], right[v] = math.inf, -math.inf
        for c in range(3):
            i, j = faces[f, c], faces[f, (c + 1) % 3]
            if pixels[i, 1] > pixels[j, 1]:
                i, j = j, i
            y, rise = pixels[i, 1], pixels[j, 1] - pixels[i, 1]
            slope = (pixels[j, 0] - pixels[i, 0]) / rise if rise > 0.0 else 0.0
            low, high = max(0.0, math.ceil(y)), min(height - 1.0, math.floor(pixels[j, 1]))
            for v in range(int(low), int(high) + 1):
                x = pixels[i, 0] + slope * (v - y)
                left[v], right[v] = min(left[v], x), max(right[v], x)
        for v in range(first, last + 1):
            # Rounding must not open a gap between two triangles.
            start, end = max(0.0, math.ceil(left[v] - 1e-9)), min(width - 1.0, right[v] + 1e-9)
            if end >= start:
                mask[v, int(start) : int(end) + 1] = 1


@compiled()
def _wind(
    pixels: Array, edges: Array, sides: Array, front: Array, turns: Array, mask: Array
) -> None:
    """Set the pixels whose centres the border of the triangles that face the camera winds around.

    ``turns`` is as high as the mask and wider by one, and zero: it counts crossings.
    """
    height, width = mask.shape
    for e in range(len(edges)):
        one, other = front[sides[e, 0]], front[sides[e, 1]]
        if one == other:
            continue
        # An edge runs as its first triangle does, and against its second one.
        i, j = (edges[e, 0], edges[e, 1]) if one else (edges[e, 1], edges[e, 0])
        way = 1
        if pixels[i, 1] > pixels[j, 1]:
            i, j, way = j, i, -1
        y, rise = pixels[i, 1], pixels[j, 1] - pixels[i, 1]
        low, high = max(0.0, math.ceil(y)), min(height - 1.0, math.ceil(pixels[j, 1]) - 1.0)
        for v in range(int(low), int(high) + 1):
            x = pixels[i, 0] + (pixels[j, 0] - pixels[i, 0]) / rise * (v - y)
            turns[v, int(min(max(0.0, math.ceil(x)), width))] += way
    for v in range(height):
        count = 0
        for u in range(width):
            count += turns[v, u]
            mask[v, u] = count != 0
