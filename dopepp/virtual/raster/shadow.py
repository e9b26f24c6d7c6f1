"""Shadow maps: the scene's depth as a light sees it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.compiled import Array
from dopepp.virtual.raster.projection import Projected
from dopepp.virtual.raster.visibility import CENTRE_SAMPLE, project_vertices, rasterise
from dopepp.virtual.scene import NEAR, Light, Scene, SceneObject

TEXELS_PER_PX: Final = 1.0
"""Resolution of a shadow map, relative to the objects' image."""

_FILL_RESOLUTION: Final = 0.5
"""Resolution of the shadows of all lights but the first, relative to the first one's."""

_SIDES: Final = (64, 768)
"""Smallest and largest side of a shadow map, texels."""

_LARGEST_TANGENT: Final = 3.0
"""A light among the objects looks no farther than this to the sides; beyond, all is lit."""


@dataclass(frozen=True, eq=False)
class ShadowMap:
    """What one light sees.

    Attributes:
        inverse_depth: 1/m, 0 where nothing is, shape (height, width, 1).
        P: Camera frame to homogeneous pixels of the map, of which the third is the depth from the
            light, shape (3, 4), float32.
        texel: Metres that a texel spans per metre of depth.
    """

    inverse_depth: Array
    P: Array
    texel: float


def light_row(light: Light) -> Array:
    """Return a light's position and its linear RGB at one metre, for compiled code."""
    return np.array([*light.position, *(light.reach**2 * np.array(light.intensity))], np.float32)


def shadow_maps(scene: Scene, projected: Sequence[Projected]) -> list[tuple[Array, ShadowMap]]:
    """Return every light of a scene as :func:`light_row`, with its shadow map."""
    boxes = [box for seen in projected if (box := seen.box(scene.size)) is not None]
    extent = max((max(box[2] - box[0], box[3] - box[1]) for box in boxes), default=0)
    lights = []
    for number, light in enumerate(scene.lights):
        texels = TEXELS_PER_PX * extent * (_FILL_RESOLUTION if number else 1.0)
        lights.append((light_row(light), shadow_map(light, scene.objects, projected, texels)))
    return lights


def shadow_map(
    light: Light, objects: Sequence[SceneObject], projected: Sequence[Projected], texels: float
) -> ShadowMap:
    """Rasterise objects from a light; outside the map nothing casts a shadow.

    Args:
        light: The light.
        objects: What casts shadows.
        projected: Their vertices in the camera frame.
        texels: About the number of texels across the map's longer side.
    """
    hulls = [item.surface.hull @ item.T_cam_obj[:3, :3].T + item.T_cam_obj[:3, 3]
             for item in objects]  # fmt: skip
    points = np.concatenate(hulls)
    T_light_cam = _look_at(light, (points.min(axis=0) + points.max(axis=0)) / 2)
    points = points @ T_light_cam[:3, :3].T + T_light_cam[:3, 3]
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
    return ShadowMap(inverse_depth, (K @ T_light_cam[:3]).astype(np.float32), 1 / focal)


def _look_at(light: Light, centre: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Return the transform from the camera frame to a frame at the light that looks at a point."""
    position = np.array(light.position, np.float64)
    forward = centre - position
    distance = float(np.linalg.norm(forward))
    # From the point itself it looks anywhere.
    forward = forward / distance if distance > 0 else np.array([0.0, 0.0, 1.0])
    right = np.cross(np.eye(3)[np.abs(forward).argmin()], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, -rotation @ position
    return T
