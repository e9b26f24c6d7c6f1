"""Twenty ways in which robot poses are wrong, each recognised; what a calibration is worth."""

import csv
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.robot.calibration.board import board_pose
from dopepp.robot.calibration.hand_eye import calibrate_hand_eye
from dopepp.robot.calibration.quality import assess, check_poses, expected_error
from dopepp.robot.calibration.records import PoseFormat, read_robot_poses

QUATERNION = ("qw", "qx", "qy", "qz")


def write(path, T, kind="quaternion", unit=1.0, degrees=False, xyzw=False):
    rotation = Rotation.from_matrix(T[:, :3, :3])
    names, numbers = {
        "quaternion": (QUATERNION, rotation.as_quat(scalar_first=not xyzw)),
        "rotvec": (("rx", "ry", "rz"), rotation.as_rotvec(degrees=degrees)),
        "euler": (("roll", "pitch", "yaw"), rotation.as_euler("xyz", degrees=degrees)),
    }[kind]
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["x", "y", "z", *names])
        rows.writerows(np.hstack([T[:, :3, 3] / unit, numbers]).tolist())
    return path


def judge(given, path, reading, mount):
    boards = [board_pose(one, given.camera) for one in given.sightings]
    poses = read_robot_poses(path)
    return check_poses(poses, range(len(boards)), reading, boards, mount)


@pytest.mark.parametrize("mount", ["hand", "bench"])
@pytest.mark.parametrize(
    ("how", "reading"),
    [
        ({}, PoseFormat()),
        ({"kind": "rotvec"}, PoseFormat()),
        ({"kind": "euler", "degrees": True}, PoseFormat(degrees=True)),
        ({"unit": 1e-3}, PoseFormat("mm")),
        ({"xyzw": True}, PoseFormat(order="xyzw")),
    ],
)
def test_poses_that_are_read_as_they_are_meant_pass(cell, tmp_path, mount, how, reading):
    given = cell(1, mount=mount)
    found = judge(given, write(tmp_path / "poses.csv", given.T_base_flange, **how), reading, mount)
    assert np.allclose(found, given.T_base_flange, atol=1e-9)


FAULTS = [
    # what is written, how it is read, mounting said, what the message says
    ({"unit": 1e-3}, PoseFormat(), "hand", "--unit mm"),
    ({"unit": 1e-2}, PoseFormat(), "bench", "--unit cm"),
    ({"unit": 0.0254}, PoseFormat("mm"), "hand", "--unit inch"),
    ({}, PoseFormat("mm"), "hand", "--unit m"),
    ({"xyzw": True}, PoseFormat(), "hand", "--quaternion xyzw"),
    ({"xyzw": True}, PoseFormat(), "bench", "--quaternion xyzw"),
    ({}, PoseFormat(order="xyzw"), "hand", "--quaternion wxyz"),
    ({"kind": "rotvec", "degrees": True}, PoseFormat(), "hand", "--angles deg"),
    ({"kind": "rotvec"}, PoseFormat(degrees=True), "bench", "--angles rad"),
    ({"kind": "euler", "degrees": True}, PoseFormat(), "hand", "--angles deg"),
    ({"xyzw": True, "unit": 1e-3}, PoseFormat(), "hand", "--quaternion xyzw, and --unit mm"),
    ({"kind": "euler", "degrees": True, "unit": 1e-3}, PoseFormat(), "bench", "--unit mm"),
    ({}, PoseFormat(inverted=True), "hand", "--direction"),
    ({}, PoseFormat(inverted=True), "bench", "--direction"),
]


@pytest.mark.parametrize(("how", "reading", "mount", "said"), FAULTS)
def test_poses_that_are_read_wrongly_are_recognised(cell, tmp_path, how, reading, mount, said):
    given = cell(2, mount=mount)
    path = write(tmp_path / "poses.csv", given.T_base_flange, **how)
    with pytest.raises(UserError, match=re.escape(said)):
        judge(given, path, reading, mount)


def same(given):
    pass


def on_a_larger_board(given):
    given.sightings = [replace(one, points=one.points * 0.8) for one in given.sightings]


def standing_still(given):
    given.T_base_flange[:] = given.T_base_flange[0]


def one_picture(given):
    given.sightings = given.sightings[:1] * 20


def one_late(given):
    given.T_base_flange = np.roll(given.T_base_flange, 1, axis=0)


def one_early(given):
    given.T_base_flange = np.roll(given.T_base_flange, -1, axis=0)


@pytest.mark.parametrize(
    ("spoil", "mount", "said"),
    [
        (same, "bench", "camera on the other mount"),
        (on_a_larger_board, "hand", r"squares \(they may be 1\.2\d+ times"),
        (standing_still, "hand", "the robot rotates by 0"),
        (one_picture, "hand", "the board, seen by the camera, rotates by 0"),
        (one_late, "hand", "poses fit the"),
        (one_early, "hand", "poses fit the"),
    ],
)
def test_poses_that_are_not_those_of_the_pictures_are_recognised(
    cell, tmp_path, spoil, mount, said
):
    given = cell(2)
    spoil(given)
    path = write(tmp_path / "poses.csv", given.T_base_flange)
    with pytest.raises(UserError, match=said):
        judge(given, path, PoseFormat(), mount)


def test_poses_of_another_day_are_refused(cell, tmp_path):
    path = write(tmp_path / "poses.csv", cell(9).T_base_flange)
    with pytest.raises(UserError, match="medians over"):
        judge(cell(2), path, PoseFormat(), "hand")


@pytest.mark.parametrize("seed", range(12))
def test_good_poses_with_two_outliers_raise_no_alarm(cell, tmp_path, seed):
    given = cell(seed)
    given.T_base_flange[:2, :3, 3] += 0.03
    judge(given, write(tmp_path / "poses.csv", given.T_base_flange), PoseFormat(), "hand")


def test_an_explanation_names_the_pose_that_matters_and_trusts_a_good_calibration(cell):
    given = cell(6)
    boards = [board_pose(one, given.camera) for one in given.sightings]
    found = calibrate_hand_eye(given.T_base_flange, boards, "hand")
    worth = assess(given.T_base_flange, boards, found)
    assert not worth.findings
    assert worth.shift < 0.001
    one = int(worth.leave_one_out.argmax())
    rest = [k for k in range(len(boards)) if k != one]
    without = calibrate_hand_eye(given.T_base_flange[rest], [boards[k] for k in rest], "hand")
    moved = np.linalg.norm(without.T_mount_cam[:3, 3] - found.T_mount_cam[:3, 3])
    assert worth.leave_one_out[one] == pytest.approx(moved, rel=0.5)


def test_turns_about_one_axis_are_not_trusted(cell):
    given = cell(7, tilt=0.01)  # straight from above, turned about the optical axis only
    boards = [board_pose(one, given.camera) for one in given.sightings]
    found = calibrate_hand_eye(given.T_base_flange, boards, "hand")
    worth = assess(given.T_base_flange, boards, found)
    assert any("nearly parallel axes only" in one for one in worth.findings)
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
