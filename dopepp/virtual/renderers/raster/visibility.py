"""Visibility: what every sample of the image sees, of a scene or of one object alone."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float32, Int16

from dopepp.core.compiled import Array, compiled
from dopepp.drawing.pictures import Picture, Size
from dopepp.geometry.rotation import Vector
from dopepp.virtual.scene import NEAR, Plane, Scene, SceneObject
from dopepp.virtual.triangles import (
    CENTRE_SAMPLE,
    PIXEL_SAMPLES,
    bounds,
    project_vertices,
    rasterise,
    scratch,
)

Box = tuple[int, int, int, int]
"""(left, top, right, bottom) in pixels, right and bottom excluded."""

_REACH: Final = float(np.abs(PIXEL_SAMPLES).max())


@dataclass(frozen=True, eq=False)
class Projected:
    """An object's vertices as the camera sees them.

    Attributes:
        cam: Camera frame, metres, shape (V, 3).
        hom: Homogeneous pixels ``K x_cam``, shape (V, 3).
        extent: Smallest and largest pixel coordinates (left, top, right, bottom) of its image;
            infinite if it crosses the camera plane, left > right if it lies behind.
    """

    cam: Array
    hom: Array
    extent: tuple[float, float, float, float]

    def box(self, size: Size) -> Box | None:
        """Return the pixels of an image of a size that it may touch; None if there are none."""
        left, top, right, bottom = self.extent
        if left > right:
            return None
        box = (
            math.ceil(max(left - _REACH, 0.0)),
            math.ceil(max(top - _REACH, 0.0)),
            math.floor(min(right + _REACH, size[0] - 1)) + 1,
            math.floor(min(bottom + _REACH, size[1] - 1)) + 1,
        )
        return box if box[0] < box[2] and box[1] < box[3] else None

    def inside(self, size: Size) -> bool:
        """Tell whether its whole image lies within the pixel centres of an image of a size."""
        left, top, right, bottom = self.extent
        return 0 <= left <= right <= size[0] - 1 and 0 <= top <= bottom <= size[1] - 1


def project_object(item: SceneObject, K: Array) -> Projected:
    """Project an object's vertices."""
    cam, hom = np.empty_like(item.surface.vertices), np.empty_like(item.surface.vertices)
    project_vertices(item.surface.vertices, item.T_cam_obj, K, cam, hom)
    return Projected(cam, hom, bounds(hom, NEAR))


def centres_within(extent: tuple[float, float, float, float]) -> Box:
    """Return the box of the pixel centres within finite bounds, on a canvas without borders."""
    left, top, right, bottom = extent
    return math.ceil(left), math.ceil(top), math.floor(right) + 1, math.floor(bottom) + 1


def box_around(boxes: Iterable[Box | None]) -> Box | None:
    """Return the box around several; None if there is none."""
    known = [box for box in boxes if box is not None]
    if not known:
        return None
    left, top, right, bottom = zip(*known, strict=True)
    return min(left), min(top), max(right), max(bottom)


@dataclass(frozen=True, eq=False)
class Samples:
    """What the samples of a window of the image see.

    Attributes:
        origin: Image pixel (x, y) of the window's first pixel.
        inverse_depth: 1/m per sample, 0 where nothing is, float32, shape (height, width, S).
        ids: Triangle per sample, numbered through all objects, −1 for none, int32, same shape.
    """

    origin: tuple[int, int]
    inverse_depth: Array
    ids: Array


def draw_samples(
    scene: Scene, projected: Sequence[Projected], window: Box, offsets: Array
) -> Samples:
    """Draw a scene's plane and objects into the samples of a window, valid until the next scene's.

    ``offsets`` are those of a pixel's samples from its centre, shape (S, 2).
    """
    left, top, right, bottom = window
    shape = (bottom - top, right - left, len(offsets))
    inverse_depth = scratch("inverse_depth", shape, np.float32)
    ids = scratch("ids", shape, np.int32)
    ids.fill(-1)
    if scene.plane is None:
        inverse_depth.fill(0.0)
    else:
        inverse = inverse_depth_of(scene.plane, scene.K)
        _clear_to_plane(inverse, (left, top), offsets, NEAR, inverse_depth)
    for item, seen, first in zip(scene.objects, projected, first_ids(scene), strict=True):
        rasterise(
            seen.hom, item.surface.faces, item.surface.closed, NEAR, (left, top), offsets,
            inverse_depth, ids, first,
        )  # fmt: skip
    return Samples((left, top), inverse_depth, ids)


def first_ids(scene: Scene) -> Array:
    """Return the number of every object's first triangle, int64."""
    counts = [len(item.surface.faces) for item in scene.objects]
    return np.concatenate([[0], np.cumsum(counts)])[: len(counts)].astype(np.int64)


def draw_alone(
    item: SceneObject, hom: Array, box: Box
) -> tuple[Float32[np.ndarray, "height width"], Array]:
    """Draw 1/m and triangles of an object alone at a box's pixel centres, also beyond the image.

    Beside the object there is 0, and any triangle.
    """
    left, top, right, bottom = box
    canvas = np.zeros((max(bottom - top, 0), max(right - left, 0), 1), np.float32)
    ids = np.empty(canvas.shape, np.int32)
    surface = item.surface
    rasterise(hom, surface.faces, surface.closed, NEAR, (left, top), CENTRE_SAMPLE, canvas, ids, 0)
    return canvas[..., 0], ids[..., 0]


def backdrop(
    scene: Scene,
) -> tuple[Picture, Float32[np.ndarray, "height width"], Int16[np.ndarray, "height width"]]:
    """Return image, depth and instances of a scene without its objects."""
    depth = np.zeros(scene.background.shape[:2], np.float32)
    if scene.plane is not None:
        _plane_depth(inverse_depth_of(scene.plane, scene.K), NEAR, depth)
    return scene.background.copy(), depth, np.full(depth.shape, -1, np.int16)


def inverse_depth_of(plane: Plane, K: Array) -> Vector:
    """Return (a, b, c) with 1/z = a u + b v + c on the plane; positive in front of the camera."""
    return np.asarray(np.linalg.solve(K.T, np.array(plane.normal, np.float64)) / plane.offset)


@compiled()
def _clear_to_plane(
    inverse: Array, origin: tuple[int, int], samples: Array, near: float, inverse_depth: Array
) -> None:
    """Fill a sample buffer with the plane's inverse depth; 0 where the plane is not seen."""
    height, width, num_samples = inverse_depth.shape
    row = inverse_depth.reshape(height, width * num_samples)
    steps = np.empty(width * num_samples, np.float32)
    for i in range(width):
        for s in range(num_samples):
            steps[i * num_samples + s] = (
                inverse[0] * (origin[0] + i + samples[s, 0]) + inverse[1] * samples[s, 1]
            )
    nearest = np.float32(1.0 / near)
    for j in range(height):
        start = np.float32(inverse[1] * (origin[1] + j) + inverse[2])
        for k in range(steps.shape[0]):
            value = start + steps[k]
            row[j, k] = value if np.float32(0) < value <= nearest else np.float32(0)


@compiled()
def _plane_depth(inverse: Array, near: float, depth: Array) -> None:
    """Write the plane's depth at every pixel centre, metres; 0 where it is not seen."""
    for j in range(depth.shape[0]):
        for i in range(depth.shape[1]):
            value = inverse[0] * i + inverse[1] * j + inverse[2]
            depth[j, i] = 1.0 / value if 0.0 < value * near <= 1.0 else 0.0
