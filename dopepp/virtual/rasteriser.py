"""The rasteriser: a scene becomes an image, its depth, its instances and visible fractions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int16

from dopepp.geometry.camera import resize_camera
from dopepp.virtual.compiled import Array
from dopepp.virtual.scene import NEAR, Light, Rendered, Scene, SceneObject
from dopepp.virtual.shading import SRGB_TO_LINEAR, TONE_CURVE, shade
from dopepp.virtual.visibility import (
    CENTRE_SAMPLE,
    PIXEL_SAMPLES,
    bounds,
    composite,
    project_vertices,
    rasterise,
)

_MAX_SILHOUETTE_PX: Final = 1_000_000
"""A full silhouette whose box is larger than this is counted at a reduced scale."""

_SHADOW_TEXELS_PER_PX: Final = 2.0
"""Resolution of the shadow map, relative to the image of what receives the shadow."""

_SHADOW_SIDES: Final = (256, 768)
"""Smallest and largest side of the shadow map, texels."""


@dataclass(frozen=True, eq=False)
class Silhouette:
    """What an object would cover if nothing stood before it.

    Attributes:
        mask: Its pixels within the image.
        num_px: Its pixels on a canvas without borders; infinite around the camera.
        box: (left, top, right, bottom) of those pixels' bounds, pixels, right and bottom excluded;
            it may reach beyond the image. None behind the camera.
    """

    mask: Bool[np.ndarray, "height width"]
    num_px: float
    box: tuple[int, int, int, int] | None


@dataclass(frozen=True, eq=False)
class _Projected:
    """An object's vertices in the camera frame and in homogeneous pixels, and its image bounds."""

    cam: Array
    hom: Array
    box: tuple[int, int, int, int] | None


def render(scene: Scene) -> Rendered:
    """Render a scene with 2×2 anti-aliasing; a scene without objects is its background."""
    width, height = scene.size
    image = scene.background.copy()
    depth = np.zeros((height, width), np.float32)
    instances = np.full((height, width), -1, np.int16)
    projected = [_project(item, scene.K, scene.size) for item in scene.objects]
    boxes = [item.box for item in projected if item.box is not None]
    if boxes:
        left, top = min(box[0] for box in boxes), min(box[1] for box in boxes)
        right, bottom = max(box[2] for box in boxes), max(box[3] for box in boxes)
        shape = (bottom - top, right - left, len(PIXEL_SAMPLES))
        inverse_depth, ids = np.zeros(shape, np.float32), np.full(shape, -1, np.int32)
        colour = np.zeros((*shape[:2], 3), np.float32)
        first_ids = _first_ids(scene)
        for item, seen, first in zip(scene.objects, projected, first_ids, strict=True):
            surface = item.surface
            rasterise(
                seen.hom, surface.faces, surface.closed, NEAR, (left, top), PIXEL_SAMPLES,
                inverse_depth, ids, first,
            )  # fmt: skip
        _shade_all(scene, projected, first_ids, (left, top), ids, colour)
        composite((left, top), ids, inverse_depth, colour, first_ids, image, depth, instances)
    return Rendered(image, depth, instances, _fractions(scene, projected, instances), scene)


def visible_fractions(scene: Scene) -> Float[np.ndarray, "objects"]:
    """Return the visible fractions that :func:`render` reports, without shading anything."""
    width, height = scene.size
    projected = [_project(item, scene.K, scene.size) for item in scene.objects]
    inverse_depth = np.zeros((height, width, 1), np.float32)
    ids = np.full((height, width, 1), -1, np.int32)
    first_ids = _first_ids(scene)
    for item, seen, first in zip(scene.objects, projected, first_ids, strict=True):
        rasterise(
            seen.hom, item.surface.faces, item.surface.closed, NEAR, (0, 0), CENTRE_SAMPLE,
            inverse_depth, ids, first,
        )  # fmt: skip
    owners = np.searchsorted(first_ids, ids[..., 0], side="right") - 1
    return _fractions(scene, projected, owners.astype(np.int16))


def silhouette(item: SceneObject, K: Array, size: tuple[int, int]) -> Silhouette:
    """Return an object's whole silhouette, for formats that store it (BOP's ``mask``)."""
    width, height = size
    seen, surface = _project(item, K, size), item.surface
    canvas, ids = np.zeros((height, width, 1), np.float32), np.empty((height, width, 1), np.int32)
    rasterise(seen.hom, surface.faces, surface.closed, NEAR, (0, 0), CENTRE_SAMPLE, canvas, ids, 0)
    mask = canvas[..., 0] > 0
    left, top, right, bottom = bounds(seen.hom, NEAR)
    if left > right:
        return Silhouette(mask, 0.0, None)
    if not math.isfinite(left):
        return Silhouette(mask, math.inf, (0, 0, width, height))
    box = (math.ceil(left), math.ceil(top), math.floor(right) + 1, math.floor(bottom) + 1)
    whole = float(mask.sum()) if _in_frame(seen, size) else _silhouette_px(item, seen, K)
    return Silhouette(mask, whole, box)


