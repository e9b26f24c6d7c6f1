"""The pinhole camera: OpenCV axes (x right, y down, z forward), pixel (0, 0) a pixel's centre."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from dopepp.core.errors import UserError
from dopepp.geometry.cuboid import Cuboid
from dopepp.geometry.rotation import (
    RotationMatrix,
    Vector,
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
)

Transform = Float[np.ndarray, "4 4"]
"""``T_a_b``, rigid: it maps frame b into frame a, metres."""

CameraMatrix = Float[np.ndarray, "3 3"]
"""K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], pixels."""

Step = Float[np.ndarray, "6"]
"""A turn about the object's origin (rotation vector) and a shift, camera axes: radians, metres."""

Points = Float[np.ndarray, "*batch 3"]
Pixels = Float[np.ndarray, "*batch 2"]


def transform(T_a_b: Transform, points_b: Points) -> Points:
    """Map points from frame b into frame a with a rigid 4×4 transform."""
    return np.asarray(points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3])


def make_transform(rotation: RotationMatrix, translation: Vector) -> Transform:
    """Put a rotation and a translation into a 4×4 rigid transform (float64)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    return T


def invert_transform(T_a_b: Transform) -> Transform:
    """Return T_b_a of a rigid transform T_a_b."""
    rotation = T_a_b[:3, :3].T
    return make_transform(rotation, -rotation @ T_a_b[:3, 3])


def moved(T_cam_obj: Transform, step: Step) -> Transform:
    """Turn a pose about the object's origin and shift it."""
    turn = rotation_vector_to_matrix(step[:3])
    return make_transform(turn @ T_cam_obj[:3, :3], T_cam_obj[:3, 3] + step[3:])


def step_between(before: Transform, after: Transform) -> Step:
    """Return the step by which :func:`moved` makes one pose of the other."""
    turn = matrix_to_rotation_vector(after[:3, :3] @ before[:3, :3].T)
    return np.concatenate([turn, after[:3, 3] - before[:3, 3]])


def project(points_cam: Points, K: CameraMatrix) -> Pixels:
    """Project camera-frame points (metres) to pixels; points at or behind the camera become NaN."""
    points_cam = np.asarray(points_cam, np.float64)
    depth = points_cam[..., 2:]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        rays = np.where(depth > 0, points_cam / depth, np.nan)
        return np.asarray((rays @ np.asarray(K, np.float64).T)[..., :2])


def project_keypoints(
    cuboid: Cuboid, T_cam_obj: Transform, K: CameraMatrix
) -> Float[np.ndarray, "9 2"]:
    """Project an object's nine keypoints to pixels (NaN where one is behind the camera)."""
    return project(transform(T_cam_obj, cuboid), K)


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> CameraMatrix:
    """Assemble K from focal lengths and principal point, all in pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def resize_camera(K: CameraMatrix, scale_x: float, scale_y: float) -> CameraMatrix:
    """Follow an image resize: u becomes s·(u + ½) − ½ because pixel 0 is a pixel's centre."""
    resized = np.array(K, np.float64)
    resized[0] *= scale_x
    resized[1] *= scale_y
    resized[0, 2] += (scale_x - 1) / 2
    resized[1, 2] += (scale_y - 1) / 2
    return resized


def crop_camera(K: CameraMatrix, left: float, top: float) -> CameraMatrix:
    """Follow a crop whose first pixel was (left, top): the principal point moves, nothing else."""
    cropped = np.array(K, np.float64)
    cropped[:2, 2] -= left, top
    return cropped


def focal_length(K: CameraMatrix) -> float:
    """Return the geometric mean of fx and fy, pixels."""
    return math.sqrt(K[0, 0] * K[1, 1])


def resize_points(points_px: Pixels, scale_x: float, scale_y: float) -> Pixels:
    """Move pixel coordinates through the same resize as :func:`resize_camera`."""
    scale = np.array([scale_x, scale_y])
    return np.asarray(scale * (np.asarray(points_px) + 0.5) - 0.5)


