"""Transformed images of a scene, with transformed K, yield the same metric pose."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dopepp import PoseEstimator
from dopepp.geometry.camera import project_keypoints
from dopepp.geometry.rotation import rotation_angle
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual import PRESETS, Factory, render

MOST_MM, MOST_DEG = 1.0, 0.4
AROUND_PX = 40
LENS = np.array([-0.18, 0.06, 0.0015, -0.001, 0.01])
"""Distortion coefficients: up to 40 pixels at the corners of the whole image."""


@dataclass(frozen=True)
class View:
    """Transformations of the image, in this order.

    Attributes:
        cut: Shares of width and height that are cropped left, above, right and below, but never
            the part and the pixels around it.
        scale: Scale factor; the size is rounded to whole pixels, so that fx and fy differ.
        turns: Number of quarter turns, anticlockwise.
        lens: Whether lens distortion is applied.
        flipped: Whether the channels are reversed in memory, as in ``bgr[..., ::-1]``.
    """

    cut: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    scale: float = 1.0
    turns: int = 0
    lens: bool = False
    flipped: bool = False


VGA = View(cut=(1 / 8, 0.0, 1 / 8, 0.0), scale=4 / 9)
PORTRAIT = View(cut=(0.35, 0.0, 0.35, 0.0))
CUTS = st.tuples(*[st.floats(0.0, 0.5)] * 4)
VIEWS = st.builds(View, CUTS, st.floats(0.4, 1.0), st.integers(0, 3), st.booleans(), st.booleans())


@pytest.fixture(scope="module")
def scene():
    return Factory([pivconnector()], PRESETS["wide"].reframed(1920, 1080), seed=4).scene(0, 0)


@pytest.fixture(scope="module")
def photo(scene):
    return render(scene).image


@pytest.fixture(scope="module")
def estimator():
    return PoseEstimator.load("pretrained/pivconnector_wide", refine="region", scale_error=1e-4)


@pytest.fixture(scope="module")
def whole_pose(estimator, scene, photo):
    """The pose on the whole image."""
    (detection,) = estimator.predict(photo, scene.K)
    assert not detection.kept
    return detection.T_cam_obj


@settings(max_examples=8, derandomize=True, database=None)
@given(VIEWS)
@example(VGA)
@example(PORTRAIT)
@example(View(turns=1))
@example(View(lens=True))
@example(View(scale=1 / 3, lens=True, flipped=True))
def test_pose_is_the_same_in_every_view(estimator, scene, photo, whole_pose, view):
    keypoints = project_keypoints(pivconnector().cuboid, whole_pose, scene.K)
    image, K = transform_image(view, photo, scene.K, keypoints)
    assert view is not VGA or image.shape == (480, 640, 3)
    detections = estimator.predict(image, K, LENS if view.lens else None, cropped=True)
    assert detections, "nothing found"
    back = np.eye(4)
    back[:3, :3] = quarter_turn(-view.turns)
    T = back @ detections[0].T_cam_obj
    assert 1000 * np.linalg.norm(T[:3, 3] - whole_pose[:3, 3]) < MOST_MM
    assert math.degrees(rotation_angle(T[:3, :3] @ whole_pose[:3, :3].T)) < MOST_DEG


def transform_image(view, image, K, keypoints):
    """Return the image of a view and its K, by formulas independent of the package."""
    limit = np.array(image.shape[1::-1])
    lower, upper = keypoints.min(0) - AROUND_PX, keypoints.max(0) + AROUND_PX
    left, top = np.clip(np.minimum(view.cut[:2] * limit, lower), 0, limit).astype(int)
    right, bottom = np.clip(limit - np.minimum(view.cut[2:] * limit, limit - upper), 0, limit)
    right, bottom = math.ceil(right), math.ceil(bottom)
    image = image[top:bottom, left:right]
    (width, height), K = (right - left, bottom - top), K - [[0, 0, left], [0, 0, top], [0, 0, 0]]
    columns, rows = round(view.scale * width), round(view.scale * height)
    image = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA)
    # Pixel corners, at halves, stay corners.
    corner = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    K = np.linalg.inv(corner) @ np.diag([columns / width, rows / height, 1]) @ corner @ K
    for _ in range(view.turns):
        # Anticlockwise, (u, v) goes to (v, columns − 1 − u).
        columns = image.shape[1]
        turned = np.array([[0, 1, 0], [-1, 0, columns - 1], [0, 0, 1.0]])
        K = turned @ K @ quarter_turn(-1)
        image = np.rot90(image)
    if view.lens:
        image = distort(image, K)
    if view.flipped:
        image = np.ascontiguousarray(image[..., ::-1])[..., ::-1]
    return image, K


def quarter_turn(turns):
    """Return the rotation of the camera's axes for anticlockwise quarter turns of the image."""
    once = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    return np.linalg.matrix_power(once, turns % 4)


def distort(image, K):
    """Return an image distorted by LENS: sample each pixel at its undistorted position."""
    rows, columns = image.shape[:2]
    pixels = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(pixels.astype(np.float64), K, LENS, P=K)
    at = straight.reshape(rows, columns, 2).astype(np.float32)
    return cv2.remap(np.ascontiguousarray(image), at[..., 0], at[..., 1], cv2.INTER_LINEAR)
