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

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.camera import Transform, make_transform, transform
from dopepp.geometry.rotation import Vector
from dopepp.virtual.renderers.raster.light import light_row
from dopepp.virtual.renderers.raster.visibility import Projected
from dopepp.virtual.scene import NEAR, Light, Scene, SceneObject
from dopepp.virtual.triangles import CENTRE_SAMPLE, project_vertices, rasterise

_TEXELS_PER_PX: Final = 1.0
"""Resolution of a shadow map, relative to the objects' image."""

_FILL_RESOLUTION: Final = 0.5
"""Resolution of the shadows of all lights but the first, relative to the first one's."""

_SIDES: Final = (64, 768)
"""Smallest and largest side of a shadow map, texels."""

_LARGEST_TANGENT: Final = 3.0
"""A light among the objects looks no farther than this to the sides; beyond, all is lit."""

_CELLS: Final = 80
"""Cells across the longer side of the grid on which the sky over the plane is measured."""

_SKY_DIRECTIONS: Final = 32
"""Directions in which the sky is looked at, one bit each."""

_MARGIN: Final = 2.0
"""Of the grid around the objects, in units of their height; beyond it little sky is hidden."""

_SPLAT: Final = 0.8
"""Half the side of a point's spot over the points' spacing; so wide that spots leave no gaps."""


@dataclass(frozen=True, eq=False)
class ShadowMap:
    """What one light sees.

    Attributes:
        light: As of :func:`~dopepp.virtual.renderers.raster.light.light_row`.
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
        texels = _TEXELS_PER_PX * extent * (_FILL_RESOLUTION if number else 1.0)
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
    focal = float(np.clip(texels, *_SIDES) / span.max())
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


def _look_at(light: Light, centre: Vector) -> Transform:
    """Return the transform from the camera frame to a frame at the light that looks at a point."""
    position = np.array(light.position, np.float64)
    forward = centre - position
    distance = float(np.linalg.norm(forward))
    # From the point itself it looks anywhere.
    forward = forward / distance if distance > 0 else np.array([0.0, 0.0, 1.0])
    right = np.cross(np.eye(3)[np.abs(forward).argmin()], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
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
    margin = _MARGIN * float(everything[:, 2].max())
    low, high = everything[:, :2].min(axis=0) - margin, everything[:, :2].max(axis=0) + margin
    cell = float((high - low).max()) / _CELLS
    columns, rows = (math.ceil(side) + 1 for side in (high - low) / cell)
    bits, own = np.zeros((rows, columns), np.uint32), np.empty((rows, columns), np.uint32)
    grid = np.array([low[0], low[1], cell])
    for item, points in zip(objects, places, strict=True):
        own[:] = 0
        reach = max(_SPLAT * item.surface.spacing / cell, 0.5)
        _splat(points, reach, _SKY_SLOPES, grid, own)
        _shrink(own, round(reach - 0.5), bits)
    hidden = np.empty((rows, columns), np.float32)
    _count(bits, hidden)
    hidden = cv2.blur(hidden / _SKY_DIRECTIONS, (3, 3))
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


_SKY_SLOPES: Final = _sky_slopes()


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


@compiled()
def _shrink(bits: Array, cells: int, out: Array) -> None:
    """Take from every direction's spot what its splats stick out, and add it to the others'."""
    rows, columns = bits.shape
    row = np.empty_like(bits)
    for j in range(rows):
        for i in range(columns):
            value = bits[j, i]
            for k in range(max(i - cells, 0), min(i + cells, columns - 1) + 1):
                value &= bits[j, k]
            row[j, i] = value
    for j in range(rows):
        for i in range(columns):
            value = row[j, i]
            for k in range(max(j - cells, 0), min(j + cells, rows - 1) + 1):
                value &= row[k, i]
            out[j, i] |= value


@compiled()
def _count(bits: Array, out: Array) -> None:
    """Count the bits of every cell."""
    for j in range(bits.shape[0]):
        for i in range(bits.shape[1]):
            value, count = bits[j, i], 0
            while value:
                value &= value - np.uint32(1)
                count += 1
            out[j, i] = count
