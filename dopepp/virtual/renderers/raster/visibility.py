"""Visibility: the nearest triangle of every sample, for a scene or one object, and shadow maps.

A shadow map is the scene's depth from a light.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float32, Int16

from dopepp.core.compiled import Array, Scalar, compiled
from dopepp.drawing.pictures import RGBImage, Size
from dopepp.geometry.camera import make_transform, transform
from dopepp.geometry.rotation import rotation_to_z
from dopepp.virtual.scene import NEAR, Ambient, Light, Scene, SceneObject
from dopepp.virtual.triangles import (
    CENTRE_SAMPLE,
    PIXEL_SAMPLES,
    bounds,
    open_share,
    project_vertices,
    rasterise,
    scratch,
)

Box = tuple[int, int, int, int]  # (left, top, right, bottom) in pixels, right and bottom excluded

Extent = tuple[float, float, float, float]
"""Smallest and largest pixel coordinates (left, top, right, bottom)."""

_REACH: Final = float(np.abs(PIXEL_SAMPLES).max())
_LARGEST_TANGENT: Final = 3.0  # largest half-width of a shadow map; points outside are lit
_ZERO, _ONE = np.float32(0), np.float32(1)  # literals would turn the arithmetic into float64


@dataclass(frozen=True, eq=False)
class Projection:
    """The projected vertices of an object."""

    cam: Array  # Vertices in the camera frame, metres, shape (V, 3)
    hom: Array  # Homogeneous pixels ``K x_cam``, shape (V, 3)
    # Bounds of the projected vertices, pixels; infinite if the object crosses the depth ``NEAR``,
    # left > right if it is entirely nearer.
    extent: Extent

    def box(self, size: Size) -> Box | None:
        """Return the pixels of an image of (width, height) that the object may touch, or None."""
        left, top, right, bottom = self.extent
        if left > right:
            return None
        left, top = max(left - _REACH, 0.0), max(top - _REACH, 0.0)
        right, bottom = min(right + _REACH, size[0] - 1), min(bottom + _REACH, size[1] - 1)
        box = centres_within((left, top, right, bottom))
        return box if box[0] < box[2] and box[1] < box[3] else None

    def inside(self, size: Size) -> bool:
        """Return whether all projected vertices lie within an image of (width, height)."""
        left, top, right, bottom = self.extent
        return 0 <= left <= right <= size[0] - 1 and 0 <= top <= bottom <= size[1] - 1


def project_object(item: SceneObject, K: Array) -> Projection:
    """Return the projection of an object's vertices by the camera matrix ``K``, pixels."""
    cam, hom = np.empty_like(item.surface.vertices), np.empty_like(item.surface.vertices)
    project_vertices(item.surface.vertices, item.T_cam_obj, K, cam, hom)
    return Projection(cam, hom, bounds(hom, NEAR))


def centres_within(extent: Extent) -> Box:
    """Return the box of the pixel centres within finite bounds, on a canvas without borders."""
    left, top, right, bottom = extent
    return math.ceil(left), math.ceil(top), math.floor(right) + 1, math.floor(bottom) + 1


def box_around(boxes: Iterable[Box | None]) -> Box | None:
    """Return the bounding box of all boxes that are not None; None if there are none."""
    drawn = [box for box in boxes if box is not None]
    if not drawn:
        return None
    left, top, right, bottom = zip(*drawn, strict=True)
    return min(left), min(top), max(right), max(bottom)


class Samples(NamedTuple):
    """The sample buffers of a window of the image."""

    origin: tuple[int, int]  # Image pixel (x, y) of the window's first pixel
    inverse_depth: Array  # 1/m per sample, 0 for empty samples, float32, shape (height, width, S)
    ids: Array  # Triangle per sample, counted over all objects, −1 for none, int32, same shape


def draw_samples(
    scene: Scene, projections: Sequence[Projection], window: Box, offsets: Array
) -> Samples:
    """Return the samples of a scene's plane and objects; the next call overwrites the buffers.

    ``offsets`` are the samples' offsets from the pixel's centre, pixels, shape (S, 2).
    """
    left, top, right, bottom = window
    shape = (bottom - top, right - left, len(offsets))
    inverse_depth = scratch("inverse_depth", shape, np.float32)
    ids = scratch("ids", shape, np.int32)
    ids.fill(-1)
    if scene.plane is None:
        inverse_depth.fill(0.0)
    else:
        inverse = scene.plane.inverse_depth_row(scene.K)
        _clear_to_plane(inverse, (left, top), offsets, NEAR, inverse_depth)
    samples = Samples((left, top), inverse_depth, ids)
    for item, projection, first in zip(scene.objects, projections, first_ids(scene), strict=True):
        faces, closed = item.surface.faces, item.surface.closed
        rasterise(
            projection.hom, faces, closed, NEAR, (left, top), offsets, inverse_depth, ids, first
        )
    return samples


