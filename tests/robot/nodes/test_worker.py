"""What a node makes of images: the estimator's poses, and one warning for each problem."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.geometry.camera_file import Camera
from dopepp.robot.nodes.worker import PATIENCE, Stamp, Worker, WorkerSettings


@pytest.fixture
def said():
    return []


@pytest.fixture
def worker(estimator, said):
    return Worker(estimator, warn=said.append)


@pytest.fixture
def take(worker, seen, messages):
    """Hand an image to the worker as messages, spoilt as is said."""

    def take(
        number=0, second=1.0, frame=messages.frame, info=True, topic=messages.topic, **changes
    ):
        beside = messages.info(seen.K, (320, 240), **changes) if info else None
        return worker.process(messages.image(seen.pictures[number], second, frame), beside, topic)

    return take


def test_poses_are_the_estimators_on_the_picture_without_distortion(
    worker, take, estimator, seen, said
):
    answer = take(second=12.25)
    straight = cv2.undistort(seen.pictures[0], seen.K, np.array([-0.05, 0.01, 0.001, -0.001, 0]))
    expected = estimator.predict(straight, seen.K)
    assert expected
    for detection, other in zip(answer.result.detections, expected, strict=True):
        np.testing.assert_allclose(detection.T_cam_obj, other.T_cam_obj, atol=1e-9)
    assert (answer.stamp, answer.frame_id) == (Stamp(12, 250_000_000), "camera_optical_frame")
    assert not said
    assert worker.problem == ""


@pytest.mark.parametrize(
    ("spoilt", "said_of_it", "fix"),
    [
        ({"k": [0.0] * 9}, "a K of zeros", "dopepp calibrate camera"),
        ({"width": 640, "height": 480}, "640×480, and images of 320×240", "camera_info of these"),
        ({"distortion_model": "equidistant"}, "equidistant", "undistort"),
        ({"d": [0.1] * 3}, "3 distortion coefficients", "zeros"),
        ({"k": [float("nan")] * 9}, "K=nan", "fix"),
        ({"k": "abc"}, "camera_info of", ""),
    ],
)
def test_a_wrong_camera_is_said_once_and_ends_nothing(take, worker, said, spoilt, said_of_it, fix):
    assert [take(**spoilt) for _ in range(3)] == [None] * 3
    (line,) = said
    assert said_of_it in line
    assert fix in line
    assert "\n" not in line
    assert worker.problem == line
    assert take() is not None
    assert worker.problem == ""


def test_pictures_without_camera_info_are_told_after_a_few(take, said):
    for _ in range(PATIENCE - 1):
        assert take(info=False) is None
    assert not said
    for _ in range(5):
        take(info=False)
    (line,) = said
    assert "--camera camera.yaml" in line


def test_a_camera_that_is_given_takes_the_place_of_camera_info(estimator, seen, messages, said):
    worker = Worker(estimator, camera=Camera(None, seen.K, (), "--K"), warn=said.append)
    answer = worker.process(messages.image(seen.pictures[0], 1), None, messages.topic)
    expected = estimator.predict(seen.pictures[0], seen.K)
    np.testing.assert_allclose(
        answer.result.detections[0].T_cam_obj, expected[0].T_cam_obj, atol=1e-9
    )
    assert not said


def test_stamps_that_go_back_are_told_once(take, said):
    for second in (5, 6, 2, 3, 1):
        assert take(second=second) is not None
    (line,) = said
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
def test_odd_frames_are_told_and_published_in(take, messages, said, frame, beside, line):
    header = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=0), frame_id=beside)
    for _ in range(2):
        assert take(frame=frame, header=header).frame_id == frame
    assert len(said) == (line is not None)
    assert line is None or line in said[0]


def test_no_stamp_and_unreadable_pictures_are_told(worker, take, messages, seen, said):
    assert take(second=0) is not None
    bad = messages.image(seen.pictures[0], 1)
    for change in ({"encoding": "16UC1"}, {"data": b"12"}, {"height": 10**9}):
        spoilt = SimpleNamespace(**vars(bad) | change)
        assert worker.process(spoilt, messages.info(seen.K, (320, 240)), messages.topic) is None
    assert len(said) == 2
    assert "without a stamp" in said[0]
    assert "16UC1" in said[1]


def test_binned_and_cut_pictures_have_their_part_of_the_camera(worker, estimator, seen, messages):
    """A sensor twice as fine, of which the driver reads out the part behind (40, 20)."""
    K = np.diag([2.0, 2.0, 1.0]) @ seen.K
    K[:2, 2] += 0.5  # pixel (0, 0) is the upper left one's centre
    K[:2, 2] += (40, 20)
    roi = SimpleNamespace(x_offset=40, y_offset=20, width=640, height=480)
    info = messages.info(K, (800, 600), d=[0.0] * 5, roi=roi, binning_x=2, binning_y=2)
    answer = worker.process(messages.image(seen.pictures[0], 1), info, messages.topic)
    np.testing.assert_allclose(answer.result.K, seen.K, atol=1e-9)
    expected = estimator.predict(seen.pictures[0], seen.K)[0]
    np.testing.assert_allclose(answer.result.detections[0].T_cam_obj, expected.T_cam_obj, atol=1e-6)


def test_a_p_of_another_length_ends_nothing(take, said):
    assert take(topic="/camera/image_rect", p=[1.0] * 9) is None
    assert len(said) == 1


def test_settings_change_while_it_runs(worker, take):
    plain = take().result.detections[0]
    worker.update(replace(worker.settings, refine=True))
    refined = take().result.detections[0]
    assert refined.agreement is not None
    assert plain.agreement is None
    worker.update(WorkerSettings(confidence=1.0))
    silent = take().result
    assert (silent.detections, silent.num_weaker, silent.min_score) == ([], 1, 1.0)
    with pytest.raises(UserError, match="confidence=3"):
        WorkerSettings(confidence=3)


def test_parts_that_are_followed_have_names_that_stay(estimator, seen, messages, said):
    tracking = Worker(estimator, WorkerSettings(refine=True), track=True, warn=said.append)
    info = messages.info(seen.K, (320, 240), d=[0.0] * 5)
    numbers = [
        tracking.process(messages.image(seen.pictures[0], second), info, messages.topic).numbers
        for second in (1, 2, 3)
    ]
    assert numbers == [[0]] * 3
    with pytest.raises(UserError, match="--track"):
        tracking.update(WorkerSettings(refine=False))
    assert not said