@dataclass(frozen=True)
class Letterbox:
    """Scaling of an image to fit inside a network's input, which padding then fills.

    Padding on the right and at the bottom leaves K unchanged. ``width`` and ``height`` (pixels) are
    those of the resized image; the scales of the two axes differ by the rounding to whole pixels.
    """

    width: int
    height: int
    scale_x: float
    scale_y: float

    @classmethod
    def fit(cls, image_size: tuple[int, int], input_size: tuple[int, int]) -> Letterbox:
        """Fit an image of (width, height) into an input of (width, height)."""
        scale = min(input_size[0] / image_size[0], input_size[1] / image_size[1])
        box = cls.scaled(image_size, scale)
        width, height = min(input_size[0], box.width), min(input_size[1], box.height)
        return cls(width, height, width / image_size[0], height / image_size[1])

    @classmethod
    def scaled(cls, image_size: tuple[int, int], scale: float) -> Letterbox:
        """Resize an image of (width, height) by a factor."""
        width, height = (max(1, round(side * scale)) for side in image_size)
        return cls(width, height, width / image_size[0], height / image_size[1])

    def image(
        self, image: UInt8[np.ndarray, "rows columns 3"]
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Resize an RGB image into the letterbox, without the padding."""
        if (image.shape[1], image.shape[0]) == (self.width, self.height):
            return image
        # INTER_AREA averages all source pixels when shrinking and would repeat them when enlarging.
        method = cv2.INTER_AREA if self.scale_x < 1 else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(image, (self.width, self.height), interpolation=method))

    def camera(self, K: CameraMatrix) -> CameraMatrix:
        """Return K for the letterboxed image."""
        return resize_camera(K, self.scale_x, self.scale_y)

    def points(self, points_px: Pixels) -> Pixels:
        """Move original pixel coordinates into the letterboxed image."""
        return resize_points(points_px, self.scale_x, self.scale_y)

    def original_points(self, points_px: Pixels) -> Pixels:
        """Move letterboxed pixel coordinates back into the original image."""
        return resize_points(points_px, 1 / self.scale_x, 1 / self.scale_y)


def pinhole_matrix(K: CameraMatrix, source: str) -> CameraMatrix:
    """Return K as float64; a :class:`UserError` where it is no finite pinhole matrix."""
    try:
        matrix = np.array(K, np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    # What must be 0 or 1 is so, within the digits of a calibration file.
    fixed = np.array([[np.nan, 0, np.nan], [0, np.nan, np.nan], [0, 0, 1]])
    is_finite = matrix.shape == (3, 3) and bool(np.isfinite(matrix).all())
    if not is_finite or np.nanmax(np.abs(matrix - fixed)) > 1e-6:
        raise UserError(
            f"K {K!r:.200} of {source}",
            "a 3×3 pinhole matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels",
            "pass the camera's own K",
        )
    # What is 0 or 1 but for a file's digits is made exactly so.
    return camera_matrix(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])


LEAST_VIEW_DEG: Final = 5.0
MOST_VIEW_DEG: Final = 150.0
"""Of a whole picture's longer side."""

WHOLE: Final = 0.2
"""How far off the middle a whole picture's principal point may be, share of a side: lenses' are
within a tenth, and that of a picture half or one and a half times as large is a quarter off."""

INSIDE: Final = 0.5
"""Idem of a picture that may have been cut out of a larger one, as some data sets' are."""

ANYWHERE: Final = math.inf
"""Idem of a picture that is known to have been cut out."""


def check_camera(
    K: CameraMatrix, image_size: tuple[int, int], source: str, off_centre: float = INSIDE
) -> CameraMatrix:
    """Return K as float64 after checking that it can belong to an image of (width, height).

    Raises:
        UserError: K is not a finite pinhole matrix, its principal point is farther than
            ``off_centre`` (a share of the side) from the image's middle, or the field of view is
            outside 5° – 150°. What was cut out (``ANYWHERE``) may see less than 5°.
    """
    width, height = image_size
    K = pinhole_matrix(K, source)
    longest = max(width, height)
    at = np.array([(K[0, 2] + 0.5) / width, (K[1, 2] + 0.5) / height])
    views = np.degrees(2 * np.arctan2(longest / 2, K.diagonal()[:2])).round(1)
    narrowest = LEAST_VIEW_DEG if off_centre < ANYWHERE else 0.0
    is_central = np.abs(at - 0.5).max() <= off_centre
    if is_central and narrowest <= views.min() and views.max() <= MOST_VIEW_DEG:
        return K
    middle = f"within {0.5 - off_centre:.0%} – {0.5 + off_centre:.0%} of width and height"
    middle = "inside the image" if off_centre == INSIDE else middle
    raise UserError(
        f"K with fx={K[0, 0]:.6g}, fy={K[1, 1]:.6g}, cx={K[0, 2]:.6g}, cy={K[1, 2]:.6g} "
        f"for the {width}×{height} image of {source}: principal point at {at[0]:.0%} of its width "
        f"and {at[1]:.0%} of its height, field of view {views.max():.3g}°",
        ("" if off_centre == ANYWHERE else f"a principal point {middle} and ")
        + f"a field of view of {narrowest:g}° – {MOST_VIEW_DEG:g}°",
        "pass the K of this image's size (K scales with the image)"
        + _likely_size(K, at, off_centre),
    )


def _likely_size(K: CameraMatrix, at: Float[np.ndarray, "2"], off_centre: float) -> str:
    """Say of which image's size K looks, where it is off: twice its principal point."""
    if off_centre != WHOLE or np.abs(at - 0.5).max() <= WHOLE or (at <= 0).any():
        return ""
    size = f"{2 * K[0, 2] + 1:.0f}×{2 * K[1, 2] + 1:.0f}"
    return (
        f": this one is likely of {size} (--K-size); of an image that was cut out, say so (--crop)"
    )