def _first_ids(scene: Scene) -> Array:
    counts = [len(item.surface.faces) for item in scene.objects]
    return np.concatenate([[0], np.cumsum(counts)])[: len(counts)].astype(np.int64)


def _project(item: SceneObject, K: Array, size: tuple[int, int]) -> _Projected:
    """Project an object's vertices and bound them by (left, top, right, bottom) in the image."""
    cam, hom = np.empty_like(item.surface.vertices), np.empty_like(item.surface.vertices)
    project_vertices(item.surface.vertices, item.T_cam_obj, K, cam, hom)
    left, top, right, bottom = bounds(hom, NEAR)
    width, height = size
    if left > right:
        return _Projected(cam, hom, None)  # all of it is behind the camera
    # Samples reach a quarter pixel beyond a pixel's centre.
    box = (
        math.ceil(max(left - 0.25, 0.0)),
        math.ceil(max(top - 0.25, 0.0)),
        math.floor(min(right + 0.25, width - 1)) + 1,
        math.floor(min(bottom + 0.25, height - 1)) + 1,
    )
    return _Projected(cam, hom, box if box[0] < box[2] and box[1] < box[3] else None)


def _fractions(
    scene: Scene, projected: list[_Projected], instances: Int16[np.ndarray, "height width"]
) -> Float[np.ndarray, "objects"]:
    """Divide every object's visible pixels by those of its whole silhouette."""
    visible = np.bincount(instances.reshape(-1) + 1, minlength=len(projected) + 1)[1:]
    fractions = np.zeros(len(projected))
    for index, (item, seen) in enumerate(zip(scene.objects, projected, strict=True)):
        if len(projected) == 1 and _in_frame(seen, scene.size):
            fractions[index] = 1.0  # nothing can hide it
        elif visible[index]:
            whole = _silhouette_px(item, seen, scene.K)
            fractions[index] = min(visible[index] / whole, 1.0) if whole else 1.0
    return fractions


def _in_frame(seen: _Projected, size: tuple[int, int]) -> bool:
    """Tell whether an object's whole image lies within the frame's pixel centres."""
    left, top, right, bottom = bounds(seen.hom, NEAR)
    return 0 <= left <= right <= size[0] - 1 and 0 <= top <= bottom <= size[1] - 1


def _silhouette_px(item: SceneObject, seen: _Projected, K: Array) -> float:
    """Count the pixel centres an object covers alone on a canvas as large as it needs."""
    left, top, right, bottom = bounds(seen.hom, NEAR)
    if not math.isfinite(left):
        # It surrounds the camera: the whole silhouette is a hemisphere, of no finite size.
        return math.inf
    hom, scale = seen.hom, 1.0
    if (right - left + 2) * (bottom - top + 2) > _MAX_SILHOUETTE_PX:
        scale = math.sqrt(_MAX_SILHOUETTE_PX / ((right - left + 2) * (bottom - top + 2)))
        hom = seen.cam @ resize_camera(K, scale, scale).T
        left, top, right, bottom = bounds(hom, NEAR)
    x0, y0 = math.ceil(left), math.ceil(top)
    canvas = np.zeros((math.floor(bottom) - y0 + 1, math.floor(right) - x0 + 1, 1), np.float32)
    if canvas.size == 0:
        return 0.0
    ids = np.empty(canvas.shape, np.int32)
    surface = item.surface
    rasterise(hom, surface.faces, surface.closed, NEAR, (x0, y0), CENTRE_SAMPLE, canvas, ids, 0)
    return float(np.count_nonzero(canvas)) / scale**2


