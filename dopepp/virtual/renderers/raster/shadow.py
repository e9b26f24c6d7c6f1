"""What keeps light away: shadow maps of the lamps, and the sky that objects hide from a plane.

A shadow map is the scene's depth as a light sees it. For the sky, points spread over the objects
stand for them: in each of 32 directions into the sky, spread with the cosine, every point hides the
sky from one spot of the plane; one bit per direction and cell says so, and the share of bits is the
share of the sky. That is the soft darkening around an object that touches a table.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float
from numpy.lib.stride_tricks import sliding_window_view

from dopepp.core.compiled import Array, Scalar, compiled
from dopepp.geometry.camera import Transform, make_transform, transform
from dopepp.geometry.rotation import Vector, rotation_to_z
from dopepp.virtual.renderers.raster.visibility import Projected
from dopepp.virtual.scene import NEAR, Ambient, Light, Scene, SceneObject
from dopepp.virtual.triangles import CENTRE_SAMPLE, open_share, project_vertices, rasterise, scratch

_LARGEST_TANGENT: Final = 3.0
"""A light among the objects looks no farther than this to the sides; beyond, all is lit."""

_SKY_DIRECTIONS: Final = 32
"""Directions in which the sky is looked at, one bit each."""

# Plain literals would turn the arithmetic into float64.
_ZERO, _ONE = np.float32(0), np.float32(1)


@dataclass(frozen=True, eq=False)
class ShadowMap:
    """What one light sees.

    Attributes:
        light: As of :func:`light_row`.
        inverse_depth: 1/m, 0 where nothing is, shape (height, width, 1).
        P: Camera frame to homogeneous pixels of the map, of which the third is the depth from the
            light, shape (3, 4), float32.
        texel: Metres that a texel spans per metre of depth.
    """

    light: Array
    inverse_depth: Array
    P: Array
    texel: float


def shadow_maps(scene: Scene, projected: Sequence[Projected]) -> list[ShadowMap]:
    """Return the shadow map of every light of a scene with objects."""
    boxes = [box for seen in projected if (box := seen.box(scene.size)) is not None]
    extent = max((max(box[2] - box[0], box[3] - box[1]) for box in boxes), default=0)
    lights = []
    for number, light in enumerate(scene.lights):
        # One per pixel of the objects' image; for all lights but the first, half as many.
        texels = extent * (0.5 if number else 1.0)
        lights.append(shadow_map(light, scene.objects, projected, texels))
    return lights


def shadow_map(
    light: Light, objects: Sequence[SceneObject], projected: Sequence[Projected], texels: float
) -> ShadowMap:
    """Rasterise objects from a light; outside the map nothing casts a shadow.

    ``projected`` are their vertices in the camera frame; the map's longer side has about
    ``texels``.
    """
    points = np.concatenate([transform(item.T_cam_obj, item.surface.hull) for item in objects])
    T_light_cam = _look_at(light, (points.min(axis=0) + points.max(axis=0)) / 2)
    points = transform(T_light_cam, points)
    depth = np.maximum(points[:, 2], NEAR)
    tangents = points[:, :2] / depth[:, None]
    if (points[:, 2] <= NEAR).any():
        low, high = np.full(2, -_LARGEST_TANGENT), np.full(2, _LARGEST_TANGENT)
    else:
        low = np.maximum(tangents.min(axis=0), -_LARGEST_TANGENT)
        high = np.minimum(tangents.max(axis=0), _LARGEST_TANGENT)
    span = np.maximum(high - low, 1e-6)
    focal = float(np.clip(texels, 64, 768) / span.max())
    # Two texels of margin, so that the interpolation at the outline stays inside.
    width, height = (math.ceil(focal * side) + 4 for side in span)
    K = np.array([[focal, 0, 2 - focal * low[0]], [0, focal, 2 - focal * low[1]], [0, 0, 1.0]])
    inverse_depth = np.zeros((height, width, 1), np.float32)
    ids = np.empty(inverse_depth.shape, np.int32)
    for item, seen in zip(objects, projected, strict=True):
        cam, hom = np.empty_like(seen.cam), np.empty_like(seen.cam)
        project_vertices(seen.cam, T_light_cam, K, cam, hom)
        surface = item.surface
        rasterise(
            hom, surface.faces, surface.closed, NEAR, (0, 0), CENTRE_SAMPLE, inverse_depth, ids, 0
        )
    P = (K @ T_light_cam[:3]).astype(np.float32)
    return ShadowMap(light_row(light), inverse_depth, P, 1 / focal)


def light_row(light: Light) -> Array:
    """Return a light's position and its linear RGB at one metre, for compiled code."""
    return np.array([*light.position, *(light.reach**2 * np.array(light.intensity))], np.float32)


def ambient_row(ambient: Ambient) -> Array:
    """Return the up direction and the light from above and below, for compiled code."""
    return np.array([*ambient.up, *ambient.above, *ambient.below], np.float32)


def lit_shares(
    position: Array,
    normal: Array,
    bulge: Array,
    light: Array,
    inverse_depth: Array,
    P: Array,
    lift: float,
    lit: Array,
) -> None:
    """Write the share of a light's light that reaches each point; 0 where it faces away.

    ``light`` comes from :func:`light_row`; ``inverse_depth`` and ``P`` are its shadow map's. Before
    a point is looked up it is lifted along its normal, by ``lift`` metres per metre of distance
    from the light (from √2 texels on, the four texels around it lie behind it on its own plane,
    whatever the slope), and by its ``bulge``, metres, shape (n,): a smooth ball of few flat
    triangles would shadow itself where its normals still face the light. ``lit`` has the shape
    (n,).
    """
    u, v, inverse = scratch("places", position.shape, np.float32)
    _place(position, normal, bulge, light, P, np.float32(lift), u, v, inverse)
    _compare(u, v, inverse, inverse_depth, lit)


