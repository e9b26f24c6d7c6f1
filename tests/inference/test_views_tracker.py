"""Tracking in the world through the images of several cameras, compared with single sets."""

import math
import time
from dataclasses import replace

import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.geometry.camera import invert_transform, move_pose, orbited_camera, step_between
from dopepp.inference.several_views.views_tracker import ViewsTracker
from dopepp.virtual import render
from dopepp.virtual.sensor import capture

NUM_SETS, PAUSE = 10, 3  # the part rests in the first sets
STEP = np.array([0.0, 0.0, math.radians(2.0), 0.002, 0.0, 0.001])  # motion per set, world axes
T_WORLD = move_pose(np.eye(4), np.array([0.4, -1.2, 2.0, 1.0, -2.0, 0.5]))
BLACK = np.zeros((480, 640, 3), np.uint8)


@pytest.fixture(scope="module")
def poses(scene):
    """Poses of two fixed cameras in the world."""
    target = scene.objects[scene.targets[0]].T_cam_obj[:3, 3]
    return [T_WORLD, T_WORLD @ invert_transform(orbited_camera(target, math.radians(25), 0.3))]


@pytest.fixture(scope="module")
def sets(scene, poses):
    """Images of each set with the true pose of the part in the world."""
    objects, target, rendered = list(scene.objects), scene.targets[0], []
    T = T_WORLD @ objects[target].T_cam_obj
    for number in range(NUM_SETS):
        T = T if number < PAUSE else move_pose(T, STEP)
        objects[target] = replace(objects[target], T_cam_obj=invert_transform(T_WORLD) @ T)
        moved = replace(scene, objects=tuple(objects))
        images = []
        for pose in poses:
            view = moved.seen_from(invert_transform(pose) @ T_WORLD)
            images.append(capture(render(view).image, replace(view.sensor, noise_seed=number)))
        rendered.append((images, T))
    return rendered


def error(T, true):
    """Return the error of a pose: degrees, and millimetres."""
    step = step_between(T, true)
    return math.degrees(np.linalg.norm(step[:3])), 1e3 * np.linalg.norm(step[3:])


def test_tracking_is_as_accurate_as_single_sets_in_less_time(estimator, scene, poses, sets):
    tracker, cameras, runs = ViewsTracker(estimator), [scene.K] * 2, []
    errors, seconds = {"tracked": [], "single": []}, {"tracked": 0.0, "single": 0.0}
    calls = {"tracked": tracker.track, "single": estimator.predict_views}
    for number, (images, true) in enumerate(sets):
        for name, call in calls.items():
            network, start = estimator.spent_ms["network"], time.process_time()
            result = call(images, cameras, poses)
            if number:  # the first set is searched by both
                seconds[name] += time.process_time() - start
            (detection,) = result.detections
            errors[name].append(error(detection.T_world_obj, true))
            if name == "tracked":
                runs.append(estimator.spent_ms["network"] > network)
                tracked = result
                identities = [result.identities, *(view.identities for view in result.views)]
                assert identities == [[0]] * 3
                assert result.records()[0]["identity"] == 0
                assert detection.views == ["view 0", "view 1"]
                step = step_between(detection.T_world_obj, true)
                surprise = step @ np.linalg.solve(detection.covariance, step)
                assert surprise < 22.5  # 99.9 % quantile of χ² with six degrees of freedom
    assert runs == [True] + [False] * (NUM_SETS - 1)
    means = {name: np.mean(values, axis=0) for name, values in errors.items()}
    assert (means["tracked"] <= means["single"] + (0.05, 0.05)).all(), means
    assert seconds["tracked"] < 0.5 * seconds["single"]
    np.testing.assert_allclose(tracked.velocities[0][3:], STEP[3:], atol=5e-4)
    np.testing.assert_allclose(tracked.velocities[0][:3], STEP[:3], atol=math.radians(0.5))


def test_occluded_view_is_ignored_and_a_lost_part_keeps_its_identity(estimator, scene, poses, sets):
    tracker, cameras = ViewsTracker(estimator), [scene.K] * 2
    images = [images for images, _ in sets[:PAUSE]]
    assert tracker.track(images[0], cameras, poses).identities == [0]
    result = tracker.track([BLACK, images[1][1]], cameras, poses)
    (detection,) = result.detections
    assert detection.views == ["view 1"]
    assert [item.status for item in detection.evidence] == ["hidden", "supports"]
    assert max(error(detection.T_world_obj, sets[1][1])) < 1.5  # along the line of sight
    assert tracker.track([BLACK, BLACK], cameras, poses).detections == []
    assert tracker.track(images[2], cameras, poses).identities == [0]


def test_part_is_tracked_by_moving_cameras(estimator, scene, poses, sets):
    """The part rests in the world, and the cameras exchange their places."""
    tracker, cameras = ViewsTracker(estimator), [scene.K] * 2
    (images, true), (later, _) = sets[:2]
    tracker.track(images, cameras, poses)
    before = estimator.spent_ms["network"]
    (detection,) = tracker.track(later[::-1], cameras, poses[::-1]).detections
    assert estimator.spent_ms["network"] == before
    assert max(error(detection.T_world_obj, true)) < 0.5


def test_wrong_sets_are_rejected(estimator, scene, poses, sets):
    tracker, images = ViewsTracker(estimator), sets[0][0]
    tracker.track(images, [scene.K] * 2, poses)
    with pytest.raises(UserError, match="1 images after sets of 2"):
        tracker.track(images[:1], [scene.K], poses[:1])
    with pytest.raises(UserError, match="1 T_world_cam for 2 images"):
        tracker.track(images, [scene.K] * 2, poses[:1])
    with pytest.raises(UserError, match="refine='region'"):
        ViewsTracker(estimator.refining(None))
