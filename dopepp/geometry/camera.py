"""The pinhole camera: OpenCV axes (x right, y down, z forward); pixel centres are integers."""

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
    Vector,
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
)

Transform = Float[np.ndarray, "4 4"]  # Rigid transform ``T_a_b`` from frame b into frame a, metres

CameraMatrix = Float[np.ndarray, "3 3"]  # K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], pixels

Step = Float[np.ndarray, "6"]
"""Rotation vector about the object's origin (radians) and shift (metres), in camera axes."""

Points = Float[np.ndarray, "*batch 3"]
Pixels = Float[np.ndarray, "*batch 2"]


def transform(T_a_b: Transform, points_b: Points) -> Points:
    """Map points (metres) from frame b into frame a by the rigid transform ``T_a_b``."""
    return np.asarray(points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3])


def make_transform(
    rotation: Float[np.ndarray, "*batch 3 3"], translation: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 4 4"]:
    """Assemble 4×4 rigid transforms from rotations and translations (metres)."""
    T = np.zeros((*np.shape(rotation)[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, translation, 1.0
    return T


def invert_transform(T_a_b: Transform) -> Transform:
    """Return T_b_a of a rigid transform T_a_b."""
    rotation = T_a_b[:3, :3].T
    return make_transform(rotation, -rotation @ T_a_b[:3, 3])


def move_pose(
    T_cam_obj: Float[np.ndarray, "*batch 4 4"], step: Float[np.ndarray, "*batch 6"]
) -> Float[np.ndarray, "*batch 4 4"]:
    """Rotate poses about the object's origin and shift them, both in camera axes."""
    R = rotation_vector_to_matrix(step[..., :3]) @ T_cam_obj[..., :3, :3]
    return make_transform(R, T_cam_obj[..., :3, 3] + step[..., 3:])


def rotation_lever(offset: Vector) -> Float[np.ndarray, "6 6"]:
    """Return the matrix from a rotation about a point, with a shift, to the step of a pose.

    ``offset`` is the object's origin relative to the point, camera axes, metres.
    """
    x, y, z = offset
    lever = np.eye(6)
    lever[3:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return lever


def orbited_camera(point: Vector, angle: float, direction: float) -> Transform:
    """Return T_new_cam, from a camera's frame to its frame after an orbit around a point.

    ``point`` is the centre of the orbit in the original frame, metres; ``angle`` lies between the
    two lines of sight to the point, and ``direction`` from x in the image plane to the rotation
    axis, radians.
    """
    axis = np.array([math.cos(direction), math.sin(direction), 0.0])
    R = rotation_vector_to_matrix(angle * axis)
    return make_transform(R, point - R @ point)


def step_between(before: Transform, after: Transform) -> Step:
    """Return the step from one pose to another: ``move_pose(before, step)`` is ``after``."""
    rotvec = matrix_to_rotation_vector(after[:3, :3] @ before[:3, :3].T)
    return np.concatenate([rotvec, after[:3, 3] - before[:3, 3]])


def project(points_cam: Points, K: CameraMatrix) -> Pixels:
    """Project camera-frame points (metres) to pixels; NaN for points at or behind the camera."""
    points_cam = np.asarray(points_cam, np.float64)
    depth = points_cam[..., 2:]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        rays = np.where(depth > 0, points_cam / depth, np.nan)
        return np.asarray((rays @ np.asarray(K, np.float64).T)[..., :2])


def project_keypoints(
    cuboid: Cuboid, T_cam_obj: Transform, K: CameraMatrix
) -> Float[np.ndarray, "9 2"]:
    """Project an object's nine keypoints to pixels; NaN for keypoints at or behind the camera."""
    return project(transform(T_cam_obj, cuboid), K)


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> CameraMatrix:
    """Assemble K from the focal lengths and the principal point, pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def resize_camera(K: CameraMatrix, scale_x: float, scale_y: float) -> CameraMatrix:
    """Return K of an image that is resized by the factors ``scale_x`` and ``scale_y``."""
    # As pixel centres are integers, u becomes s·(u + ½) − ½.
    resized = np.array(K, np.float64)
    resized[0] *= scale_x
    resized[1] *= scale_y
    resized[0, 2] += (scale_x - 1) / 2
    resized[1, 2] += (scale_y - 1) / 2
    return resized


def crop_camera(K: CameraMatrix, left: float, top: float) -> CameraMatrix:
    """Return K of a crop whose top-left pixel is the image's pixel (left, top)."""
    cropped = np.array(K, np.float64)
    cropped[:2, 2] -= left, top
    return cropped


def focal_length(K: CameraMatrix) -> float:
    """Return the geometric mean of fx and fy, pixels."""
    return math.sqrt(K[0, 0] * K[1, 1])


def resize_points(points_px: Pixels, scale_x: float, scale_y: float) -> Pixels:
    """Map pixel coordinates to the resized image; see :func:`resize_camera`."""
    scale = np.array([scale_x, scale_y])
    return np.asarray(scale * (np.asarray(points_px) + 0.5) - 0.5)


@dataclass(frozen=True)
class Letterbox:
    """Resizing of an image to fit into a network's input, before padding.

    Padding on the right and at the bottom leaves K unchanged. The scales of the two axes (new over
    old size) differ by the rounding to whole pixels.
    """

    width: int
    height: int
    scale_x: float
    scale_y: float

    @classmethod
    def fit(cls, image_size: tuple[int, int], input_size: tuple[int, int]) -> Letterbox:
        """Return the largest letterbox of an image (width, height) in an input (width, height)."""
        scale = min(input_size[0] / image_size[0], input_size[1] / image_size[1])
        box = cls.scaled(image_size, scale)
        width, height = min(input_size[0], box.width), min(input_size[1], box.height)
        return cls(width, height, width / image_size[0], height / image_size[1])

    @classmethod
    def scaled(cls, image_size: tuple[int, int], scale: float) -> Letterbox:
        """Return the letterbox that scales an image of size (width, height) by a factor."""
        width, height = (max(1, round(side * scale)) for side in image_size)
        return cls(width, height, width / image_size[0], height / image_size[1])

    def image(
        self, image: UInt8[np.ndarray, "rows columns 3"]
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Resize an RGB image to ``width`` × ``height``, without padding."""
        if (image.shape[1], image.shape[0]) == (self.width, self.height):
            return image
        # INTER_AREA averages pixels when shrinking but repeats them when enlarging.
        method = cv2.INTER_AREA if self.scale_x < 1 else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(image, (self.width, self.height), interpolation=method))

    def camera(self, K: CameraMatrix) -> CameraMatrix:
        """Return K of the resized image."""
        return resize_camera(K, self.scale_x, self.scale_y)

    def points(self, points_px: Pixels) -> Pixels:
        """Map original pixel coordinates into the resized image."""
        return resize_points(points_px, self.scale_x, self.scale_y)

    def original_points(self, points_px: Pixels) -> Pixels:
        """Map pixel coordinates of the resized image back into the original image."""
        return resize_points(points_px, 1 / self.scale_x, 1 / self.scale_y)


def pinhole_matrix(K: CameraMatrix, source: str) -> CameraMatrix:
    """Return K as float64, with exact zeros and ones; ``source`` names its origin in messages.

    Raises:
        UserError: K is not a finite pinhole matrix.
    """
    try:
        matrix = np.array(K, np.float64)
    except (OverflowError, TypeError, ValueError):
        matrix = np.empty(0)
    # Calibration files have few digits, so zeros and ones are compared with a tolerance.
    fixed = np.array([[np.nan, 0, np.nan], [0, np.nan, np.nan], [0, 0, 1]])
    is_finite = matrix.shape == (3, 3) and bool(np.isfinite(matrix).all())
    if not is_finite or np.nanmax(np.abs(matrix - fixed)) > 1e-6:
        raise UserError(
            f"K {K!r:.200} of {source}",
            "a 3×3 pinhole matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels",
            "pass the K of the camera's calibration",
        )
    return camera_matrix(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])


MIN_VIEW_DEG: Final = 5.0
MAX_VIEW_DEG: Final = 150.0
"""Limits of the field of view along the longer side of a whole image, degrees."""

WHOLE: Final = 0.2
"""Largest offset of a whole image's principal point from the centre, as a share of the side. Real
lenses stay below 0.1; the K of an image half or one and a half times as large is off by 0.25."""

INSIDE: Final = 0.5  # Largest offset for an image that may be a crop, as in some data sets
ANYWHERE: Final = math.inf  # Largest offset for a crop


def check_camera(
    K: CameraMatrix, image_size: tuple[int, int], source: str, off_centre: float = INSIDE
) -> CameraMatrix:
    """Return K as float64 after checking that it is plausible for an image.

    Args:
        K: Camera matrix, pixels.
        image_size: Width and height of the image, pixels.
        source: Origin of K, for messages.
        off_centre: Largest distance of the principal point from the image's centre, as a share of
            the side: ``WHOLE``, ``INSIDE`` or ``ANYWHERE``.

    Raises:
        UserError: K is not a finite pinhole matrix, the principal point is too far from the centre,
            or the field of view is outside 5° – 150° (0° – 150° for ``ANYWHERE``).
    """
    width, height = image_size
    K = pinhole_matrix(K, source)
    x, y = (K[0, 2] + 0.5) / width, (K[1, 2] + 0.5) / height
    views = np.degrees(2 * np.arctan2(max(width, height) / 2, K.diagonal()[:2])).round(1)
    narrowest = MIN_VIEW_DEG if off_centre < ANYWHERE else 0.0
    offset = max(abs(x - 0.5), abs(y - 0.5))
    if offset <= off_centre and narrowest <= views.min() and views.max() <= MAX_VIEW_DEG:
        return K
    problem = (
        f"K with fx={K[0, 0]:.6g}, fy={K[1, 1]:.6g}, cx={K[0, 2]:.6g}, cy={K[1, 2]:.6g} "
        f"for the {width}×{height} image of {source}: principal point at {x:.0%} of its width "
        f"and {y:.0%} of its height, field of view {views.max():.3g}°"
    )
    centre = f"within {0.5 - off_centre:.0%} – {0.5 + off_centre:.0%} of width and height"
    centre = "inside the image" if off_centre == INSIDE else centre
    allowed = "" if off_centre == ANYWHERE else f"a principal point {centre} and "
    allowed += f"a field of view of {narrowest:g}° – {MAX_VIEW_DEG:g}°"
    fix = "pass the K of this image's size (K scales with the image)"
    if off_centre == WHOLE < offset and min(x, y) > 0:
        likely = f"{2 * K[0, 2] + 1:.0f}×{2 * K[1, 2] + 1:.0f}"
        fix += f": this K is likely of {likely} (--K-size); state a crop of the image (--crop)"
    raise UserError(problem, allowed, fix)
