"""Poses from several images of one static scene."""

import copy
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from dopepp.core.errors import UserError
from dopepp.geometry.camera import invert_transform, make_transform, move_pose, resize_camera
from dopepp.geometry.camera_file import Camera
from dopepp.geometry.cuboid import CENTROID
from dopepp.geometry.rotation import rotation_angle, rotation_vector_to_matrix
from dopepp.inference.several_views.joint_search import JointSearch
from dopepp.virtual import render
from dopepp.virtual.sensor import capture


def beside(target, axis):
    """Return T_new_cam of a camera that looks at a target from 25° beside it."""
    turn = rotation_vector_to_matrix(math.radians(25.0) * np.array(axis))
    return make_transform(turn, target[:3, 3] - turn @ target[:3, 3])


def photographed(scene, T_new_cam):
    shown = scene.seen_from(T_new_cam)
    return capture(render(shown).image, shown.sensor)


@pytest.fixture(scope="module")
def true(scene):
    return scene.objects[scene.targets[0]].T_cam_obj


@pytest.fixture(scope="module")
def views(scene, true):
    """Images from three cameras, with the poses of the cameras in the frame of the first."""
    poses = [np.eye(4), beside(true, (0.0, 1.0, 0.0)), beside(true, (1.0, 0.0, 0.0))]
    return [photographed(scene, T) for T in poses], [invert_transform(T) for T in poses]


def errors(T, true):
    """Return degrees, and millimetres along and across the first camera's line of sight."""
    ray = true[:3, 3] / np.linalg.norm(true[:3, 3])
    shift = 1e3 * (T[:3, 3] - true[:3, 3])
    along = shift @ ray
    turn = math.degrees(rotation_angle(T[:3, :3] @ true[:3, :3].T))
    return turn, abs(along), np.linalg.norm(shift - along * ray)


@pytest.fixture(scope="module")
def alone(estimator, scene, views):
    """The detection in the first view."""
    (detection,) = estimator.predict(views[0][0], scene.K)
    return detection


@pytest.fixture(scope="module")
def pair(estimator, scene, views):
    """The result of the first two views."""
    return predicted(estimator, scene, views)


def test_second_view_determines_the_distance(estimator, scene, views, true, alone, pair):
    ray = true[:3, 3] / np.linalg.norm(true[:3, 3])
    variance_alone = float(ray @ alone.covariance[3:, 3:] @ ray)
    for count, result in ((2, pair), (3, predicted(estimator, scene, views, (0, 1, 2)))):
        (detection,) = result.detections
        assert (np.array(errors(detection.T_world_obj, true)) < (0.4, 0.5, 0.3)).all()
        assert ray @ detection.covariance[3:, 3:] @ ray < 0.7 * variance_alone
        assert not result.findings
        assert detection.views == [f"view {number}" for number in range(count)]
        assert detection.probability > 0.95
        for view, item in zip(result.views, detection.evidence, strict=True):
            assert view.detections == [item.detection]


def test_world_may_be_any_frame(estimator, scene, views, pair):
    T_other_world = move_pose(np.eye(4), np.array([0.4, -1.2, 2.0, 1.0, -2.0, 0.5]))
    (detection,) = pair.detections
    elsewhere = [T_other_world @ T for T in views[1][:2]]
    (other,) = predicted(estimator, scene, views, poses=elsewhere).detections
    assert_allclose(other.T_world_obj, T_other_world @ detection.T_world_obj, atol=1e-6)
    turn = np.kron(np.eye(2), T_other_world[:3, :3])
    expected = turn @ detection.covariance @ turn.T
    assert_allclose(other.covariance, expected, atol=1e-4 * np.abs(expected).max())


def volume(result):
    """Return the logarithm of the determinant of the only pose's covariance."""
    (detection,) = result.detections
    return np.linalg.slogdet(detection.covariance)[1]


def predicted(estimator, scene, views, order=(0, 1), **changes):
    """Predict on some of the images, with other images or camera poses."""
    images, poses = views
    given = {
        "images": [images[n] for n in order], "cameras": [scene.K] * len(order),
        "poses": [poses[n] for n in order], "names": None,
    } | changes  # fmt: skip
    arguments = given["images"], given["cameras"], given["poses"]
    return estimator.predict_views(*arguments, names=given["names"])


def shifted(T, x=0.0, y=0.0, z=0.0):
    """Return a pose after a shift, metres."""
    return move_pose(T, np.array([0, 0, 0, x, y, z]))


