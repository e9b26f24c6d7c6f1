"""What Mitsuba's camera sees of a part of the image, and what every pixel's centre sees.

Mitsuba's camera has square pixels. A view covers a window of the image with square pixels at least
as fine as the image's; where the camera's pixels are not square, the picture is resampled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int16

from dopepp.virtual.scene import NEAR

Window = tuple[int, int, int, int]
"""(left, top, right, bottom) in pixels of the image, right and bottom excluded."""


@dataclass(frozen=True, eq=False)
class View:
    """A film with square pixels over a window of the image.

    Attributes:
        window: The part of the image.
        size: (width, height) of the film, pixels.
        focal_px: Its focal length.
        centre_px: Its principal point; pixel (0, 0) is the centre of the film's first pixel.
        film_from_window: Affine map, 2×3, from the window's pixels to the film's.
    """

    window: Window
    size: tuple[int, int]
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


def make_view(K: Float[np.ndarray, "3 3"], window: Window) -> View:
    """Return the view of a window of the image."""
    left, top, right, bottom = window
    focal = float(max(K[0, 0], K[1, 1]))
    K_window = K.copy()
    K_window[:2, 2] -= left, top
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


def pixel_rays(K: Float[np.ndarray, "3 3"], window: Window) -> Float[np.ndarray, "height width 3"]:
    """Return the points at depth 1 m that the window's pixel centres see."""
    left, top, right, bottom = window
    y, x = np.mgrid[top:bottom, left:right]
    return np.asarray(np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(K).T)


def cast(
    mi: Any, world: Any, shapes: list[Any], rays: Float[np.ndarray, "height width 3"]
) -> tuple[Float32[np.ndarray, "height width"], Int16[np.ndarray, "height width"]]:
    """Return depth (0 where nothing is hit) and the number of the shape that each ray hits.

    Args:
        mi: The ``mitsuba`` module.
        world: The loaded Mitsuba scene.
        shapes: Its shapes.
        rays: Points at depth 1 m; what is nearer than :data:`~dopepp.virtual.scene.NEAR` is
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
