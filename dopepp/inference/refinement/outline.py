"""The outline of a mesh at a pose: its silhouette, and points on the silhouette's border.

The border of the triangles that face the camera winds around a pixel as often as these triangles
cover the pixel. The silhouette of a closed mesh is therefore filled row by row from the few edges
on this border, without drawing triangles. In an open mesh, the triangles that face away are filled
in the same way.

An edge is a candidate for the outline if exactly one of its triangles faces the camera, or if it
has only one triangle. It belongs to the outline where the filled mask ends, and not where the mask
is on both sides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.camera import CameraMatrix, Transform
from dopepp.parts.mesh import Faces, Vertices, face_areas, weld
from dopepp.parts.mesh.decimate import decimate
from dopepp.parts.part import MAX_LIGHT_FACES

NEAR: Final = 1e-3  # smallest depth of every vertex, metres

WINDOW_PX: Final = 3.0
"""Radius of the disc of the mask that determines a point's outward direction."""

BESIDE_PX: Final = 1.25
"""Distance from an outline point at which the mask must be 1 on the inside and 0 on the outside."""

LONG_PX: Final = 4.0
"""Length from which an edge determines the normal; the directions of shorter edges vary."""


class OutlineMesh(NamedTuple):
    """A mesh, prepared for silhouettes and outlines."""

    vertices: Vertices  # positions, metres
    faces: Faces  # corners of each triangle
    # Normal of each triangle (of any length) and its dot product with a corner
    planes: Float[np.ndarray, "faces 4"]
    # The two vertices of each edge, in the direction of its first triangle
    edges: Int[np.ndarray, "edges 2"]
    # Two triangles of each edge; the second is −1 if there is one only
    sides: Int[np.ndarray, "edges 2"]
    # 1 if both triangles run along the edge in the same direction, else 0
    opposed: UInt8[np.ndarray, "edges"]
    # 1 if the edge has exactly two triangles, which are oriented alike, else 0
    paired: UInt8[np.ndarray, "edges"]
    # Edge of every triangle at the edges that are not paired, in the triangle's direction
    loose_edges: Int[np.ndarray, "loose 2"]
    loose_sides: Int[np.ndarray, "loose"]  # triangle of each loose edge

    @property
    def is_closed(self) -> bool:
        """Whether the triangles that face the camera hide all others."""
        return not len(self.loose_sides)