@pytest.mark.parametrize(("axis", "millimetres"), [("x", 15), ("y", 8), ("x", 50), ("z", 50)])
def test_wrong_camera_pose_is_reported(estimator, scene, views, axis, millimetres):
    _, poses = views
    wrong = shifted(poses[1], **{axis: 1e-3 * millimetres})
    result = predicted(estimator, scene, views, poses=[poses[0], wrong], names=["a", "b"])
    assert result.detections == []
    assert {tuple(item.views) for item in result.weaker} >= {("a",), ("b",)}
    (finding,) = result.findings
    assert "a camera pose is wrong, or the part was moved" in finding
    apart = float(finding.split("pivconnector ")[1].split(" mm")[0])
    assert apart == pytest.approx(millimetres, abs=3)


def test_disagreeing_views_are_reported(estimator, scene, views, pair):
    """An error along the baseline changes the distance only, and a consistent pose remains."""
    _, poses = views
    result = predicted(estimator, scene, views, poses=[poses[0], shifted(poses[1], x=0.004)])
    (finding,) = result.findings
    assert "view 0 and view 1 disagree on pivconnector" in finding
    assert volume(result) > volume(pair)


def test_third_view_identifies_the_wrong_camera(estimator, scene, views):
    _, poses = views
    wrong = shifted(poses[1], 0.05, 0.05, 0.05)
    three = predicted(estimator, scene, views, (0, 1, 2), poses=[poses[0], wrong, poses[2]])
    assert [detection.views for detection in three.detections] == [["view 0", "view 2"]]
    assert all("the camera pose of view 1 is wrong" in finding for finding in three.findings)
    assert three.findings


def test_swapped_views_are_reported(estimator, scene, views):
    _, poses = views
    result = predicted(estimator, scene, views, poses=[poses[1], poses[0]])
    assert result.detections == []
    assert "camera poses of view 0 and view 1 are swapped" in result.findings[0]


def test_moved_part_is_not_averaged(estimator, scene, views, true):
    images, poses = views
    moved = (replace(o, T_cam_obj=shifted(o.T_cam_obj, y=0.02, z=0.01)) for o in scene.objects)
    after = photographed(replace(scene, objects=tuple(moved)), invert_transform(poses[1]))
    result = predicted(estimator, scene, views, images=[images[0], after])
    assert result.detections == []
    assert "the part was moved between the images" in result.findings[0]


def test_time_limit_keeps_the_poses_of_the_network(estimator, scene, views):
    limited = copy.copy(estimator)
    limited.max_ms = 0.0
    result = predicted(limited, scene, views)
    shown = [detection for view in result.views for detection in view.detections]
    assert {detection.kept for detection in shown} <= {"", "max_ms=0 was spent"}
    assert result.detections or result.weaker


def test_part_in_one_view_keeps_its_single_view_pose(estimator, scene, views, alone):
    images, _ = views
    empty = np.full_like(images[1], 90)
    result = predicted(estimator, scene, views, images=[images[0], empty])
    (detection,) = result.detections
    assert not result.findings
    assert [item.status for item in detection.evidence] == ["supports", "hidden"]
    assert_allclose(detection.T_world_obj, alone.T_cam_obj, atol=1e-9)
    added = detection.covariance - alone.covariance  # the errors of the camera's pose
    assert np.linalg.eigvalsh(added).min() > 0
    assert np.sqrt(np.diag(added)).max() < 1e-3
    away = views[1][1].copy()
    away[:3, :3] = -away[:3, :3] @ np.diag([1.0, -1.0, 1.0])  # turned away from the scene
    result = predicted(estimator, scene, views, images=[images[0], empty], poses=[np.eye(4), away])
    assert [item.status for item in result.detections[0].evidence] == ["supports", "outside"]
    assert result.detections[0].score == pytest.approx(alone.score, abs=1e-6)


def test_weak_detection_does_not_support_an_improbable_pose(estimator, scene, views, monkeypatch):
    """A detection that is improbable itself does not lower its view's limits of support."""
    verified = estimator.refiner.verified

    def improbable_in_the_second_view(detection, image, K, moved=0.0):
        detection = verified(detection, image, K, moved)
        is_second = np.array_equal(image, views[0][1])
        return replace(detection, probability=0.03) if is_second else detection

    monkeypatch.setattr(estimator.refiner, "verified", improbable_in_the_second_view)
    (detection,) = predicted(estimator, scene, views).detections
    assert detection.views == ["view 0"]


