"""Creases of a mesh, and the lines that a posed part shows: its outline and visible creases."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int

from dopepp.core.compiled import Array, compiled
from dopepp.inference.refinement.outline import OutlineMesh, PosedMesh

SHARP: Final = math.cos(math.radians(40.0))
"""Cosine of the smallest angle between the normals of a crease's triangles."""


class SharpEdges:
    """Creases of a mesh, and which of them a camera sees.

    Args:
        mesh: Mesh of the part.
    """

    def __init__(self, mesh: OutlineMesh) -> None:
        self.mesh = mesh
        normals = mesh.planes[:, :3]
        self.normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        """Unit normal of each triangle."""
        first, second = mesh.sides.T
        cosines = (self.normals[first] * self.normals[second]).sum(axis=1)
        sharp = (second >= 0) & (cosines < SHARP) & (mesh.opposed == 0)
        self._creases, self._sides = mesh.edges[sharp], mesh.sides[sharp]

    def drawn(
        self, posed_mesh: PosedMesh, size: tuple[int, int]
    ) -> Int[np.ndarray, "height width"]:
        """Return the triangle at each pixel, −1 for none."""
        width, height = size
        ids = np.full((height, width), -1, np.int32)
        _draw(self.mesh, posed_mesh, ids, np.zeros((height, width), np.float32))
        return ids

    def lines(
        self, posed_mesh: PosedMesh, size: tuple[int, int]
    ) -> Bool[np.ndarray, "height width"]:
        """Return the pixels of outline and visible creases: the normal changes to the next pixel.

        Args:
            posed_mesh: Mesh at its pose.
            size: Width and height, pixels.
        """
        ids = self.drawn(posed_mesh, size)
        on_part = ids >= 0
        normals = np.where(on_part[..., None], self.normals[ids], 0.0)
        lines = np.zeros_like(on_part)
        for here, there in (np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:]):
            cosines = np.einsum("hwi,hwi->hw", normals[here], normals[there])
            lines[here] |= (cosines < SHARP) & (on_part[here] | on_part[there])
        return lines

    def visible(
        self, posed_mesh: PosedMesh, ids: Int[np.ndarray, "height width"], spacing: float
    ) -> Float[np.ndarray, "points 4"]:
        """Return pixel and normal of points on visible creases, ``spacing`` pixels apart.

        ``ids`` are the triangles that :meth:`drawn` returns.
        """
        return np.asarray(
            _walk_creases(self._creases, self._sides, posed_mesh.pixels, ids, spacing)
        )


@compiled()
def _draw(mesh: OutlineMesh, posed_mesh: PosedMesh, ids: Array, nearest: Array) -> None:
    """Write the nearest visible triangle at each pixel's centre.

    Args:
        mesh: Mesh of the part.
        posed_mesh: Mesh at its pose.
        ids: Filled with the triangle at each pixel; unchanged where there is none.
        nearest: Filled with the inverse depth at each pixel; zeros before.
    """
    faces, is_closed = mesh.faces, len(mesh.loose_sides) == 0
    T, arms, pixels, front = posed_mesh
    height, width = ids.shape
    for f in range(len(faces)):
        if is_closed and not front[f]:
            continue
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, bx, by = pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1]
        cx, cy = pixels[c, 0], pixels[c, 1]
        first, last = max(0, math.ceil(min(ay, by, cy))), math.floor(max(ay, by, cy))
        left, right = max(0, math.ceil(min(ax, bx, cx))), math.floor(max(ax, bx, cx))
        last, right = min(height - 1, last), min(width - 1, right)
        if first > last or left > right:  # most triangles of a fine mesh cover no pixel's centre
            continue
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(area) < 1e-9:
            continue
        # Weights of the corners are linear over the image.
        per_area = 1.0 / area
        a_u, a_v = (by - cy) * per_area, (cx - bx) * per_area
        b_u, b_v = (cy - ay) * per_area, (ax - cx) * per_area
        za, zb = 1.0 / (arms[a, 2] + T[2, 3]), 1.0 / (arms[b, 2] + T[2, 3])
        zc = 1.0 / (arms[c, 2] + T[2, 3])
        for v in range(first, last + 1):
            for u in range(left, right + 1):
                wa = a_u * (u - cx) + a_v * (v - cy)
                wb = b_u * (u - cx) + b_v * (v - cy)
                wc = 1.0 - wa - wb
                if min(wa, wb, wc) < -1e-9:
                    continue
                near = wa * za + wb * zb + wc * zc
                if near > nearest[v, u]:
                    nearest[v, u] = near
                    ids[v, u] = f


@compiled()
def _walk_creases(edges: Array, sides: Array, pixels: Array, ids: Array, spacing: float) -> Array:
    """Sample points along the visible creases of a mesh.

    Args:
        edges: Vertices of each crease.
        sides: The two triangles of each crease.
        pixels: Projected vertices.
        ids: Triangle at each pixel.
        spacing: Distance between neighbouring points, pixels.

    Returns:
        Pixel (2) and unit normal (2) of each point.
    """
    height, width = ids.shape
    rows, count, left = np.empty((512, 4)), 0, 0.5 * spacing
    for e in range(len(edges)):
        x, y = pixels[edges[e, 0], 0], pixels[edges[e, 0], 1]
        dx, dy = pixels[edges[e, 1], 0] - x, pixels[edges[e, 1], 1] - y
        length = math.hypot(dx, dy)
        while left < length:
            share = left / length
            left += spacing
            u, v = x + share * dx, y + share * dy
            # Next to a visible crease, both triangles are drawn; next to an outline, only one.
            first = second = False
            for row in range(int(v) - 1, int(v) + 3):
                for column in range(int(u) - 1, int(u) + 3):
                    if 0 <= row < height and 0 <= column < width:
                        first = first or ids[row, column] == sides[e, 0]
                        second = second or ids[row, column] == sides[e, 1]
            if first and second:
                if count == len(rows):
                    longer = np.empty((2 * count, 4))
                    longer[:count] = rows
                    rows = longer
                rows[count, 0], rows[count, 1] = u, v
                rows[count, 2], rows[count, 3] = -dy / length, dx / length
                count += 1
        left = max(left - length, 0.0)
    return rows[:count]
