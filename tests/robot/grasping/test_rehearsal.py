"""The calibrations of the simulated robot estimate its true parameters."""

import numpy as np

from dopepp.geometry.camera import transform
from dopepp.robot.grasping.cell import TRAY
from dopepp.robot.grasping.rehearsal import MOUNT, TRUE_K, calibrate, downward_view, draw_robot


def test_calibrations_have_small_errors(arm, gripper):
    rng = np.random.default_rng(4)
    robot = draw_robot(rng, np.array([0.0, 0.0, gripper.reach(0.0)]))
    calibrated = calibrate(robot, arm, rng, 0.2)
    T = calibrated.knowledge.T_flange_cam
    assert np.linalg.norm(T[:3, 3] - robot.T_flange_cam[:3, 3]) < 1e-3
    assert 0 < calibrated.hand_eye_mm < 0.6
    assert 0 < calibrated.hand_eye_deg < 0.1
    tip, bench = calibrated.knowledge.tip, calibrated.knowledge.T_base_bench
    assert 0 < np.linalg.norm(tip - robot.tip) < 0.6e-3
    assert abs(bench[:3, 2] @ (TRAY - bench[:3, 3])) < 0.6e-3
    assert abs(calibrated.camera.K - TRUE_K).max() < 2.5
    # The error of the bracket's drawing is far larger.
    assert np.linalg.norm(MOUNT[:3, 3] - robot.T_flange_cam[:3, 3]) > 2e-3


def test_the_point_is_on_the_optical_axis():
    T = downward_view(TRAY, 0.2, np.array([0.2, -0.3]), 0.7)
    np.testing.assert_allclose(transform(T, np.array([[0, 0, 0.2]]))[0], TRAY, atol=1e-12)
    assert T[2, 2] < -0.9
