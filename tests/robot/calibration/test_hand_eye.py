import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.robot.calibration.board import board_pose
from dopepp.robot.calibration.hand_eye import calibrate_hand_eye, equations, park, shah
from dopepp.robot.calibration.quality import expected_error, explain


def boards_of(cell):
    return [board_pose(one, cell.camera) for one in cell.sightings]


def apart(T, other):
    """Return the angle in degrees and the distance in millimetres between two poses."""
    turn = Rotation.from_matrix(T[:3, :3].T @ other[:3, :3]).magnitude()
    return np.degrees(turn), 1000 * np.linalg.norm(T[:3, 3] - other[:3, 3])


@pytest.mark.parametrize("mount", ["hand", "bench"])
@pytest.mark.parametrize("solve", [park, shah])
def test_closed_forms_are_exact_without_noise(cell, mount, solve):
    given = cell(4, mount=mount, noise=0)
    M, B, _ = equations(given.T_base_flange, boards_of(given), mount)
    X, Y = solve(M, B)
    assert max(apart(X, given.T_mount_cam)) < 1e-3
    assert max(apart(Y, given.T_other_board)) < 1e-3


@pytest.mark.skipif(not hasattr(cv2, "calibrateHandEye"), reason="this OpenCV lacks it")
def test_park_is_that_of_opencv(cell):
    given = cell(4)
    M, B, _ = equations(given.T_base_flange, boards_of(given), "hand")
    R, t = cv2.calibrateHandEye(
        M[:, :3, :3], M[:, :3, 3], B[:, :3, :3], B[:, :3, 3], method=cv2.CALIB_HAND_EYE_PARK
    )
    X, _ = park(M, B)
    assert np.allclose(X[:3, :3], R, atol=1e-6)
    assert np.allclose(X[:3, 3], t.ravel(), atol=1e-6)


@pytest.mark.parametrize("mount", ["hand", "bench"])
def test_the_camera_is_found_within_a_millimetre_and_its_covariance(cell, mount):
    squares = []
    for seed in range(8):
        given = cell(seed, mount=mount)
        found = calibrate_hand_eye(given.T_base_flange, boards_of(given), mount)
        turn, shift = apart(given.T_mount_cam, found.T_mount_cam)
        assert turn < 0.1
        assert shift < 1.0
        R = given.T_mount_cam[:3, :3]
        error = np.concatenate([
            Rotation.from_matrix(R.T @ found.T_mount_cam[:3, :3]).as_rotvec(),
            R.T @ (found.T_mount_cam[:3, 3] - given.T_mount_cam[:3, 3]),
        ])  # fmt: skip
        squares.append(error @ np.linalg.solve(found.covariance, error) / 6)
    assert 0.4 < np.mean(squares) < 2.5


def test_poses_that_contradict_the_others_are_left_out(cell):
    given = cell(5)
    given.T_base_flange[3, :3, 3] += [0.02, 0, 0]
    given.T_base_flange[11, :3, :3] = (
        given.T_base_flange[11, :3, :3] @ Rotation.from_euler("x", 3, degrees=True).as_matrix()
    )
    found = calibrate_hand_eye(given.T_base_flange, boards_of(given), "hand")
    assert set(np.flatnonzero(~found.inliers)) == {3, 11}
    assert apart(given.T_mount_cam, found.T_mount_cam)[1] < 1.0


def test_joint_refinement_is_better_than_its_start(cell):
    closed, joint = [], []
    for seed in range(10):
        given = cell(seed)
        boards = boards_of(given)
        M, B, _ = equations(given.T_base_flange, boards, "hand")
        closed.append(apart(given.T_mount_cam, park(M, B)[0]))
        joint.append(apart(given.T_mount_cam, calibrate_hand_eye(M, boards, "hand").T_mount_cam))
    assert (np.median(joint, axis=0) < np.median(closed, axis=0)).all()


def test_two_poses_are_refused(cell):
    given = cell(0, num=2)
    with pytest.raises(UserError, match="at least 3"):
        calibrate_hand_eye(given.T_base_flange, boards_of(given), "hand")


def test_an_explanation_names_the_pose_that_matters_and_trusts_a_good_calibration(cell):
    given = cell(6)
    boards = boards_of(given)
    found = calibrate_hand_eye(given.T_base_flange, boards, "hand")
    worth = explain(given.T_base_flange, boards, found)
    assert not worth.findings
    assert worth.shift < 0.001
    one = int(worth.leave_one_out.argmax())
    rest = [k for k in range(len(boards)) if k != one]
    without = calibrate_hand_eye(given.T_base_flange[rest], [boards[k] for k in rest], "hand")
    moved = np.linalg.norm(without.T_mount_cam[:3, 3] - found.T_mount_cam[:3, 3])
    assert worth.leave_one_out[one] == pytest.approx(moved, rel=0.5)


def test_turns_about_one_axis_are_not_trusted(cell):
    given = cell(7, tilt=0.01)  # straight from above, turned about the optical axis only
    boards = boards_of(given)
    found = calibrate_hand_eye(given.T_base_flange, boards, "hand")
    worth = explain(given.T_base_flange, boards, found)
    assert any("one direction only" in one for one in worth.findings)
    optical = given.T_mount_cam[:3, 2]
    assert abs(worth.weakest @ optical) > 0.9


def test_expected_error_is_that_of_drawn_calibrations():
    rng = np.random.default_rng(0)
    root = 1e-3 * rng.normal(size=(6, 6))
    steps = rng.normal(size=(20000, 6)) @ root.T
    point = np.array([0, 0, 0.5])
    moved = np.cross(steps[:, :3], point) + steps[:, 3:]
    shift, turn = expected_error(root @ root.T, 0.5)
    assert shift == pytest.approx(np.sqrt((moved**2).sum(axis=1).mean()), rel=0.03)
    assert turn == pytest.approx(np.sqrt((steps[:, :3] ** 2).sum(axis=1).mean()), rel=0.03)
