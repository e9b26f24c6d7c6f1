"""The outline of a mesh at a pose: points on it, each with its outward normal on the picture.

An edge may belong to the outline where one of its triangles faces the camera and the other does
not, or where it has one triangle only. Which of these edges really do is read off the filled mask:
the part ends there. Edges behind or before other surface of the part have the part on both sides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, UInt8

from dopepp.core.compiled import Array, compiled
from dopepp.inference.refinement.mesh import OutlineMesh
from dopepp.inference.refinement.silhouette import Posed

WINDOW_PX: Final = 3.0
"""Radius of the disc of the mask in which a point's outward direction is read."""

BESIDE_PX: Final = 1.25
"""Distance from the outline at which there is part on one side and none on the other."""

LONG_PX: Final = 4.0
"""Edges of at least this length have their own normal; shorter ones zigzag about the outline."""


@dataclass(frozen=True, eq=False)
class Contour:
    """Points on the outline of a posed part.

    Attributes:
        arms: From the object's origin to each, camera axes, metres.
        pixels: Where they are on the picture.
        normals: Unit vectors on the picture that point away from the part.
    """

    arms: Float[np.ndarray, "points 3"]
    pixels: Float[np.ndarray, "points 2"]
    normals: Float[np.ndarray, "points 2"]

    def __len__(self) -> int:
        return len(self.pixels)


def find_contour(
    mesh: OutlineMesh, at: Posed, mask: UInt8[np.ndarray, "height width"], spacing: float
) -> Contour:
    """Find the points of an outline, about ``spacing`` pixels apart, that are on the picture.

    Args:
        mesh: The mesh.
        at: It at the pose.
        mask: It filled.
        spacing: Pixels.
    """
    rows = _walk(
        mesh.edges, mesh.sides, mesh.opposed, at.front, at.arms, at.pixels,
        float(at.T_cam_obj[2, 3]), mask, spacing,
    )  # fmt: skip
    return Contour(rows[:, :3], rows[:, 3:5], rows[:, 5:])


@compiled()
def _walk(
    edges: Array,
    sides: Array,
    opposed: Array,
    front: Array,
    arms: Array,
    pixels: Array,
    distance: float,
    mask: Array,
    spacing: float,
) -> Array:
    """Return arm, pixel and normal of a point every ``spacing`` pixels along all edges in turn."""
    rows, count, left = np.empty((256, 7)), 0, 0.5 * spacing
    normal = np.empty(2)
    for e in range(len(edges)):
        one, other = sides[e, 0], sides[e, 1]
        if other >= 0 and (front[one] != front[other]) == (opposed[e] == 1):
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
            # Halfway on the picture is not halfway in space.
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
    """Write the direction away from the mask; tell whether the mask ends at this point."""
    height, width = mask.shape
    if not (0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0):
        return False
    # The filled pixels around lie, on average, on the inside.
    x = y = 0.0
    for row in range(math.ceil(v - WINDOW_PX), math.floor(v + WINDOW_PX) + 1):
        for column in range(math.ceil(u - WINDOW_PX), math.floor(u + WINDOW_PX) + 1):
            a, b = column - u, row - v
            inside = 0 <= row < height and 0 <= column < width and mask[row, column] == 1
            if a * a + b * b <= WINDOW_PX**2 and inside:
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
