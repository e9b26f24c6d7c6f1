"""Kinematics against Denavit and Hartenberg's, and the gripper against its data sheet."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dopepp.geometry.camera import make_transform
from dopepp.geometry.rotation import rotation_angle
from dopepp.robot.grasping.cell import HOME, TRAY

# a, d and α of Menagerie's model of a UR5e, metres and radians.
DH = (
    (0.0, 0.163, np.pi / 2), (-0.425, 0.0, 0.0), (-0.392, 0.0, 0.0),
    (0.0, 0.134, np.pi / 2), (0.0, 0.1, -np.pi / 2), (0.0, 0.1, 0.0),
)  # fmt: skip

angles = st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6)


def denavit_hartenberg(joints):
    T = np.eye(4)
    for q, (a, d, alpha) in zip(joints, DH, strict=True):
        c, s, ca, sa = np.cos(q), np.sin(q), np.cos(alpha), np.sin(alpha)
        T = T @ np.array(
            [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
        )
    return T


@given(angles)
def test_the_flange_agrees_with_the_closed_form(arm, joints):
    ours, theirs = arm.flange(np.array(joints)), denavit_hartenberg(joints)
    np.testing.assert_allclose(ours[:3, 3], theirs[:3, 3], atol=2e-4)
    np.testing.assert_allclose(ours[:3, 2], theirs[:3, 2], atol=1e-3)


@given(st.tuples(*[st.floats(-0.1, 0.1)] * 2, st.floats(0.18, 0.4), st.floats(-1.5, 1.5)))
def test_inverse_kinematics_reaches_poses_over_the_tray(arm, position):
    x, y, z, yaw = position
    rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    goal = make_transform(rotation @ np.diag([1.0, -1.0, -1.0]), TRAY + np.array([x, y, z]))
    joints = arm.joints(goal, HOME)
    assert joints is not None
    reached = arm.flange(joints)
    assert np.linalg.norm(reached[:3, 3] - goal[:3, 3]) < 2e-4
    assert rotation_angle(reached[:3, :3].T @ goal[:3, :3]) < 2e-3


@pytest.mark.parametrize("position", [[1.5, 0.0, 0.3], [0.0, 0.0, 3.0]])
def test_a_pose_out_of_reach_has_no_joints(arm, straight_down, position):
    straight_down[:3, 3] = position
    assert arm.joints(straight_down) is None


def test_the_gripper_agrees_with_its_data_sheet(gripper):
    assert gripper.widest == pytest.approx(0.085, abs=0.001)
    assert abs(gripper.widths[-1]) < 0.001
    assert (np.diff(gripper.widths) < 0).all()
    assert gripper.command(gripper.widths[7]) == pytest.approx(255 * 7 / 17)
    assert gripper.reach(0.04) > gripper.reach(0.085)
