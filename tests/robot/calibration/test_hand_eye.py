import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.robot.calibration.hand_eye import calibrate_hand_eye, park, robot_world_equations, shah


def difference(T, other):
    """Return the angle in degrees and the distance in millimetres between two poses."""
    angle = Rotation.from_matrix(T[:3, :3].T @ other[:3, :3]).magnitude()
    return np.degrees(angle), 1000 * np.linalg.norm(T[:3, 3] - other[:3, 3])


@pytest.mark.parametrize("mount", ["hand", "bench"])
@pytest.mark.parametrize("solve", [park, shah])
def test_closed_forms_are_exact_without_noise(cell, mount, solve):
    given = cell(4, mount=mount, noise=0)
    M, B, _ = robot_world_equations(given.T_base_flange, given.boards, mount)
    X, Y = solve(M, B)
    assert max(difference(X, given.T_mount_cam)) < 1e-3
    assert max(difference(Y, given.T_other_board)) < 1e-3


@pytest.mark.skipif(not hasattr(cv2, "calibrateHandEye"), reason="not in this OpenCV")
def test_park_agrees_with_opencv(cell):
    given = cell(4)
    M, B, _ = robot_world_equations(given.T_base_flange, given.boards, "hand")
    blocks = M[:, :3, :3], M[:, :3, 3], B[:, :3, :3], B[:, :3, 3]
    R, t = cv2.calibrateHandEye(*blocks, method=cv2.CALIB_HAND_EYE_PARK)
    X, _ = park(M, B)
    assert np.allclose(X[:3, :3], R, atol=1e-6)
    assert np.allclose(X[:3, 3], t.ravel(), atol=1e-6)


@pytest.mark.parametrize("mount", ["hand", "bench"])
def test_the_error_of_the_camera_is_below_a_millimetre_and_fits_its_covariance(cell, mount):
    squares = []
    for seed in range(8):
        given = cell(seed, mount=mount)
        result = calibrate_hand_eye(given.T_base_flange, given.boards, mount)
        angle, shift = difference(given.T_mount_cam, result.T_mount_cam)
        assert angle < 0.1
        assert shift < 1.0
        R = given.T_mount_cam[:3, :3]
        error = np.concatenate([
            Rotation.from_matrix(R.T @ result.T_mount_cam[:3, :3]).as_rotvec(),
            R.T @ (result.T_mount_cam[:3, 3] - given.T_mount_cam[:3, 3]),
        ])  # fmt: skip
        squares.append(error @ np.linalg.solve(result.covariance, error) / 6)
    assert 0.4 < np.mean(squares) < 2.5


def test_the_camera_on_the_bench_does_not_depend_on_the_base_frame(cell):
    given, moved = cell(3, mount="bench"), np.eye(4)
    moved[:3, 3] = [1.0, -0.5, 0.3]
    first, second = (
        calibrate_hand_eye(T @ given.T_base_flange, given.boards, "bench")
        for T in (np.eye(4), moved)
    )
    assert np.allclose(second.T_mount_cam, moved @ first.T_mount_cam, atol=1e-6)
    assert np.allclose(second.covariance, first.covariance, rtol=1e-3, atol=0)


def test_poses_that_contradict_the_others_are_rejected(cell):
    given = cell(5)
    given.T_base_flange[3, :3, 3] += [0.02, 0, 0]
    given.T_base_flange[11, :3, :3] @= Rotation.from_euler("x", 3, degrees=True).as_matrix()
    result = calibrate_hand_eye(given.T_base_flange, given.boards, "hand")
    assert set(np.flatnonzero(~result.inliers)) == {3, 11}
    assert difference(given.T_mount_cam, result.T_mount_cam)[1] < 1.0


def test_two_poses_are_rejected(cell):
    given = cell(0, num=2)
    with pytest.raises(UserError, match="at least 3"):
        calibrate_hand_eye(given.T_base_flange, given.boards, "hand")