def _shade_all(
    scene: Scene,
    projected: list[_Projected],
    first_ids: Array,
    origin: tuple[int, int],
    ids: Array,
    colour: Array,
) -> None:
    """Shade every object's visible samples into the colour window."""
    light_map, K_light, T_light_cam, texel = _shadow_map(scene, projected)
    lights = np.array(
        [[*light.position, *light.intensity, light.reach] for light in scene.lights], np.float64
    ).reshape(-1, 7)
    ambient = np.array([*scene.ambient.up, *scene.ambient.above, *scene.ambient.below])
    for item, seen, first in zip(scene.objects, projected, first_ids, strict=True):
        if seen.box is None:
            continue
        surface, material = item.surface, item.material
        left, top, right, bottom = seen.box
        window = (left - origin[0], top - origin[1], right - origin[0], bottom - origin[1])
        shade(
            window, origin, ids, first, surface.vertices, seen.cam, seen.hom, surface.faces,
            surface.normals, surface.uv, surface.textures[_texture_level(item, scene.K)],
            np.ascontiguousarray(item.T_cam_obj[:3, :3]),
            np.array([*material.colour, material.roughness, material.specular, material.noise,
                      1 / material.noise_pitch]),
            lights, ambient, light_map, K_light, T_light_cam, 1.5 * texel,
            PIXEL_SAMPLES, SRGB_TO_LINEAR, TONE_CURVE, colour,
        )  # fmt: skip


def _texture_level(item: SceneObject, K: Array) -> int:
    """Choose the texture level whose texels are about as large as the object's pixels."""
    surface = item.surface
    depth = float(item.T_cam_obj[2, 3])
    if surface.uv_area == 0.0 or depth <= 0.0:
        return 0
    rows, columns = surface.textures[0].shape[:2]
    texels = surface.uv_area * rows * columns
    pixels = surface.area * K[0, 0] * K[1, 1] / depth**2
    # Half a level is given away for sharpness; the 2×2 samples take care of the rest.
    level = math.floor(0.5 * math.log2(max(texels / pixels, 1.0)))
    return min(level, len(surface.textures) - 1)


def _shadow_map(scene: Scene, projected: list[_Projected]) -> tuple[Array, Array, Array, float]:
    """Rasterise the scene from the first light: (1/depth, K, T_light_cam, metres a texel)."""
    if not scene.lights:
        return np.zeros((1, 1, 1), np.float32), np.eye(3), np.eye(4), 0.0
    # The map's resolution goes to the targets; what lies outside it counts as lit.
    receivers = list(scene.targets) or list(range(len(scene.objects)))
    centres = np.array([_sphere(scene.objects[index]) for index in receivers])
    lower = (centres[:, :3] - centres[:, 3:]).min(axis=0)
    upper = (centres[:, :3] + centres[:, 3:]).max(axis=0)
    centre = (lower + upper) / 2
    radius = float((np.linalg.norm(centres[:, :3] - centre, axis=1) + centres[:, 3]).max())
    T_light_cam = _look_at(scene.lights[0], centre)
    distance = max(
        float(np.linalg.norm(np.array(scene.lights[0].position) - centre)), 1.01 * radius
    )
    boxes = [projected[index].box or (0, 0, 0, 0) for index in receivers]
    extent = max(max(box[2] - box[0], box[3] - box[1]) for box in boxes)
    side = int(np.clip(_SHADOW_TEXELS_PER_PX * extent, *_SHADOW_SIDES))
    # The sphere's outline is seen under the angle asin(radius/distance).
    focal = 0.5 * (side - 2) * math.sqrt(distance**2 - radius**2) / radius
    K_light = np.array([[focal, 0, (side - 1) / 2], [0, focal, (side - 1) / 2], [0, 0, 1.0]])
    light_map = np.zeros((side, side, 1), np.float32)
    ids = np.empty(light_map.shape, np.int32)
    for item, seen in zip(scene.objects, projected, strict=True):
        cam, hom = np.empty_like(seen.cam), np.empty_like(seen.cam)
        project_vertices(seen.cam, T_light_cam, K_light, cam, hom)
        surface = item.surface
        rasterise(
            hom, surface.faces, surface.closed, NEAR, (0, 0), CENTRE_SAMPLE, light_map, ids, 0
        )
    return light_map, K_light, T_light_cam, distance / focal


def _sphere(item: SceneObject) -> Float[np.ndarray, "4"]:
    """Return the camera-frame centre and the radius of a sphere around an object."""
    hull = item.surface.hull
    centre = (hull.min(axis=0) + hull.max(axis=0)) / 2
    radius = np.linalg.norm(hull - centre, axis=1).max()
    return np.append(item.T_cam_obj[:3, :3] @ centre + item.T_cam_obj[:3, 3], radius)


def _look_at(light: Light, centre: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Return the transform from the camera frame to a frame at the light that looks at a point."""
    position = np.array(light.position, np.float64)
    forward = (centre - position) / max(float(np.linalg.norm(centre - position)), 1e-12)
    helper = np.eye(3)[np.abs(forward).argmin()]
    right = np.cross(helper, forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, -rotation @ position
    return T