def test_unrefined_detection_does_not_overrule_the_other_views(
    estimator, scene, views, true, monkeypatch
):
    candidates_from, calls = estimator.candidates_from, []

    def with_a_wrong_second_view(*given):
        detections = candidates_from(*given)
        calls.append(len(detections))
        if len(calls) < 2:
            return detections
        covariance = np.diag(np.repeat([math.radians(5.0), 0.005], 3) ** 2)
        wrong = shifted(detections[0].T_cam_obj, x=0.04)  # 8 σ
        unrefined = {
            "T_cam_obj": wrong, "covariance": covariance, "start": (wrong, covariance),
            "kept": "wrong", "agreement": None, "support": None, "score": 0.01, "probability": 0.05,
        }  # fmt: skip
        return [replace(detections[0], **unrefined)]

    monkeypatch.setattr(estimator, "candidates_from", with_a_wrong_second_view)
    result = predicted(estimator, scene, views)
    assert len(calls) == 2
    (detection,) = result.detections
    assert detection.views == ["view 0", "view 1"]
    assert max(errors(detection.T_world_obj, true)) < 0.5
    assert not result.findings


def test_wrong_poses_are_replaced_by_a_search_in_all_views(
    estimator, scene, views, true, monkeypatch
):
    """Both detections have a wrong rotation, and only their centroids are right."""
    candidates_from, cuboid = estimator.candidates_from, estimator.cuboids[0]
    turn = rotation_vector_to_matrix(np.array([0.0, 2.0, 0.0]))
    wrong_poses = []

    def turned(*given):
        detection = candidates_from(*given)[0]
        T = detection.T_cam_obj
        centroid = T[:3, :3] @ cuboid[CENTROID] + T[:3, 3]
        rotation = T[:3, :3] @ turn
        wrong = make_transform(rotation, centroid - rotation @ cuboid[CENTROID])
        wrong_poses.append(wrong)
        return [replace(detection, T_cam_obj=wrong, score=0.01, probability=0.01)]

    monkeypatch.setattr(estimator, "candidates_from", turned)
    result = predicted(estimator, scene, views)
    (detection,) = result.detections
    assert len(wrong_poses) == 2
    assert errors(wrong_poses[0], true)[0] > 90
    assert max(errors(detection.T_world_obj, true)) < 0.5
    assert detection.views == ["view 0", "view 1"]
    assert not result.findings


def test_a_probable_pose_needs_no_search(estimator, scene, views, monkeypatch):
    def refuse(*_):
        raise AssertionError("a pose was searched")

    monkeypatch.setattr(JointSearch, "__call__", refuse)
    assert predicted(estimator, scene, views).detections


def test_views_may_have_different_sizes_and_lenses(estimator, scene, views, true):
    images, _ = views
    half = cv2.resize(images[1], (320, 240), interpolation=cv2.INTER_AREA)
    cameras = [scene.K, Camera((320, 240), resize_camera(scene.K, 0.5, 0.5), (), "half")]
    result = predicted(estimator, scene, views, images=[images[0], half], cameras=cameras)
    _, along, across = errors(result.detections[0].T_world_obj, true)
    assert result.detections[0].views == ["view 0", "view 1"]
    assert max(along, across) < 0.6


def test_depth_images_are_used(estimator, scene, views, true):
    images, poses = views
    depths = np.stack([render(scene.seen_from(invert_transform(T))).depth for T in poses[:2]])
    both = estimator.refining(("region", "depth"))
    given = images[:2], [scene.K] * 2, poses[:2]
    without, result = both.predict_views(*given), both.predict_views(*given, depths=depths)
    (detection,) = result.detections
    assert (np.array(errors(detection.T_world_obj, true)) < (0.4, 0.3, 0.3)).all()
    assert volume(result) < volume(without)
    assert detection.views == ["view 0", "view 1"]


def test_wrong_arguments_are_rejected(estimator, scene, views):
    _, poses = views
    with pytest.raises(UserError, match="1 T_world_cam for 2 images"):
        predicted(estimator, scene, views, poses=poses[:1])
    with pytest.raises(UserError, match="T_world_cam of view 1"):
        predicted(estimator, scene, views, poses=[poses[0], 2 * poses[1]])
    with pytest.raises(UserError, match="refine='region'"):
        estimator.refining(None).predict_views([], [], [])
