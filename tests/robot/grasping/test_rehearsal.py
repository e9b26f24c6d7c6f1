"""The calibrations of the simulated robot find what is true of it, but for their errors."""

import numpy as np

from dopepp.geometry.camera import transform
from dopepp.robot.grasping.cell import TRAY
from dopepp.robot.grasping.rehearsal import MOUNT, TRUE_K, calibrate, draw_robot, looking_at


def test_calibrations_are_right_within_what_they_say(arm, gripper):
    rng = np.random.default_rng(4)
    robot = draw_robot(rng, np.array([0.0, 0.0, gripper.reach(0.0)]))
    found = calibrate(robot, arm, rng, 0.2)
    T = found.knowledge.T_flange_cam
    assert np.linalg.norm(T[:3, 3] - robot.T_flange_cam[:3, 3]) < 1e-3
    assert 0 < found.hand_eye_mm < 0.6
    assert 0 < found.hand_eye_deg < 0.1
    tip, bench = found.knowledge.tip, found.knowledge.T_base_bench
    assert 0 < np.linalg.norm(tip - robot.tip) < 0.6e-3
    assert abs(bench[:3, 2] @ (TRAY - bench[:3, 3])) < 0.6e-3
    assert abs(found.camera.K - TRUE_K).max() < 2.5
    # The drawing of the bracket alone would have been far worse.
    assert np.linalg.norm(MOUNT[:3, 3] - robot.T_flange_cam[:3, 3]) > 2e-3


def test_a_camera_looks_at_the_point_it_is_to_look_at():
    T = looking_at(TRAY, 0.2, np.array([0.2, -0.3]), 0.7)
    np.testing.assert_allclose(transform(T, np.array([[0, 0, 0.2]]))[0], TRAY, atol=1e-12)
    assert T[2, 2] < -0.9
