"""Fragments: a fragment is the part of one smooth patch in one pixel, and is shaded once.

A pixel's samples on the same patch are shaded at their mean (centroid sampling). The cost therefore
depends on the number of pixels, not of samples or triangles.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from dopepp.core.compiled import Array, compiled
from dopepp.virtual.renderers.raster.visibility import Box, Projection, Samples
from dopepp.virtual.scene import Scene, SceneObject
from dopepp.virtual.triangles import NUM_COLOUR_SAMPLES, PIXEL_SAMPLES, edge_functions, scratch

_DEPTH_GAP: Final = 0.01  # samples of a patch whose depths differ by more hide one another
Groups = tuple[Array, ...]  # the first fields of :class:`Fragments`
Mesh = tuple[Array, Array, Array]  # vertices, faces and corner normals

_ALL_BUT_FIRST: Final = 0b1110  # bits of the samples to skip when all of a pixel are alike


class Fragments(NamedTuple):
    """An object's n visible fragments: arrays that the shading passes read and update."""

    pixel: Array  # Index of the pixel in the window, row by row, shape (n,)
    weight: Array  # Number of the pixel's samples in the fragment, shape (n,)
    face: Array  # Index of the triangle, or the bitwise complement for a back face, shape (n,)
    x: Array  # Mean column of the samples in the image, shape (n,); ``y`` is the mean row
    y: Array
    inverse: Array  # Inverse depth of a sample, 1/m, shape (n,)
    share: Array  # Barycentric weights of the triangle's corners, shape (3, n)
    position: Array  # Camera frame, metres, shape (3, n)
    normal: Array  # Unit normal towards the camera, camera frame, shape (3, n)
    albedo: Array  # Linear RGB, shape (3, n)
    bulge: Array  # Height of the smooth surface above the flat triangle, metres, shape (n,)
    alpha: Array  # Width of the GGX lobe, shape (n,)


_GROUP_TYPES: Final = {
    "pixel": np.int32,
    "weight": np.float32,
    "face": np.int32,
    "x": np.float32,
    "y": np.float32,
    "inverse": np.float32,
}
"""The first fields of :class:`Fragments`, which grouping writes."""


def gather_fragments(
    item: SceneObject, projection: Projection, scene: Scene, samples: Samples, first_id: int
) -> Fragments | None:
    """Return an object's fragments; None if it has none. The next call overwrites the arrays.

    ``first_id`` is the id of the object's first triangle; the albedo and alpha are not set.
    """
    box = projection.box(scene.size)
    if box is None:
        return None
    (x, y), surface = samples.origin, item.surface
    window = (box[0] - x, box[1] - y, box[2] - x, box[3] - y)
    # The arrays have the largest possible size; unused memory costs nothing.
    bound = NUM_COLOUR_SAMPLES * (box[2] - box[0]) * (box[3] - box[1])
    groups = tuple(scratch(name, (bound,), dtype) for name, dtype in _GROUP_TYPES.items())
    count = _group(window, samples, first_id, surface.patches, PIXEL_SAMPLES, groups)
    if count == 0:
        return None
    fragments = Fragments(
        *(array[:count] for array in groups),
        *(scratch(name, (3, count), np.float32) for name in Fragments._fields[6:10]),
        *(scratch(name, (count,), np.float32) for name in Fragments._fields[10:]),
    )
    rotation = np.ascontiguousarray(item.T_cam_obj[:3, :3], np.float64)
    mesh = (surface.vertices, surface.faces, surface.normals)
    _interpolate(fragments, projection.hom, mesh, rotation, np.linalg.inv(scene.K))
    return fragments


@compiled()
def _group(
    box: Box, samples: Samples, first_id: int, patches: Array, offsets: Array, groups: Groups
) -> int:
    """Group the samples of every pixel by smooth patch, and return the number of groups.

    ``groups`` is filled with pixel, weight, triangle, x, y and inverse depth of each group.
    """
    origin, inverse_depth, ids = samples
    pixel, weight, triangle, x, y, depth = groups
    num_faces = patches.shape[0]
    centre = offsets.shape[0] - 1
    number = 0
    for j in range(box[1], box[3]):
        for i in range(box[0], box[2]):
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
                count, dx, dy = 1, offsets[s, 0], offsets[s, 1]
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
                        dx += offsets[q, 0]
                        dy += offsets[q, 1]
                if count == NUM_COLOUR_SAMPLES:
                    # The mean of all samples is the pixel's centre, whose triangle is known.
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
    fragments: Fragments, hom: Array, mesh: Mesh, rotation: Array, inverse_K: Array
) -> None:
    """Write the corner weights, position, normal and bulge of every fragment.

    A triangle seen from behind is marked by the bitwise complement of its number.
    """
    vertices, faces, normals = mesh
    triangle, share = fragments.face, fragments.share
    position, normal, bulge = fragments.position, fragments.normal, fragments.bulge
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
        x, y = float(fragments.x[p]), float(fragments.y[p])
        k0 = scale * (e[0] * x + e[1] * y + e[2])
        k1 = scale * (e[3] * x + e[4] * y + e[5])
        k2 = scale * (e[6] * x + e[7] * y + e[8])
        # The mean may lie outside the triangle. The triangle's plane then gives the depth if it is
        # close to the sample's depth. Corner values are not extrapolated.
        total, inverse = k0 + k1 + k2, float(fragments.inverse[p])
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
    """Return the depths of the other two corners below each corner's tangent plane, metres."""
    # The depth of a point below each tangent plane is linear in these distances. The mean of the
    # three depths, weighted by the barycentric coordinates, is the depth below the smooth surface
    # (Hanika, "Hacking the shadow terminator", Ray Tracing Gems II, 2021).
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
