from dataclasses import replace

import cv2
import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.geometry.camera import move_pose
from dopepp.geometry.camera_file import read_camera
from dopepp.robot.calibration.board import BoardDetection, parse_board
from dopepp.robot.calibration.lens import MAX_VIEWS, Views, calibrate_lens, write_camera
from tests.robot.calibration.conftest import take


@pytest.fixture(scope="module")
def views(cell):
    """The camera, and views of a board that reach the corners of the image."""
    camera, rng = cell(3, num=4).camera, np.random.default_rng(1)
    board = parse_board("charuco:9x7:25:18")
    detections = []
    for number in range(16):
        rotation = rng.uniform(-0.6, 0.6, 3)
        shift = np.array([-0.11 + rng.uniform(-0.12, 0.12), -0.09 + rng.uniform(-0.1, 0.1), 0.33])
        pixels = cv2.projectPoints(board.points, rotation, shift, camera.K, camera.coefficients)[0]
        pixels = pixels[:, 0] + 0.1 * rng.normal(size=(len(board.points), 2))
        inside = ((pixels > 0) & (pixels < np.array(camera.size) - 1)).all(axis=1)
        detections.append(BoardDetection(f"{number}.png", board.points[inside], pixels[inside]))
    return camera, detections


def test_the_errors_of_the_lens_fit_its_deviations(views):
    camera, detections = views
    result = calibrate_lens(detections, camera.size)
    K, true = result.camera.K, camera.K
    errors = np.array([K[0, 0] - true[0, 0], K[1, 1] - true[1, 1], *(K[:2, 2] - true[:2, 2])])
    assert (np.abs(errors) < 4 * result.deviations).all()
    assert np.abs(errors).max() < 1.0
    assert result.error_px == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
    assert (result.findings, result.outliers) == ((), ())


def test_equal_views_have_equal_calibrations(views):
    camera, detections = views
    results = [calibrate_lens(detections, camera.size) for _ in range(4)]
    for result in results[1:]:
        np.testing.assert_array_equal(result.camera.K, results[0].camera.K)
        assert result.camera.distortion == results[0].camera.distortion


def test_the_file_is_read_by_every_camera_option(views, tmp_path):
    camera, detections = views
    result = calibrate_lens(detections, camera.size).camera
    write_camera(tmp_path / "camera.yaml", result)
    again = read_camera(tmp_path / "camera.yaml")
    assert np.array_equal(again.K, result.K)
    assert (again.size, again.distortion) == (result.size, result.distortion)


def test_a_view_that_contradicts_the_others_is_rejected_by_name(views):
    camera, detections = views
    pixels = detections[5].pixels
    noise = 6 * np.random.default_rng(2).normal(size=pixels.shape)
    bent = replace(detections[5], pixels=pixels + noise)
    result = calibrate_lens([*detections[:5], bent, *detections[6:]], camera.size)
    assert result.outliers == ("5.png",)
    assert abs(result.camera.K[0, 0] - camera.K[0, 0]) < 1.5


def test_views_in_the_middle_only_are_not_trusted(views):
    camera, detections = views
    wide = tuple(3 * side for side in camera.size)
    middle = [replace(seen, pixels=seen.pixels + np.array(camera.size)) for seen in detections]
    assert any("cover" in finding for finding in calibrate_lens(middle, wide).findings)


def test_parallel_views_are_not_trusted_and_two_views_are_rejected(views):
    camera, detections = views
    with pytest.raises(UserError, match="at least 3"):
        calibrate_lens(detections[:2], camera.size)
    board, parallel = parse_board("charuco:9x7:25:18"), []
    for k in range(8):
        T = move_pose(np.eye(4), np.array([0.01 * k, 0, 0.2 * k, 0.03 * k - 0.2, -0.1, 0.4]))
        parallel.append(take(board, T, camera, str(k)))
    assert any("parallel" in finding for finding in calibrate_lens(parallel, camera.size).findings)


POINTS = parse_board("charuco:8x6:25:19").points


def at(x, name, points=POINTS):
    return BoardDetection(name, points, 1000 * points[:, :2] + [x, 0])


def test_of_similar_frames_the_frame_with_the_least_motion_is_kept():
    views = Views(1000)
    # The board arrives, rests at 100, leaves and rests at 300: steps of 30, 10, 2, 30 … pixels.
    places = [60, 90, 100, 102, 130, 200, 260, 290, 300, 300, 310]
    new = [views.add(at(x, str(x))) for x in places]
    assert new == [True] + 4 * [False] + [True, True] + 4 * [False]
    assert [view.name for view in views.kept] == ["102", "200", "300"]


def test_other_corners_and_a_rotated_board_are_other_views():
    views, quarter = Views(1000), np.array([[0.0, 1], [-1, 0]])
    assert views.add(at(0, "left", POINTS[:15]))
    assert views.add(at(0, "right", POINTS[15:]))
    assert not views.add(at(0, "left again", POINTS[:15]))
    assert views.add(BoardDetection("rotated", POINTS, 1000 * POINTS[:, :2] @ quarter))
    assert not views.is_full
    for number in range(1, MAX_VIEWS):
        views.add(at(50 * number, str(number)))
    assert views.is_full
