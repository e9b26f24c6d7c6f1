"""What Mitsuba's camera sees of a part of the image, and the table that it sees there.

Mitsuba's camera has square pixels. A view covers a window of the image with square pixels at least
as fine as the image's; where the camera's pixels are not square, the picture is resampled.

A matt disc stands for a supporting plane, whose picture is the background. Where the path tracer
sees it, its light over what it would be without objects is the factor for the background: shadows,
and light that objects throw on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int16

from dopepp.drawing.pictures import Picture, Size
from dopepp.geometry.camera import CameraMatrix, crop_camera
from dopepp.geometry.rotation import Vector
from dopepp.virtual.renderers.photoreal.scene import bounding_sphere, rgb
from dopepp.virtual.renderers.raster.visibility import Box
from dopepp.virtual.scene import NEAR, Scene
from dopepp.virtual.sensor import CODE_STEPS, LINEAR_TO_SRGB, SRGB_TO_LINEAR

Area = tuple[slice, slice]

_ALBEDO: Final = (0.05, 0.8)
"""Bounds of the disc's albedo, which is estimated from the plane's picture and its light."""

_LEAST_LIGHT: Final = 1e-3
"""Radiance of a white table below which no shadow is cast: there is nothing to take away."""

_SPREAD_PX: Final = 2.0
"""Width over which a shadow is carried on under an object's rim, pixels."""


