"""Poses from several pictures of one static scene."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from dopepp import PoseEstimator
from dopepp.geometry.camera import invert_transform, make_transform
from dopepp.geometry.rotation import rotation_angle, rotation_vector_to_matrix
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual import PRESETS, Factory, render
from dopepp.virtual.sensor import capture

SEED, SCENE = 4177, 0
ANGLE = math.radians(25.0)


def beside(target: np.ndarray, axis: tuple[float, float, float]) -> np.ndarray:
    """Return T_new_cam of a camera that looks at a target from 25° beside it."""
    turn = rotation_vector_to_matrix(ANGLE * np.array(axis))
    return make_transform(turn, target[:3, 3] - turn @ target[:3, 3])


@pytest.fixture(scope="module")
def estimator():
    return PoseEstimator.load("pretrained/pivconnector_wide", refine="region")


@pytest.fixture(scope="module")
def scene():
    return Factory([pivconnector()], PRESETS["wide"].reframed(640, 480), SEED).scene(0, SCENE)


@pytest.fixture(scope="module")
def true(scene):
    return scene.objects[scene.targets[0]].T_cam_obj


@pytest.fixture(scope="module")
def views(scene, true):
    """Pictures from three cameras, with the poses of the cameras in the frame of the first."""
    poses = [np.eye(4), beside(true, (0.0, 1.0, 0.0)), beside(true, (1.0, 0.0, 0.0))]
    images = []
    for T_new_cam in poses:
        seen = scene.seen_from(T_new_cam)
        images.append(capture(render(seen).image, seen.sensor))
    return images, [invert_transform(T) for T in poses]


def errors(T: np.ndarray, true: np.ndarray) -> tuple[float, float, float]:
    """Return degrees, and millimetres along and across the first camera's line of sight."""
    ray = true[:3, 3] / np.linalg.norm(true[:3, 3])
    shift = 1e3 * (T[:3, 3] - true[:3, 3])
    along = float(shift @ ray)
    turn = math.degrees(float(rotation_angle(T[:3, :3] @ true[:3, :3].T)))
    return turn, abs(along), float(np.linalg.norm(shift - along * ray))


def test_a_second_view_fixes_the_distance(estimator, scene, views, true):
    images, poses = views
    (alone,) = estimator.predict(images[0], scene.K)
    before = errors(alone.T_cam_obj, true)
    for count in (2, 3):
        result = estimator.predict_views(images[:count], [scene.K] * count, poses[:count])
        (detection,) = result.detections
        turn, along, across = errors(detection.T_world_obj, true)
        assert along < 0.3 < 0.5 < before[1]
        assert across < 0.3
        assert turn < 0.4
        assert not result.findings
        assert detection.views == [f"view {number}" for number in range(count)]
        assert detection.probability > 0.95
        for view, item in zip(result.views, detection.evidence, strict=True):
            assert view.detections == [item.detection]


def test_the_world_is_any_frame(estimator, scene, views):
    images, poses = views
    T_other_world = make_transform(
        rotation_vector_to_matrix(np.array([0.4, -1.2, 2.0])), np.array([1.0, -2.0, 0.5])
    )
    cameras = [scene.K] * 2
    (detection,) = estimator.predict_views(images[:2], cameras, poses[:2]).detections
    elsewhere = [T_other_world @ T for T in poses[:2]]
    (other,) = estimator.predict_views(images[:2], cameras, elsewhere).detections
    assert_allclose(other.T_world_obj, T_other_world @ detection.T_world_obj, atol=1e-6)
    turn = np.kron(np.eye(2), T_other_world[:3, :3])
    expected = turn @ detection.covariance @ turn.T
    assert_allclose(other.covariance, expected, atol=1e-4 * np.abs(expected).max())