def first_ids(scene: Scene) -> Array:
    """Return the id of every object's first triangle in :attr:`Samples.ids`, int64."""
    counts = [len(item.surface.faces) for item in scene.objects]
    return np.concatenate([[0], np.cumsum(counts)])[: len(counts)].astype(np.int64)


def draw_alone(
    item: SceneObject, hom: Array, box: Box
) -> tuple[Float32[np.ndarray, "height width"], Array]:
    """Rasterise a single object at a box's pixel centres, which may lie beyond the image.

    Returns:
        Inverse depth (1/m, 0 outside the object) and triangles (undefined outside the object).
    """
    left, top, right, bottom = box
    canvas = np.zeros((max(bottom - top, 0), max(right - left, 0), 1), np.float32)
    ids = np.empty(canvas.shape, np.int32)
    surface = item.surface
    rasterise(hom, surface.faces, surface.closed, NEAR, (left, top), CENTRE_SAMPLE, canvas, ids, 0)
    return canvas[..., 0], ids[..., 0]


def backdrop(
    scene: Scene,
) -> tuple[RGBImage, Float32[np.ndarray, "height width"], Int16[np.ndarray, "height width"]]:
    """Return image, depth (metres) and instances of a scene as if it had no objects."""
    depth = np.zeros(scene.background.shape[:2], np.float32)
    if scene.plane is not None:
        _plane_depth(scene.plane.inverse_depth_row(scene.K), NEAR, depth)
    return scene.background.copy(), depth, np.full(depth.shape, -1, np.int16)


@dataclass(frozen=True, eq=False)
class ShadowMap:
    """A scene's depth from one light."""

    light: Array  # Position (camera frame, metres) and linear RGB at one metre, shape (6,)
    inverse_depth: Array  # 1/m, 0 for empty texels, shape (height, width, 1)
    # Projection from the camera frame to homogeneous pixels of the map, the third of which is the
    # depth from the light, shape (3, 4), float32.
    P: Array
    texel: float  # Metres that a texel spans per metre of depth

    def lit_shares(self, position: Array, normal: Array, bulge: Array) -> Array:
        """Return the share of the light that reaches each point; 0 where it faces away.

        Points are first lifted along their normals, by 1.5 texels and by their ``bulge``, metres.
        Beyond √2 texels, a plane cannot shadow itself at any slope; the bulge keeps a smooth ball
        of few flat triangles from shadowing itself where its normals still face the light.
        """
        points = scratch("projected", position.shape, np.float32)
        lit = scratch("lit", points.shape[1:], np.float32)
        lift = np.float32(1.5 * self.texel)
        _project_points(position, normal, bulge, self.light, self.P, lift, points)
        _compare(points, self.inverse_depth, lit)
        return lit


def shadow_maps(scene: Scene, projections: Sequence[Projection]) -> list[ShadowMap]:
    """Return the shadow map of every light of a scene with objects."""
    boxes = [box for projection in projections if (box := projection.box(scene.size)) is not None]
    extent = max((max(box[2] - box[0], box[3] - box[1]) for box in boxes), default=0)
    # A texel per pixel of the objects' image; for all lights but the first, half as many.
    return [
        shadow_map(light, scene.objects, projections, extent * (0.5 if number else 1.0))
        for number, light in enumerate(scene.lights)
    ]