def make_outline_mesh(vertices: Vertices, faces: Faces) -> OutlineMesh:
    """Prepare a mesh for drawing its outline, simplified to at most MAX_LIGHT_FACES triangles.

    Raises:
        ValueError: All triangles have zero area.
    """
    vertices, faces = weld(np.asarray(vertices, np.float64), np.asarray(faces, np.int64))
    faces = faces[face_areas(vertices, faces) > 0]
    if not len(faces):
        raise ValueError("all triangles have zero area")
    if len(faces) > MAX_LIGHT_FACES:
        vertices, faces, *_ = decimate(vertices, faces, None, MAX_LIGHT_FACES)
        faces = faces[face_areas(vertices, faces) > 0]
    a, b, c = vertices[faces].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    planes = np.column_stack([normals, (normals * a).sum(axis=1)])
    start, end = faces.reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    keys = np.minimum(start, end) * len(vertices) + np.maximum(start, end)
    order = np.argsort(keys, kind="stable")
    first = np.flatnonzero(np.diff(keys[order], prepend=-1))
    uses = np.diff(first, append=len(keys))
    left, right = order[first], order[np.where(uses > 1, first + 1, first)]
    opposed = (start[left] == start[right]) & (uses > 1)
    edges = np.stack([start[left], end[left]], axis=1)
    sides = np.stack([left // 3, np.where(uses > 1, right // 3, -1)], axis=1)
    paired = (uses == 2) & ~opposed
    loose = order[np.repeat(~paired, uses)]
    loose_edges = np.stack([start[loose], end[loose]], axis=1)
    kinds = opposed.astype(np.uint8), paired.astype(np.uint8)
    return OutlineMesh(vertices, faces, planes, edges, sides, *kinds, loose_edges, loose // 3)


class PosedMesh(NamedTuple):
    """Projection of a mesh at a pose."""

    T_cam_obj: Transform
    arms: Float[np.ndarray, "vertices 3"]  # vertices from the object's origin, camera axes, metres
    pixels: Float[np.ndarray, "vertices 2"]  # projected vertices
    front: Bool[np.ndarray, "faces"]  # whether each triangle faces the camera


def posed(mesh: OutlineMesh, T_cam_obj: Transform, K: CameraMatrix) -> PosedMesh | None:
    """Project a mesh at a pose; return None if a vertex is not in front of the camera."""
    arms, pixels = np.empty_like(mesh.vertices), np.empty((len(mesh.vertices), 2))
    front = np.empty(len(mesh.faces), np.bool_)
    posed_mesh = PosedMesh(T_cam_obj, arms, pixels, front)
    return posed_mesh if _pose(mesh, K, posed_mesh) else None


def filled_mask(
    mesh: OutlineMesh, posed_mesh: PosedMesh, size: tuple[int, int]
) -> UInt8[np.ndarray, "height width"]:
    """Return a mask of size (width, height): 1 if the mesh covers the pixel's centre, else 0."""
    width, height = size
    mask = np.zeros((height, width), np.uint8)
    winding = np.empty((1 if mesh.is_closed else 2, height, width + 1), np.int32)
    _wind(mesh, posed_mesh, winding, mask)
    return mask


@dataclass(frozen=True, eq=False)
class Contour:
    """Points on the outline of a posed part."""

    arms: Float[np.ndarray, "points 3"]  # points from the object's origin, camera axes, metres
    pixels: Float[np.ndarray, "points 2"]
    normals: Float[np.ndarray, "points 2"]  # unit vectors on the image, pointing outwards

    def __len__(self) -> int:
        return len(self.pixels)


def find_contour(
    mesh: OutlineMesh,
    posed_mesh: PosedMesh,
    mask: UInt8[np.ndarray, "height width"],
    spacing: float,
) -> Contour:
    """Return the points of an outline that are on the image.

    Args:
        mesh: Mesh of the part.
        posed_mesh: Mesh at its pose.
        mask: Filled mask of the posed mesh.
        spacing: Approximate distance between points, pixels.
    """
    rows = _walk(mesh, posed_mesh, mask, spacing)
    return Contour(rows[:, :3], rows[:, 3:5], rows[:, 5:])


def outline_rows(
    contour: Contour, T_cam_obj: Transform, K: CameraMatrix
) -> Float[np.ndarray, "points 6"]:
    """Return each point's motion along its normal, pixels per rotation (rad) and shift (m)."""
    rows = np.empty((len(contour), 6))
    _rows(contour.arms, contour.normals, T_cam_obj, K, rows)
    return rows


@compiled()
def _pose(mesh: OutlineMesh, K: Array, posed_mesh: PosedMesh) -> bool:
    """Fill a posed mesh with its projection; return whether all vertices are before the camera."""
    vertices, planes = mesh.vertices, mesh.planes
    T, arms, pixels, front = posed_mesh
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
    # Camera centre in the object frame.
    x = -(T[0, 0] * T[0, 3] + T[1, 0] * T[1, 3] + T[2, 0] * T[2, 3])
    y = -(T[0, 1] * T[0, 3] + T[1, 1] * T[1, 3] + T[2, 1] * T[2, 3])
    z = -(T[0, 2] * T[0, 3] + T[1, 2] * T[1, 3] + T[2, 2] * T[2, 3])
    for f in range(len(planes)):
        front[f] = planes[f, 0] * x + planes[f, 1] * y + planes[f, 2] * z > planes[f, 3]
    return True


@compiled()
def _wind(mesh: OutlineMesh, posed_mesh: PosedMesh, winding: Array, mask: Array) -> None:
    """Set the pixels that the borders of front and back triangles wind around.

    Args:
        mesh: Mesh of the part.
        posed_mesh: Mesh at its pose.
        winding: Filled, in the box of the vertices, with the winding number's changes along each
            row, for the triangles that face the camera and, in an open mesh, for those that face
            away.
        mask: Zeros; set to 1 inside the borders.
    """
    pixels, front = posed_mesh.pixels, posed_mesh.front
    edges, sides, paired = mesh.edges, mesh.sides, mesh.paired
    loose_edges, loose_sides = mesh.loose_edges, mesh.loose_sides
    height, width = mask.shape
    low_x, low_y, high_x, high_y = width - 0.0, height - 0.0, 0.0, -1.0
    for i in range(len(pixels)):
        low_x, high_x = min(low_x, pixels[i, 0]), max(high_x, pixels[i, 0])
        low_y, high_y = min(low_y, pixels[i, 1]), max(high_y, pixels[i, 1])
    top, bottom = int(max(0.0, math.floor(low_y))), int(min(math.ceil(high_y), height - 1.0)) + 1
    # A crossing at the right end may be rounded up to the next column.
    left, right = int(max(0.0, math.floor(low_x))), int(min(math.ceil(high_x) + 1.0, width))
    # Views start at index 0, for which numba vectorises loops.
    changes, inside = winding[:, top:bottom, left : right + 1], mask[top:bottom, left:right]
    for side in range(changes.shape[0]):
        for v in range(changes.shape[1]):
            for u in range(changes.shape[2]):
                changes[side, v, u] = 0
    for e in range(len(edges)):
        first, second = sides[e, 0], sides[e, 1]
        if not paired[e] or front[first] == front[second]:
            continue
        i, j = edges[e, 0], edges[e, 1]
        if not front[first]:
            i, j = j, i
        for side in range(len(winding)):  # both triangles have this edge, in opposite directions
            _cross_rows(pixels, i, j, winding[side])
    for e in range(len(loose_edges)):
        i, j = loose_edges[e, 0], loose_edges[e, 1]
        if front[loose_sides[e]]:
            _cross_rows(pixels, i, j, winding[0])
        else:
            _cross_rows(pixels, j, i, winding[1])
    for v in range(inside.shape[0]):
        for side in range(changes.shape[0]):
            count = 0
            for u in range(inside.shape[1]):
                count += changes[side, v, u]
                if count != 0:
                    inside[v, u] = 1


@compiled()
def _cross_rows(pixels: Array, i: int, j: int, winding: Array) -> None:
    """Add the edge from vertex i to j to the winding number's changes in the rows it crosses."""
    height, width = winding.shape[0], winding.shape[1] - 1
    way = 1
    if pixels[i, 1] > pixels[j, 1]:
        i, j, way = j, i, -1
    y, rise = pixels[i, 1], pixels[j, 1] - pixels[i, 1]
    low, high = max(0.0, math.ceil(y)), min(height - 1.0, math.ceil(pixels[j, 1]) - 1.0)
    for v in range(int(low), int(high) + 1):
        x = pixels[i, 0] + (pixels[j, 0] - pixels[i, 0]) / rise * (v - y)
        winding[v, int(min(max(0.0, math.ceil(x)), width))] += way


@compiled()
def _walk(mesh: OutlineMesh, posed_mesh: PosedMesh, mask: Array, spacing: float) -> Array:
    """Sample points of the silhouette's border along the edges of a mesh; see `find_contour`.

    Returns:
        Arm (3), pixel (2) and outward normal (2) of each point.
    """
    edges, sides, opposed = mesh.edges, mesh.sides, mesh.opposed
    T, arms, pixels, front = posed_mesh
    distance = T[2, 3]
    rows, count, left = np.empty((256, 7)), 0, 0.5 * spacing
    normal = np.empty(2)
    for e in range(len(edges)):
        first, second = sides[e, 0], sides[e, 1]
        if second >= 0 and (front[first] != front[second]) == (opposed[e] == 1):
            continue
        i, j = edges[e, 0], edges[e, 1]
        x, y = pixels[i, 0], pixels[i, 1]
        dx, dy = pixels[j, 0] - x, pixels[j, 1] - y
        length = math.hypot(dx, dy)
        while left < length:
            share = left / length
            left += spacing
            u, v = x + share * dx, y + share * dy
            if not _outward(mask, u, v, dx, dy, length, normal):
                continue
            if count == len(rows):
                longer = np.empty((2 * count, 7))
                longer[:count] = rows
                rows = longer
            # In perspective, the middle of an edge on the image is not its middle in space.
            zi, zj = arms[i, 2] + distance, arms[j, 2] + distance
            share = share * zi / (share * zi + (1.0 - share) * zj)
            for c in range(3):
                rows[count, c] = arms[i, c] + share * (arms[j, c] - arms[i, c])
            rows[count, 3], rows[count, 4] = u, v
            rows[count, 5], rows[count, 6] = normal[0], normal[1]
            count += 1
        left -= length
    return rows[:count]


@compiled()
def _outward(
    mask: Array, u: float, v: float, dx: float, dy: float, length: float, normal: Array
) -> bool:
    """Write the unit normal that points out of the mask at a point of its border.

    Args:
        mask: Mask of the silhouette.
        u: Column of the point, pixels.
        v: Row of the point, pixels.
        dx: Horizontal component of the edge, pixels.
        dy: Vertical component of the edge, pixels.
        length: Length of the edge, pixels.
        normal: Filled with the normal.

    Returns:
        Whether the mask ends at the point.
    """
    height, width = mask.shape
    if not (0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0):
        return False
    # The mean of the filled pixels in the disc lies on the inside of the border.
    x = y = 0.0
    top, bottom = max(0, math.ceil(v - WINDOW_PX)), min(height - 1, math.floor(v + WINDOW_PX))
    left, right = max(0, math.ceil(u - WINDOW_PX)), min(width - 1, math.floor(u + WINDOW_PX))
    for row in range(top, bottom + 1):
        b = row - v
        for column in range(left, right + 1):
            a = column - u
            if mask[row, column] == 1 and a * a + b * b <= WINDOW_PX**2:
                x, y = x - a, y - b
    size = math.hypot(x, y)
    if size == 0.0:
        return False
    x, y = x / size, y / size
    if length >= LONG_PX:
        along = x * -dy + y * dx
        if abs(along) < 0.5 * length:
            return False
        side = math.copysign(1.0 / length, along)
        x, y = -dy * side, dx * side
    normal[0], normal[1] = x, y
    out_row, out_column = round(v + BESIDE_PX * y), round(u + BESIDE_PX * x)
    in_row, in_column = round(v - BESIDE_PX * y), round(u - BESIDE_PX * x)
    if not (0 <= out_row < height and 0 <= out_column < width):
        return False
    if not (0 <= in_row < height and 0 <= in_column < width):
        return False
    return bool(mask[in_row, in_column] == 1 and mask[out_row, out_column] == 0)


@compiled()
def _rows(arms: Array, normals: Array, T: Array, K: Array, rows: Array) -> None:
    """Write the derivatives of each point's motion along its normal by the pose.

    The derivative by the shift is the vector d with d·dX = n·du, where du = f (dX/Z − X dZ/Z²) is
    the motion on the image. The derivative by the rotation is the cross product of arm and d.

    Args:
        arms: Points relative to the object's origin, camera axes, metres.
        normals: Unit normal of each point in the image.
        T: Pose of the object in the camera frame.
        K: Camera matrix, pixels.
        rows: Filled with the derivatives by rotation and shift, (n, 6), pixels.
    """
    for i in range(len(arms)):
        x, y, z = arms[i, 0], arms[i, 1], arms[i, 2]
        inverse = 1.0 / (z + T[2, 3])
        a, b = normals[i, 0] * K[0, 0] * inverse, normals[i, 1] * K[1, 1] * inverse
        c = -(a * (x + T[0, 3]) + b * (y + T[1, 3])) * inverse
        rows[i, 0], rows[i, 1], rows[i, 2] = y * c - z * b, z * a - x * c, x * b - y * a
        rows[i, 3], rows[i, 4], rows[i, 5] = a, b, c