@compiled(fastmath=True)
def _place(
    position: Array, normal: Array, bulge: Array, light: Array, P: Array, lift: Scalar, u: Array,
    v: Array, inverse: Array,
) -> None:  # fmt: skip
    """Project lifted points into the map: (u, v) and 1/depth, negative where they face away."""
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
        u[p] = (a * x + b * y + c * z + d) * scale
        v[p] = (e * x + f * y + g * z + h) * scale
        inverse[p] = scale if facing > _ZERO else -_ONE


@compiled(fastmath=True)
def _compare(u: Array, v: Array, inverse: Array, inverse_depth: Array, lit: Array) -> None:
    """Compare projected points with the map."""
    for p in range(lit.shape[0]):
        lit[p] = open_share(u[p], v[p], inverse[p], inverse_depth) if inverse[p] > _ZERO else _ZERO


def _look_at(light: Light, centre: Vector) -> Transform:
    """Return the transform from the camera frame to a frame at the light that looks at a point."""
    position = np.array(light.position, np.float64)
    forward = centre - position
    distance = float(np.linalg.norm(forward))
    # From the point itself it looks anywhere.
    rotation = rotation_to_z(forward / distance if distance > 0 else np.array([0.0, 0.0, 1.0]))
    return make_transform(rotation, -rotation @ position)


def hidden_sky(
    frame: Float[np.ndarray, "3 4"], objects: Sequence[SceneObject]
) -> tuple[Vector, Float[np.ndarray, "rows columns"]] | None:
    """Return the share of a plane's sky that objects hide; None if they are all below it.

    ``frame`` maps camera-frame points to (x, y) on the plane and the height above it, metres. First
    come (x, y) of the grid's first cell and a cell's side, metres.
    """
    places = []
    for item in objects:
        points = transform(item.T_cam_obj, item.surface.points) @ frame[:, :3].T + frame[:, 3]
        places.append(points[points[:, 2] > 0])
    everything = np.concatenate(places) if places else np.zeros((0, 3))
    if len(everything) == 0:
        return None
    # Farther away than twice the objects' height, little sky is hidden.
    margin = 2 * float(everything[:, 2].max())
    low, high = everything[:, :2].min(axis=0) - margin, everything[:, :2].max(axis=0) + margin
    cell = float((high - low).max()) / 80
    columns, rows = (math.ceil(side) + 1 for side in (high - low) / cell)
    bits, own = np.zeros((rows, columns), np.uint32), np.empty((rows, columns), np.uint32)
    grid, slopes = np.array([low[0], low[1], cell]), _sky_slopes()
    for item, points in zip(objects, places, strict=True):
        own[:] = 0
        # Half a spot's side, so wide that spots leave no gaps.
        reach = max(0.8 * item.surface.spacing / cell, 0.5)
        _splat(points, reach, slopes, grid, own)
        # Taken from every direction's spot is what its splats stick out.
        cells = round(reach - 0.5)
        padded = np.pad(own, cells, constant_values=np.iinfo(np.uint32).max)
        windows = sliding_window_view(padded, (2 * cells + 1, 2 * cells + 1))
        bits |= np.bitwise_and.reduce(windows, axis=(2, 3))
    counts = np.unpackbits(bits.view(np.uint8), axis=1).reshape(rows, columns, -1).sum(axis=-1)
    hidden = cv2.blur(counts.astype(np.float32) / _SKY_DIRECTIONS, (3, 3))
    # A little is left at the grid's border; it is faded out over half of the margin.
    edges = (
        np.minimum(np.arange(side), np.arange(side)[::-1]) / (0.5 * margin / cell)
        for side in (rows, columns)
    )
    hidden *= np.minimum(np.minimum.outer(*edges), 1.0).astype(np.float32)
    return grid, np.asarray(hidden)


def _sky_slopes() -> Float[np.ndarray, "directions 2"]:
    """Return directions into the sky as (x, y)/z, spread with the cosine (Malley's method)."""
    k = np.arange(_SKY_DIRECTIONS) + 0.5
    radius, angle = np.sqrt(k / _SKY_DIRECTIONS), k * np.pi * (1 + np.sqrt(5))
    height = np.sqrt(1 - radius**2)
    slopes = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return np.asarray(slopes / height[:, None])


@compiled()
def _splat(points: Array, reach: float, slopes: Array, grid: Array, bits: Array) -> None:
    """Set a direction's bit in the cells, up to a reach, from which a point hides it."""
    rows, columns = bits.shape
    for p in range(points.shape[0]):
        for k in range(slopes.shape[0]):
            x = (points[p, 0] - slopes[k, 0] * points[p, 2] - grid[0]) / grid[2]
            y = (points[p, 1] - slopes[k, 1] * points[p, 2] - grid[1]) / grid[2]
            if not (-reach < x < columns - 1 + reach and -reach < y < rows - 1 + reach):
                continue
            bit = np.uint32(1 << k)
            left, right = max(math.ceil(x - reach), 0), min(math.floor(x + reach), columns - 1)
            top, bottom = max(math.ceil(y - reach), 0), min(math.floor(y + reach), rows - 1)
            for j in range(top, bottom + 1):
                for i in range(left, right + 1):
                    bits[j, i] |= bit
