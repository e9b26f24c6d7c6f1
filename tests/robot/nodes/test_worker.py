"""The worker of a node: the estimator's poses, and one warning for each kind of problem."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.geometry.camera_file import Camera
from dopepp.robot.nodes.worker import PATIENCE, Shot, Worker, WorkerSettings
from tests.robot.nodes.conftest import LENS, header


@pytest.fixture
def worker(estimator, warnings):
    return Worker(estimator)


@pytest.fixture
def take(worker, camera, messages):
    """Return a function that processes an image, with changed fields of its camera_info."""

    def take(
        number=0, second=1.0, frame=messages.frame, info=True, topic=messages.topic, **changes
    ):
        camera_info = messages.info(camera.K, (320, 240), **changes) if info else None
        image = messages.image(camera.images[number], second, frame)
        return worker.process(Shot(image, camera_info, topic))

    return take


def test_poses_are_those_of_the_undistorted_image(worker, take, estimator, camera, warnings):
    answer = take(second=12.25)
    undistorted = cv2.undistort(camera.images[0], camera.K, np.array(LENS))
    expected = estimator.predict(undistorted, camera.K)
    assert expected
    for detection, other in zip(answer.result.detections, expected, strict=True):
        np.testing.assert_allclose(detection.T_cam_obj, other.T_cam_obj, atol=1e-9)
    assert (answer.stamp, answer.frame_id) == (12_250_000_000, "camera_optical_frame")
    assert (warnings, worker.problem) == ([], "")


@pytest.mark.parametrize(
    ("changes", "problem", "fix"),
    [
        ({"k": [0.0] * 9}, "K is all zeros", "dopepp calibrate camera"),
        ({"width": 640, "height": 480}, "640×480, and images of 320×240", "camera_info of these"),
        ({"distortion_model": "equidistant"}, "equidistant", "undistort"),
        ({"d": [0.1] * 3}, "3 distortion coefficients", "zeros"),
        ({"k": [float("nan")] * 9}, "K=nan", "fix"),
        ({"k": "abc"}, "camera_info of", ""),
    ],
)
def test_a_wrong_camera_is_one_warning(take, worker, warnings, changes, problem, fix):
    assert [take(**changes) for _ in range(3)] == [None] * 3
    (line,) = warnings
    assert problem in line
    assert fix in line
    assert "\n" not in line
    assert worker.problem == line
    assert take() is not None
    assert worker.problem == ""


def test_several_images_without_camera_info_are_one_warning(take, warnings):
    assert [take(info=False) for _ in range(PATIENCE - 1)] == [None] * (PATIENCE - 1)
    assert not warnings
    for _ in range(5):
        take(info=False)
    (line,) = warnings
    assert "--camera camera.yaml" in line


def test_a_given_camera_replaces_camera_info(estimator, camera, messages, warnings):
    worker = Worker(estimator, camera=Camera(None, camera.K, (), "--K"))
    answer = worker.process(Shot(messages.image(camera.images[0], 1), None, messages.topic))
    result, expected = answer.result.detections, estimator.predict(camera.images[0], camera.K)
    np.testing.assert_allclose(result[0].T_cam_obj, expected[0].T_cam_obj, atol=1e-9)
    assert not warnings


def test_coefficients_for_rectified_images_are_one_warning(estimator, camera, messages, warnings):
    rectified = "/camera/image_rect"
    worker = Worker(estimator, camera=Camera((320, 240), camera.K, (-0.05, 0.01, 0, 0), "a file"))
    for second in (1.0, 1.1):
        assert (
            worker.process(Shot(messages.image(camera.images[0], second), None, rectified)) is None
        )
    assert len(warnings) == 1
    assert "got a file with distortion coefficients for the rectified images" in warnings[0]
    worker = Worker(estimator, camera=Camera((320, 240), camera.K, (), "a file"))
    assert worker.process(Shot(messages.image(camera.images[0], 1.0), None, rectified)) is not None


def test_decreasing_stamps_are_one_warning(take, warnings):
    for second in (5, 6, 2, 3, 1):
        assert take(second=second) is not None
    (line,) = warnings
    assert "went back by 4.000 s" in line


@pytest.mark.parametrize(
    ("frame", "beside", "line"),
    [
        ("camera_link", "camera_link", "'camera_link', which is not named as an optical frame"),
        ("", "", "frame '', which"),
        ("left_optical_frame", "right_optical_frame", "their camera_info in 'right_optical_frame'"),
        ("left_optical_frame", "", None),
    ],
)
def test_a_frame_that_is_not_optical_is_one_warning_and_is_used(
    take, messages, warnings, frame, beside, line
):
    for _ in range(2):
        assert take(frame=frame, header=header(1, beside)).frame_id == frame
    assert len(warnings) == (line is not None)
    assert line is None or line in warnings[0]


def test_a_missing_stamp_and_unreadable_images_are_warnings(
    worker, take, messages, camera, warnings
):
    assert take(second=0) is not None
    image, info = messages.image(camera.images[0], 1), messages.info(camera.K, (320, 240))
    for change in ({"encoding": "16UC1"}, {"data": b"12"}, {"height": 10**9}):
        changed = SimpleNamespace(**vars(image) | change)
        assert worker.process(Shot(changed, info, messages.topic)) is None
    without_stamp, unreadable = warnings
    assert "without a stamp" in without_stamp
    assert "16UC1" in unreadable


def test_binning_and_region_of_interest_change_the_camera(worker, estimator, camera, messages):
    """The sensor has twice the resolution, and the driver reads the region from (40, 20)."""
    K = np.diag([2.0, 2.0, 1.0]) @ camera.K
    K[:2, 2] += 0.5  # pixel (0, 0) is the centre of the top-left pixel
    K[:2, 2] += (40, 20)
    roi = SimpleNamespace(x_offset=40, y_offset=20, width=640, height=480)
    info = messages.info(K, (800, 600), d=[0.0] * 5, roi=roi, binning_x=2, binning_y=2)
    answer = worker.process(Shot(messages.image(camera.images[0], 1), info, messages.topic))
    np.testing.assert_allclose(answer.result.K, camera.K, atol=1e-9)
    expected = estimator.predict(camera.images[0], camera.K)[0]
    np.testing.assert_allclose(answer.result.detections[0].T_cam_obj, expected.T_cam_obj, atol=1e-6)


def test_a_projection_matrix_of_wrong_length_is_one_warning(take, warnings):
    assert take(topic="/camera/image_rect", p=[1.0] * 9) is None
    assert len(warnings) == 1


def test_settings_change_while_the_node_runs(worker, take):
    plain = take().result.detections[0]
    worker.update(replace(worker.settings, refine=True))
    refined = take().result.detections[0]
    assert refined.agreement is not None
    assert plain.agreement is None
    worker.update(WorkerSettings(confidence=1.0))
    empty = take().result
    assert (empty.detections, empty.num_weaker, empty.min_score) == ([], 1, 1.0)
    with pytest.raises(UserError, match="confidence=3"):
        WorkerSettings(confidence=3)


def test_tracked_parts_keep_their_numbers(estimator, camera, messages, warnings):
    tracking = Worker(estimator, WorkerSettings(refine=True), track=True)
    info = messages.info(camera.K, (320, 240), d=[0.0] * 5)
    for second in (1, 2, 3):
        shot = Shot(messages.image(camera.images[0], second), info, messages.topic)
        assert tracking.process(shot).numbers == [0]
    with pytest.raises(UserError, match="--track"):
        tracking.update(WorkerSettings(refine=False))
    assert not warnings
