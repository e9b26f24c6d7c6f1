"""Rigs of simulated cameras: poses against the truth, honest deviations, and faulty images."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.geometry.camera import camera_matrix, invert_transform, make_transform, step_between
from dopepp.geometry.camera_file import Camera
from dopepp.robot.calibration.board import parse_board
from dopepp.robot.calibration.rig import calibrate_rig
from tests.robot.calibration.conftest import look_at, take

BOARD = parse_board("chess:7x10:25")
NOISE = 0.15  # pixels
LENSES = {
    "left": Camera((640, 480), camera_matrix(600, 602, 322, 236), (0.05, -0.1, 0, 0, 0), "true"),
    "right": Camera((1280, 720), camera_matrix(1000, 999, 650, 355), (), "true"),
    "top": Camera((640, 480), camera_matrix(590, 590, 319, 241), (-0.1, 0.02, 0, 0, 0), "true"),
}
CENTRE = np.array([0.0, 0.0, 0.5])
POSES = {
    "left": np.eye(4),
    "right": look_at(np.array([0.35, 0.0, 0.1]), CENTRE, 0.1),
    "top": look_at(np.array([0.0, -0.3, 0.15]), CENTRE, -0.2),
}


def draw_detections(seed=0, moments=8, names=tuple(POSES)):
    """Return the detections of a board at random poses, in the cameras' images."""
    rng = np.random.default_rng(seed)
    boards = {name: {} for name in names}
    for file in (f"{moment}.png" for moment in range(moments)):
        rotation = Rotation.from_rotvec(rng.uniform(-0.4, 0.4, 3)).as_matrix()
        position = CENTRE + rng.uniform(-0.05, 0.05, 3) - rotation @ BOARD.points.mean(axis=0)
        T_world_board = make_transform(rotation, position)
        for name in names:
            T = invert_transform(POSES[name]) @ T_world_board
            boards[name][file] = take(BOARD, T, LENSES[name], file, NOISE, rng)
    return boards


def test_the_poses_of_the_cameras_are_estimated():
    rig = calibrate_rig(draw_detections(), LENSES)
    assert rig.names == tuple(POSES)
    assert (rig.outliers, rig.findings, rig.shared) == ((), (), (8, 8, 8))
    np.testing.assert_array_equal(rig.T_world_cam[0], np.eye(4))
    for T, true in zip(rig.T_world_cam, POSES.values(), strict=True):
        assert np.linalg.norm(T[:3, 3] - true[:3, 3]) < 5e-4
        assert np.degrees(np.linalg.norm(step_between(true, T)[:3])) < 0.05
    np.testing.assert_allclose(rig.errors_px, NOISE * np.sqrt(2), rtol=0.1)


def test_stated_deviations_are_those_of_repeated_calibrations():
    squares = []
    for seed in range(8):
        rig = calibrate_rig(draw_detections(seed, moments=5), LENSES)
        for number, true in list(enumerate(POSES.values()))[1:]:
            error = step_between(true, rig.T_world_cam[number])
            squares.append(error @ np.linalg.solve(rig.covariances[number], error) / 6)
    assert 0.8 < np.sqrt(np.mean(squares)) < 1.25
    np.testing.assert_array_equal(rig.deviations[0], 0)


def test_a_camera_is_linked_through_another():
    boards = draw_detections(moments=12)
    boards["left"] = dict(list(boards["left"].items())[:6])
    boards["top"] = dict(list(boards["top"].items())[6:])  # never together with the left camera
    rig = calibrate_rig(boards, LENSES)
    assert rig.shared == (6, 12, 6)
    assert np.linalg.norm(rig.T_world_cam[2][:3, 3] - POSES["top"][:3, 3]) < 1e-3
    direct = calibrate_rig(draw_detections(moments=6), LENSES)
    assert rig.deviations[2, 0] > 1.2 * direct.deviations[2, 0]


def test_a_camera_that_never_shares_the_board_is_named():
    boards = draw_detections()
    boards["top"] = {f"other {name}": seen for name, seen in boards["top"].items()}
    with pytest.raises(UserError, match="top without images of the board at the same moments"):
        calibrate_rig(boards, LENSES)


def test_a_moment_with_a_moved_board_is_rejected():
    boards = draw_detections()
    boards["right"]["3.png"] = boards["right"]["4.png"]
    rig = calibrate_rig(boards, LENSES)
    assert rig.outliers == ("3.png",)
    assert np.linalg.norm(rig.T_world_cam[1][:3, 3] - POSES["right"][:3, 3]) < 1e-3


def test_images_of_other_moments_and_few_images_are_findings():
    boards = draw_detections()
    names = list(boards["right"])
    boards["right"] = dict(zip(names, np.roll(list(boards["right"].values()), 1), strict=True))
    assert "same moment" in calibrate_rig(boards, LENSES).findings[-1]
    few = calibrate_rig(draw_detections(moments=3, names=("left", "top")), LENSES)
    assert [finding.split()[0] for finding in few.findings] == ["left", "top"]


def test_a_wrong_focal_length_is_a_finding():
    wrong = LENSES | {"right": replace(LENSES["right"], K=camera_matrix(1400, 1400, 640, 360))}
    assert "right" in calibrate_rig(draw_detections(), wrong).findings[0]


@pytest.mark.parametrize("count", [1, 9])
def test_a_rig_has_two_to_eight_cameras(count):
    boards = {f"camera {number}": {} for number in range(count)}
    with pytest.raises(UserError, match="2 to 8 cameras"):
        calibrate_rig(boards, {})