def shadow_map(
    light: Light, objects: Sequence[SceneObject], projections: Sequence[Projection], texels: float
) -> ShadowMap:
    """Return the shadow map of a light, with a longer side of about ``texels`` (64 to 768)."""
    points = np.concatenate([transform(item.T_cam_obj, item.surface.hull) for item in objects])
    position = np.array(light.position, np.float64)
    forward = (points.min(axis=0) + points.max(axis=0)) / 2 - position
    distance = float(np.linalg.norm(forward))
    # A light in the middle of the objects may face any direction.
    rotation = rotation_to_z(forward / distance if distance > 0 else np.array([0.0, 0.0, 1.0]))
    T_light_cam = make_transform(rotation, -rotation @ position)
    points = transform(T_light_cam, points)
    low, high = np.full(2, -_LARGEST_TANGENT), np.full(2, _LARGEST_TANGENT)
    if (points[:, 2] > NEAR).all():
        tangents = points[:, :2] / points[:, 2:]
        low, high = np.maximum(tangents.min(axis=0), low), np.minimum(tangents.max(axis=0), high)
    span = np.maximum(high - low, 1e-6)
    focal = float(np.clip(texels, 64, 768) / span.max())
    # Two texels of margin, so that the interpolation at the outline stays inside.
    width, height = (math.ceil(focal * side) + 4 for side in span)
    K = np.array([[focal, 0, 2 - focal * low[0]], [0, focal, 2 - focal * low[1]], [0, 0, 1.0]])
    inverse_depth = np.zeros((height, width, 1), np.float32)
    ids = np.empty(inverse_depth.shape, np.int32)
    for item, projection in zip(objects, projections, strict=True):
        cam, hom = np.empty_like(projection.cam), np.empty_like(projection.cam)
        project_vertices(projection.cam, T_light_cam, K, cam, hom)
        surface = item.surface
        rasterise(
            hom, surface.faces, surface.closed, NEAR, (0, 0), CENTRE_SAMPLE, inverse_depth, ids, 0
        )
    P = (K @ T_light_cam[:3]).astype(np.float32)
    rgb = light.reach**2 * np.array(light.intensity)
    row = np.array([*light.position, *rgb], np.float32)
    return ShadowMap(row, inverse_depth, P, 1 / focal)


def ambient_row(ambient: Ambient) -> Array:
    """Return ``up``, ``above`` and ``below`` of the ambient light as float32, shape (9,)."""
    return np.array([*ambient.up, *ambient.above, *ambient.below], np.float32)


def panel_rows(ambient: Ambient) -> Array:
    """Return middle, along, across, width, length and intensity of each panel, shape (n, 14)."""
    rows = [
        [*panel.middle, *panel.along, *panel.across, panel.width, panel.length, *panel.intensity]
        for panel in ambient.panels
    ]
    return np.array(rows, np.float32).reshape(-1, 14)


@compiled(fastmath=True)
def _project_points(
    position: Array, normal: Array, bulge: Array, light: Array, P: Array, lift: Scalar, out: Array
) -> None:
    """Project surface points into a light's shadow map: u, v and inverse depth into ``out`` (3, n).

    Points are lifted along their normals by ``bulge`` metres and by ``lift`` per depth from the
    light. The inverse depth is −1 for points that face away from the light.
    """
    x0, y0, z0 = light[0], light[1], light[2]
    a, b, c, d = P[0, 0], P[0, 1], P[0, 2], P[0, 3]
    e, f, g, h = P[1, 0], P[1, 1], P[1, 2], P[1, 3]
    i, j, k, m = P[2, 0], P[2, 1], P[2, 2], P[2, 3]
    for p in range(position.shape[1]):
        x, y, z = position[0, p], position[1, p], position[2, p]
        nx, ny, nz = normal[0, p], normal[1, p], normal[2, p]
        facing = nx * (x0 - x) + ny * (y0 - y) + nz * (z0 - z)
        up = bulge[p] + lift * (i * x + j * y + k * z + m)
        x, y, z = x + up * nx, y + up * ny, z + up * nz
        scale = _ONE / (i * x + j * y + k * z + m)
        out[0, p] = (a * x + b * y + c * z + d) * scale
        out[1, p] = (e * x + f * y + g * z + h) * scale
        out[2, p] = scale if facing > _ZERO else -_ONE


@compiled(fastmath=True)
def _compare(points: Array, inverse_depth: Array, lit: Array) -> None:
    """Write to ``lit`` the share of light that reaches the points of :func:`_project_points`."""
    for p in range(lit.shape[0]):
        u, v, inverse = points[0, p], points[1, p], points[2, p]
        lit[p] = open_share(u, v, inverse, inverse_depth) if inverse > _ZERO else _ZERO


@compiled()
def _clear_to_plane(
    inverse: Array, origin: tuple[int, int], samples: Array, near: float, inverse_depth: Array
) -> None:
    """Fill a sample buffer with the plane's inverse depth, 1/m; 0 where it is not visible."""
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
    """Write to ``depth`` the plane's depth at each pixel, metres; 0 where it is not visible."""
    for j in range(depth.shape[0]):
        for i in range(depth.shape[1]):
            value = inverse[0] * i + inverse[1] * j + inverse[2]
            depth[j, i] = 1.0 / value if 0.0 < value * near <= 1.0 else 0.0
