"""Fragments: what a pixel sees of one smooth patch of an object, the unit of shading.

A pixel's samples on the same patch are shaded once, at their mean (centroid sampling), so the
cost follows pixels, neither samples nor triangles: a finely meshed part costs little more than a
coarse one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from dopepp.core.compiled import Array, compiled
from dopepp.virtual.renderers.raster.visibility import Projected, Samples
from dopepp.virtual.scene import Scene, SceneObject
from dopepp.virtual.triangles import NUM_COLOUR_SAMPLES, PIXEL_SAMPLES, edge_functions, scratch

_DEPTH_GAP: Final = 0.01  # samples of a patch that differ by a larger share hide one another
_ALL_BUT_FIRST: Final = 0b1110  # bits of the samples to skip when all of a pixel are alike


@dataclass(frozen=True, eq=False)
class Fragments:
    """An object's visible fragments.

    Attributes:
        pixel: Index of the pixel in the window, row by row, shape (n,).
        weight: Number of the pixel's samples that it covers, shape (n,).
        face: Index of its triangle; its bitwise complement for a back face, shape (n,).
        x: Column of its mean in the image, shape (n,); ``y`` is the row.
        share: Weights of the triangle's corners, shape (3, n).
        position: Camera frame, metres, shape (3, n).
        normal: Unit normal towards the camera, camera frame, shape (3, n).
        bulge: Metres by which the smooth surface that the normals pretend stands out before the
            flat triangle, shape (n,).
    """

    pixel: Array
    weight: Array
    face: Array
    x: Array
    y: Array
    share: Array
    position: Array
    normal: Array
    bulge: Array


def gather_fragments(
    item: SceneObject, seen: Projected, scene: Scene, samples: Samples, first_id: int
) -> Fragments | None:
    """Collect an object's fragments, valid until the next object's are collected; None without any.

    ``first_id`` is the number of the object's first triangle.
    """
    box = seen.box(scene.size)
    if box is None:
        return None
    origin, surface = samples.origin, item.surface
    window = (box[0] - origin[0], box[1] - origin[1], box[2] - origin[0], box[3] - origin[1])
    # The most there can be; memory that is never touched costs nothing.
    most = NUM_COLOUR_SAMPLES * (box[2] - box[0]) * (box[3] - box[1])
    pixel, face = (scratch(name, (most,), np.int32) for name in ("pixel", "face"))
    weight, x, y, inverse = (
        scratch(name, (most,), np.float32) for name in ("weight", "x", "y", "inverse")
    )
    count = _group(
        window, origin, samples.ids, samples.inverse_depth, first_id, surface.patches,
        PIXEL_SAMPLES, pixel, weight, face, x, y, inverse,
    )  # fmt: skip
    if count == 0:
        return None
    pixel, weight, face, x, y, inverse = (
        array[:count] for array in (pixel, weight, face, x, y, inverse)
    )
    share, position, normal = (
        scratch(name, (3, count), np.float32) for name in ("share", "position", "normal")
    )
    bulge = scratch("bulge", (count,), np.float32)
    rotation = np.ascontiguousarray(item.T_cam_obj[:3, :3], np.float64)
    _interpolate(
        x, y, inverse, seen.hom, surface.vertices, surface.faces, surface.normals, rotation,
        np.linalg.inv(scene.K), face, share, position, normal, bulge,
    )  # fmt: skip
    return Fragments(pixel, weight, face, x, y, share, position, normal, bulge)


@compiled()
def _group(
    window: tuple[int, int, int, int], origin: tuple[int, int], ids: Array, inverse_depth: Array,
    first_id: int, patches: Array, samples: Array, pixel: Array, weight: Array, triangle: Array,
    x: Array, y: Array, depth: Array,
) -> int:  # fmt: skip
    """Group the samples of every pixel by patch; write pixel, weight, triangle, mean and 1/m."""
    num_faces = patches.shape[0]
    centre = samples.shape[0] - 1
    number = 0
    for j in range(window[1], window[3]):
        for i in range(window[0], window[2]):
            first = ids[j, i, 0]
            # Mostly one triangle, or nothing, fills a pixel.
            alike = first == ids[j, i, 1] and first == ids[j, i, 2] and first == ids[j, i, 3]
            done = _ALL_BUT_FIRST if alike else 0
            for s in range(NUM_COLOUR_SAMPLES):
                face = ids[j, i, s] - first_id
                if face < 0 or face >= num_faces or (done >> s) & 1:
                    continue
                inverse = inverse_depth[j, i, s]
                gap = _DEPTH_GAP * inverse
                count, dx, dy = 1, samples[s, 0], samples[s, 1]
                if alike:
                    count, dx, dy = NUM_COLOUR_SAMPLES, 0.0, 0.0
                for q in range(s + 1, NUM_COLOUR_SAMPLES):
                    if (done >> q) & 1:
                        continue  # shaded with an earlier sample
                    other = ids[j, i, q] - first_id
                    if other == face or (
                        0 <= other < num_faces
                        and patches[other] == patches[face]
                        and abs(inverse_depth[j, i, q] - inverse) <= gap
                    ):
                        done |= 1 << q
                        count += 1
                        dx += samples[q, 0]
                        dy += samples[q, 1]
                if count == NUM_COLOUR_SAMPLES:
                    # Their mean is the pixel's centre, which has its own triangle.
                    other = ids[j, i, centre] - first_id
                    if 0 <= other < num_faces and patches[other] == patches[face]:
                        face, inverse = other, inverse_depth[j, i, centre]
                x[number] = origin[0] + i + dx / count
                y[number] = origin[1] + j + dy / count
                pixel[number] = j * ids.shape[1] + i
                weight[number] = count
                triangle[number] = face
                depth[number] = inverse
                number += 1
    return number


@compiled()
def _interpolate(
    columns: Array, rows: Array, depth: Array, hom: Array, vertices: Array, faces: Array,
    normals: Array, rotation: Array, inverse_K: Array, triangle: Array, share: Array,
    position: Array, normal: Array, bulge: Array,
) -> None:  # fmt: skip
    """Write corner weights, positions, normals and bulges; complement back faces."""
    last, scale = -1, 0.0
    a, b, c, e = 0, 0, 0, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    heights = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for p in range(triangle.shape[0]):
        face = triangle[p]
        if face != last:
            # Neighbours in a row mostly lie on one triangle.
            last = face
            a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
            e = edge_functions(hom, a, b, c)
            scale = 1.0 / (hom[a, 0] * e[0] + hom[a, 1] * e[1] + hom[a, 2] * e[2])
            heights = _corner_heights(vertices, a, b, c, normals[face])
        x, y = float(columns[p]), float(rows[p])
        k0 = scale * (e[0] * x + e[1] * y + e[2])
        k1 = scale * (e[3] * x + e[4] * y + e[5])
        k2 = scale * (e[6] * x + e[7] * y + e[8])
        # The mean may lie outside this triangle: its plane is right there as long as the depth
        # stays near the sample's, its corners' values must not be overshot.
        total, inverse = k0 + k1 + k2, float(depth[p])
        z = 1.0 / (total if abs(total - inverse) <= _DEPTH_GAP * inverse else inverse)
        k0, k1, k2 = max(k0, 0.0), max(k1, 0.0), max(k2, 0.0)
        total = 1.0 / max(k0 + k1 + k2, 1e-30)
        k0, k1, k2 = k0 * total, k1 * total, k2 * total
        o0 = k0 * normals[face, 0, 0] + k1 * normals[face, 1, 0] + k2 * normals[face, 2, 0]
        o1 = k0 * normals[face, 0, 1] + k1 * normals[face, 1, 1] + k2 * normals[face, 2, 1]
        o2 = k0 * normals[face, 0, 2] + k1 * normals[face, 1, 2] + k2 * normals[face, 2, 2]
        # The determinant of a triangle seen from behind is positive.
        side = -1.0 if scale > 0.0 else 1.0
        norm = side / math.sqrt(o0 * o0 + o1 * o1 + o2 * o2 + 1e-20)
        for r in range(3):
            normal[r, p] = norm * (rotation[r, 0] * o0 + rotation[r, 1] * o1 + rotation[r, 2] * o2)
            position[r, p] = z * (inverse_K[r, 0] * x + inverse_K[r, 1] * y + inverse_K[r, 2])
        bulge[p] = (
            k0 * max(side * (k1 * heights[0] + k2 * heights[1]), 0.0)
            + k1 * max(side * (k0 * heights[2] + k2 * heights[3]), 0.0)
            + k2 * max(side * (k0 * heights[4] + k1 * heights[5]), 0.0)
        )
        share[0, p], share[1, p], share[2, p] = k0, k1, k2
        triangle[p] = ~face if scale > 0.0 else face


@compiled(inline="always")
def _corner_heights(
    vertices: Array, a: int, b: int, c: int, normals: Array
) -> tuple[float, float, float, float, float, float]:
    """Return how far the other two corners lie below each corner's tangent plane, metres."""
    # A point of the triangle lies below these planes by sums of them; weighted by its shares of the
    # corners, that is how far it lies below the surface its normals belong to (Hanika, "Hacking the
    # shadow terminator", Ray Tracing Gems II, 2021).
    h0, h1, h2, h3, h4, h5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(3):
        ab = vertices[a, r] - vertices[b, r]
        ac = vertices[a, r] - vertices[c, r]
        bc = vertices[b, r] - vertices[c, r]
        h0 += ab * normals[0, r]
        h1 += ac * normals[0, r]
        h2 -= ab * normals[1, r]
        h3 += bc * normals[1, r]
        h4 -= ac * normals[2, r]
        h5 -= bc * normals[2, r]
    return h0, h1, h2, h3, h4, h5