@dataclass(frozen=True, eq=False)
class View:
    """A film with square pixels over a window of the image.

    Attributes:
        size: (width, height) of the film, pixels.
        centre_px: Its principal point; pixel (0, 0) is the centre of the film's first pixel.
        film_from_window: Affine map, 2×3, from the window's pixels to the film's.
    """

    window: Box
    size: Size
    focal_px: float
    centre_px: tuple[float, float]
    film_from_window: Float[np.ndarray, "2 3"]

    def sensor(self, mi: Any, samples: int) -> dict[str, Any]:
        """Return the camera, at the origin of the camera frame, for Mitsuba."""
        width, height = self.size
        return {
            "type": "perspective",
            "fov": math.degrees(2 * math.atan(width / 2 / self.focal_px)),
            "fov_axis": "x",
            # Fractions of the film, from the principal point to the middle at (width − 1)/2.
            "principal_point_offset_x": 0.5 - (self.centre_px[0] + 0.5) / width,
            "principal_point_offset_y": 0.5 - (self.centre_px[1] + 0.5) / height,
            "near_clip": NEAR,
            "far_clip": 1e4,
            # Mitsuba's camera frame has x to the left and y up.
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 0], [0, 0, 1], [0, -1, 0]),
            "sampler": {"type": "multijitter", "sample_count": samples},
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "pixel_format": "rgba",
                "component_format": "float32",
                # Pixels that share no samples, so that the denoiser sees independent noise.
                "rfilter": {"type": "box"},
            },
        }

    def resampled(
        self, film: Float32[np.ndarray, "film_height film_width 4"]
    ) -> Float32[np.ndarray, "height width 4"]:
        """Return the film's picture in the window's pixels."""
        left, top, right, bottom = self.window
        if np.array_equal(self.film_from_window, np.eye(2, 3)):
            return film
        picture = cv2.warpAffine(
            film, self.film_from_window, (right - left, bottom - top),
            flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        return np.asarray(np.maximum(picture, np.float32(0)))


def make_view(K: CameraMatrix, window: Box) -> View:
    """Return the view of a window of the image."""
    left, top, right, bottom = window
    focal = float(max(K[0, 0], K[1, 1]))
    K_window = crop_camera(K, left, top)
    if K[0, 0] == K[1, 1] and K[0, 1] == 0.0:
        centre = (float(K_window[0, 2]), float(K_window[1, 2]))
        return View(window, (right - left, bottom - top), focal, centre, np.eye(2, 3))
    # The film's pixels are focal · ray − origin.
    rays = np.linalg.inv(K_window)[:2] * focal
    width, height = right - left, bottom - top
    corners = np.array([(x, y, 1.0) for x in (-0.5, width - 0.5) for y in (-0.5, height - 0.5)])
    low, high = (corners @ rays.T).min(axis=0), (corners @ rays.T).max(axis=0)
    size = (math.ceil(high[0] - low[0]), math.ceil(high[1] - low[1]))
    rays[:, 2] -= low + 0.5
    return View(window, size, focal, (-float(low[0]) - 0.5, -float(low[1]) - 0.5), rays)


def pixel_rays(K: CameraMatrix, window: Box) -> Float[np.ndarray, "height width 3"]:
    """Return the points at depth 1 m that the window's pixel centres see."""
    left, top, right, bottom = window
    y, x = np.mgrid[top:bottom, left:right]
    return np.asarray(np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(K).T)


def cast(
    mi: Any, world: Any, shapes: list[Any], rays: Float[np.ndarray, "height width 3"]
) -> tuple[Float32[np.ndarray, "height width"], Int16[np.ndarray, "height width"]]:
    """Return depth (0 where nothing is hit) and the number of the shape that each ray hits.

    ``rays`` are points at depth 1 m; what is nearer than :data:`~dopepp.virtual.scene.NEAR` is
    looked through.
    """
    flat = rays.reshape(-1, 3)
    each = _cast_scalar if mi.variant().startswith("scalar") else _cast_vector
    distance, numbers = each(mi, world, shapes, flat.astype(np.float32))
    depth = np.where(numbers >= 0, distance + NEAR, 0.0).astype(np.float32)
    return depth.reshape(rays.shape[:2]), numbers.astype(np.int16).reshape(rays.shape[:2])


def _cast_vector(
    mi: Any, world: Any, shapes: list[Any], rays: Float32[np.ndarray, "rays 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """Cast all rays at once; directions of unit depth make distances depths."""
    origins, directions = mi.Point3f(rays.T * np.float32(NEAR)), mi.Vector3f(rays.T)
    hit = world.ray_intersect_preliminary(mi.Ray3f(origins, directions), coherent=True)
    numbers = mi.Int32(-1)
    for number, shape in enumerate(shapes):
        numbers[hit.is_valid() & (hit.shape == mi.ShapePtr(shape))] = number
    return np.array(hit.t), np.array(numbers)


def _cast_scalar(
    mi: Any, world: Any, shapes: list[Any], rays: Float32[np.ndarray, "rays 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """Cast the rays one by one."""
    distance, numbers = np.zeros(len(rays)), np.full(len(rays), -1)
    for index, (x, y, z) in enumerate(rays.tolist()):
        ray = mi.Ray3f(mi.Point3f(NEAR * x, NEAR * y, NEAR * z), mi.Vector3f(x, y, z))
        hit = world.ray_intersect_preliminary(ray, coherent=True)
        if hit.is_valid():
            distance[index] = hit.t
            numbers[index] = next(k for k, shape in enumerate(shapes) if shape == hit.shape)
    return distance, numbers


class TableTop:
    """The disc that stands for a scene's plane.

    ``depth`` is the plane's at pixel centres, metres; 0 where it is not seen.
    """

    def __init__(self, scene: Scene, depth: Float32[np.ndarray, "height width"]) -> None:
        assert scene.plane is not None
        self._scene, self._normal = scene, np.array(scene.plane.normal, np.float64)
        middle, radius = bounding_sphere(scene)
        self.centre = middle - (self._normal @ middle - scene.plane.offset) * self._normal
        self.radius = 6 * radius
        self._points = pixel_rays(scene.K, (0, 0, *scene.size)) * depth[..., None]
        away = np.linalg.norm(self._points - self.centre, axis=-1) / self.radius
        self._away = np.where(depth > 0, away, np.inf)
        self._light = np.where((self._away < 1)[..., None], self._full_light(), 0.0)
        self.albedo = self._estimated_albedo()

    def window(self, objects: Box | None) -> Box | None:
        """Return the part of the image with the disc and the objects; None if neither is seen."""
        seen = self._away < 1
        if objects is not None:
            seen[objects[1] : objects[3], objects[0] : objects[2]] = True
        rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        if not len(rows):
            return None
        return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1

    def shape(self, mi: Any) -> dict[str, Any]:
        """Return the disc for Mitsuba."""
        up = np.eye(3)[np.abs(self._normal).argmin()]
        place = mi.ScalarTransform4f().look_at(
            list(self.centre), list(self.centre + self._normal), list(up)
        )
        return {
            "type": "disk",
            "to_world": place.scale(self.radius),
            "bsdf": {"type": "diffuse", "reflectance": rgb(self.albedo)},
        }

    def unshadowed(self, area: Area) -> Float[np.ndarray, "height width 3"]:
        """Return the disc's radiance without objects; 0 beside it."""
        return np.asarray(self.albedo * self._light[area])

    def faded(
        self, kept: Float[np.ndarray, "height width 3"], area: Area
    ) -> Float[np.ndarray, "height width 3"]:
        """Return the shares of light with no step at the disc's rim, and 1 beside it."""
        share = np.clip((1 - self._away[area]) / (1 - 0.6), 0.0, 1.0)[..., None]
        # Smoothstep: no visible line where the fading begins and ends.
        return 1 + (kept - 1) * share * share * (3 - 2 * share)

    def _full_light(self) -> Float[np.ndarray, "height width 3"]:
        """Return the radiance of a white table without objects, in closed form."""
        ambient = self._scene.ambient
        above = 0.5 + 0.5 * float(self._normal @ np.array(ambient.up))
        sky = above * np.array(ambient.above) + (1 - above) * np.array(ambient.below)
        light = np.broadcast_to(sky, self._points.shape).copy()
        for lamp in self._scene.lights:
            towards = np.array(lamp.position) - self._points
            distance = np.maximum(np.linalg.norm(towards, axis=-1), 1e-9)
            facing = np.maximum(towards @ self._normal / distance, 0.0)
            strength = facing * (lamp.reach / distance) ** 2
            light += strength[..., None] * np.array(lamp.intensity)
        return light

    def _estimated_albedo(self) -> Vector:
        """Return the albedo with which the disc is as bright as its picture, within reason."""
        seen = self._away < 1
        if not seen.any():
            return np.full(3, np.mean(_ALBEDO))
        shown = SRGB_TO_LINEAR[self._scene.background[seen]].mean(axis=0)
        light = np.maximum(self._light[seen].mean(axis=0), _LEAST_LIGHT)
        return np.asarray(np.clip(shown / light, *_ALBEDO))


def split_light(
    light: Float32[np.ndarray, "height width 3"],
    alpha: Float32[np.ndarray, "height width"],
    unshadowed: Float[np.ndarray, "height width 3"],
) -> tuple[Float32[np.ndarray, "height width 3"], Float[np.ndarray, "height width 3"]]:
    """Return the objects' share of each pixel's radiance, and the share of light left on the disc.

    ``light`` is the radiance of objects and disc together, ``alpha`` the share of each pixel that
    objects cover, ``unshadowed`` the disc's radiance without objects, 0 beside it.
    """
    known = (alpha <= 0) & (unshadowed.min(axis=-1) > _LEAST_LIGHT)
    kept = np.where(known[..., None], light / np.maximum(unshadowed, _LEAST_LIGHT), 1.0)
    kept = np.clip(kept, 0.0, 4.0)  # over 1: light thrown on a table in deep shade
    # At an object's rim both are mixed; the shadow beside it goes on there.
    weight = cv2.GaussianBlur(known.astype(np.float64), (0, 0), _SPREAD_PX)[..., None]
    spread = cv2.GaussianBlur(np.where(known[..., None], kept, 0.0), (0, 0), _SPREAD_PX)
    carried = np.where(weight > 1e-3, spread / np.maximum(weight, 1e-3), 1.0)
    kept = np.where(known[..., None], kept, carried)
    own = light - (1 - alpha[..., None]) * unshadowed * kept
    return np.where(alpha[..., None] > 0, np.maximum(own, 0), 0).astype(np.float32), kept


def shadowed(picture: Picture, kept: Float[np.ndarray, "height width 3"]) -> Picture:
    """Return a picture of which shares of the light are left."""
    steps = np.minimum(SRGB_TO_LINEAR[picture] * kept * CODE_STEPS + 0.5, CODE_STEPS)
    changed = (LINEAR_TO_SRGB[steps.astype(np.int32)] + 0.5).astype(np.uint8)
    return np.where(kept == 1.0, picture, changed)
