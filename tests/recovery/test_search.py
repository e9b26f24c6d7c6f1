"""Poses that are searched in the belief maps."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from dopepp.geometry.camera import move_pose, orbited_camera, project_keypoints, transform
from dopepp.geometry.rotation import rotation_angle
from dopepp.recovery import recover
from dopepp.recovery.detection import PROBABLE
from dopepp.recovery.search import (
    CENTROID_DEVIATION,
    DEPTH_DEVIATION,
    JOINT_STEP,
    MIN_BELIEF,
    ROTATION_DEVIATION,
    PosedMaps,
    PoseSearch,
    centres_on_ray,
    search_covariance,
)

DEPTHS = (0.45, 0.7)


def distance(T, other):
    """Return the angle between two poses, degrees, and their relative difference of depth."""
    return np.degrees(rotation_angle(T[:3, :3].T @ other[:3, :3])), abs(T[2, 3] / other[2, 3] - 1)


def searched(belief, cuboid, K, centroid, depths):
    """Return the pose that is searched on one image at a centroid."""
    search = PoseSearch([PosedMaps(belief, K, 8, np.eye(4))], cuboid)
    return search.pose(centres_on_ray(centroid, K, depths))


@pytest.mark.parametrize("hidden", [0, 3])
def test_the_pose_is_found_without_peaks(make_scene, box, pose, K, hidden):
    """Also with hidden corners, and with all corners of a neighbour that touches the part."""
    rng = np.random.default_rng(hidden)
    for _ in range(8):
        T, beside = pose(rng, 0.02, -0.01, 0.55), pose(rng, 0.09, -0.01, 0.55)
        own, other = (make_scene(box).place(0, place).maps()[0].numpy() for place in (T, beside))
        own[rng.permutation(8)[:hidden]] = 0.0
        centroid = project_keypoints(box, T, K)[8]
        found = searched(np.maximum(own, other), box, K, centroid, DEPTHS)
        angle, difference = distance(found, T)
        assert angle < 20
        assert difference < 0.12
        assert_allclose(project_keypoints(box, found, K)[8], centroid, atol=1e-6)


def test_maps_without_corners_give_a_pose_at_the_centroid(box, K):
    empty = np.zeros((9, 52, 52), np.float32)
    found = searched(empty, box, K, np.array([90.0, 40.0]), (1, 1))
    assert_allclose(project_keypoints(box, found, K)[8], [90, 40], atol=1e-6)
    assert transform(found, box[8])[2] == pytest.approx(1.0)


def test_two_images_determine_a_pose_together(make_scene, box, pose, K):
    """The first image has one corner, which does not determine the pose alone."""
    rng = np.random.default_rng(3)
    together, alone = [], []
    for _ in range(6):
        T = pose(rng, 0.02, -0.01, 0.55)
        poses = [np.eye(4), orbited_camera(T[:3, 3], math.radians(25), rng.uniform(0, 6))]
        corners, maps = rng.permutation(8), []
        for number, T_cam_world in enumerate(poses):
            belief = make_scene(box).place(0, T_cam_world @ T).maps()[0].numpy()
            shown = [*(corners[:1], corners[1:3])[number], 8]
            belief[np.setdiff1d(np.arange(9), shown)] = 0.0
            maps.append(PosedMaps(belief, K, 8, T_cam_world))
        tried = centres_on_ray(project_keypoints(box, T, K)[8], K, DEPTHS, JOINT_STEP)
        together.append(distance(PoseSearch(maps, box).pose(tried), T))
        alone.append(distance(PoseSearch(maps[:1], box).pose(tried), T))
    angles, differences = np.transpose(together)
    assert angles.max() < 20
    assert differences.max() < 0.05
    assert np.median(np.transpose(alone)[0]) > 40


def test_the_covariance_agrees_with_sampled_poses(K, pose):
    """The part turns about its centroid, which moves along and across the line of sight."""
    rng = np.random.default_rng(0)
    T, cuboid = pose(rng, 0.1, 0.05, 0.5), np.tile([0.02, -0.05, 0.03], (9, 1))
    centre, focal = transform(T, cuboid[8]), 500.0
    turns = rng.normal(0, ROTATION_DEVIATION, (200_000, 3))
    arm = centre - T[:3, 3]
    along = rng.normal(0, DEPTH_DEVIATION * centre[2], (len(turns), 1)) * centre
    across = rng.normal(0, CENTROID_DEVIATION * 8 * centre[2] / focal, turns.shape)
    shifts = along / np.linalg.norm(centre) + across - np.cross(turns, arm)
    sampled = np.cov(np.hstack([turns, shifts]).T)
    scales = np.sqrt(np.outer(sampled.diagonal(), sampled.diagonal()))
    assert_allclose(search_covariance(T, cuboid, focal, 8) / scales, sampled / scales, atol=0.01)
    # To first order, a turn alone leaves the centroid in place.
    turned = move_pose(T, np.array([1e-4, -2e-4, 1e-4, *-np.cross([1e-4, -2e-4, 1e-4], arm)]))
    assert_allclose(transform(turned, cuboid[8]), centre, atol=1e-8)


@pytest.fixture
def scene(make_scene, box, pose):
    """A part with all corners, and a part with four of eight."""
    rng = np.random.default_rng(5)
    scene = make_scene(box).place(0, pose(rng, -0.1, 0.0, 0.55)).place(0, pose(rng, 0.1, 0.0, 0.55))
    belief, field = scene.maps()
    belief[:4, :, 26:] = 0.0
    return scene, belief, field


def test_only_uncertain_instances_have_an_alternative(scene):
    scene, belief, field = scene
    belief[4, :, 26:] = 0.0
    maps = belief, field, scene.cuboids, scene.K
    certain, uncertain = recover(*maps, depths=[DEPTHS], min_score=0.0)
    assert certain.score > 0.9
    assert certain.alternative is None
    assert uncertain.score < PROBABLE
    found = uncertain.alternative
    assert found.score == found.belief < PROBABLE
    angle, difference = distance(found.T_cam_obj, scene.poses[1])
    assert angle < 20
    assert difference < 0.1
    measured = np.isfinite(found.peaks).all(axis=1)
    assert measured[5:].all()
    errors = (found.peaks - found.keypoints)[measured]
    assert found.reprojection_error_px == pytest.approx(np.sqrt((errors**2).sum(1).mean()))


def test_no_pose_is_searched_at_a_weak_centroid(scene):
    scene, belief, field = scene
    belief[:5, :, 26:] = 0.0
    belief[8] *= MIN_BELIEF - 0.02
    weak = recover(belief, field, scene.cuboids, scene.K, depths=[DEPTHS], min_score=0.0)
    assert [found.alternative for found in weak] == [None, None]


def test_an_instance_without_a_pose_gets_the_searched_pose(scene):
    scene, belief, field = scene
    belief[:6, :, 26:] = 0.0
    maps = belief, field, scene.cuboids, scene.K
    assert len(recover(*maps, min_score=0.0)) == 1
    _, found = recover(*maps, depths=[DEPTHS], min_score=0.0)
    assert found.alternative is None
    assert found.T_cam_obj[0, 3] > 0


def test_without_depths_nothing_is_searched(scene):
    scene, belief, field = scene
    maps = belief, field, scene.cuboids, scene.K
    plain, searched, none = (
        recover(*maps, depths=depths, min_score=0.0) for depths in (None, [DEPTHS], [None])
    )
    assert len(plain) == 2
    for one, two, three in zip(plain, searched, none, strict=True):
        assert one.alternative is three.alternative is None
        for other in (replace(two, alternative=None), three):
            assert other.T_cam_obj.tobytes() == one.T_cam_obj.tobytes()
            assert other.score == one.score
