"""Twenty ways in which robot poses are wrong, each recognised."""

import csv
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.robot.calibration.board import board_pose
from dopepp.robot.calibration.files import Reading, read_robot_poses
from dopepp.robot.calibration.quality import check_poses

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
        ({}, Reading()),
        ({"kind": "rotvec"}, Reading()),
        ({"kind": "euler", "degrees": True}, Reading(degrees=True)),
        ({"unit": 1e-3}, Reading("mm")),
        ({"xyzw": True}, Reading(order="xyzw")),
    ],
)
def test_poses_that_are_read_as_they_are_meant_pass(cell, tmp_path, mount, how, reading):
    given = cell(1, mount=mount)
    found = judge(given, write(tmp_path / "poses.csv", given.T_base_flange, **how), reading, mount)
    assert np.allclose(found, given.T_base_flange, atol=1e-9)


FAULTS = [
    # what is written, how it is read, mounting said, what the message says
    ({"unit": 1e-3}, Reading(), "hand", "--unit mm"),
    ({"unit": 1e-2}, Reading(), "bench", "--unit cm"),
    ({"unit": 0.0254}, Reading("mm"), "hand", "--unit inch"),
    ({}, Reading("mm"), "hand", "--unit m"),
    ({"xyzw": True}, Reading(), "hand", "--quaternion xyzw"),
    ({"xyzw": True}, Reading(), "bench", "--quaternion xyzw"),
    ({}, Reading(order="xyzw"), "hand", "--quaternion wxyz"),
    ({"kind": "rotvec", "degrees": True}, Reading(), "hand", "--angles deg"),
    ({"kind": "rotvec"}, Reading(degrees=True), "bench", "--angles rad"),
    ({"kind": "euler", "degrees": True}, Reading(), "hand", "--angles deg"),
    ({"xyzw": True, "unit": 1e-3}, Reading(), "hand", "--quaternion xyzw, and --unit mm"),
    ({"kind": "euler", "degrees": True, "unit": 1e-3}, Reading(), "bench", "--unit mm"),
    ({}, Reading(inverted=True), "hand", "--direction"),
    ({}, Reading(inverted=True), "bench", "--direction"),
]


@pytest.mark.parametrize(("how", "reading", "mount", "said"), FAULTS)
def test_poses_that_are_read_wrongly_are_recognised(cell, tmp_path, how, reading, mount, said):
    given = cell(2, mount=mount)
    path = write(tmp_path / "poses.csv", given.T_base_flange, **how)
    with pytest.raises(UserError, match=re.escape(said)):
        judge(given, path, reading, mount)


def test_the_other_mounting_is_recognised(cell, tmp_path):
    given = cell(2, mount="hand")
    path = write(tmp_path / "poses.csv", given.T_base_flange)
    with pytest.raises(UserError, match="camera on the other side"):
        judge(given, path, Reading(), "bench")


def test_a_board_of_another_size_is_recognised(cell, tmp_path):
    given = cell(2)
    path = write(tmp_path / "poses.csv", given.T_base_flange)
    given.sightings = [type(one)(one.name, one.points * 0.8, one.pixels) for one in given.sightings]
    with pytest.raises(UserError, match=r"squares: they would be 1\.2\d+ times"):
        judge(given, path, Reading(), "hand")


def test_a_robot_that_stood_still_is_recognised(cell, tmp_path):
    given = cell(2)
    path = write(tmp_path / "poses.csv", np.repeat(given.T_base_flange[:1], 20, axis=0))
    with pytest.raises(UserError, match="the robot turns by 0"):
        judge(given, path, Reading(), "hand")


def test_one_picture_over_and_over_is_recognised(cell, tmp_path):
    given = cell(2)
    path = write(tmp_path / "poses.csv", given.T_base_flange)
    given.sightings = [given.sightings[0]] * 20
    with pytest.raises(UserError, match="the board, as the camera sees it, turns by 0"):
        judge(given, path, Reading(), "hand")


@pytest.mark.parametrize("step", [1, -1])
def test_a_list_that_is_off_by_one_is_recognised(cell, tmp_path, step):
    given = cell(2)
    path = write(tmp_path / "poses.csv", np.roll(given.T_base_flange, step, axis=0))
    with pytest.raises(UserError, match="poses fit the"):
        judge(given, path, Reading(), "hand")


def test_poses_of_another_day_are_refused(cell, tmp_path):
    given, other = cell(2), cell(9)
    path = write(tmp_path / "poses.csv", other.T_base_flange)
    with pytest.raises(UserError, match="medians of pairs"):
        judge(given, path, Reading(), "hand")


@pytest.mark.parametrize("seed", range(12))
def test_good_poses_with_two_outliers_raise_no_alarm(cell, tmp_path, seed):
    given = cell(seed)
    given.T_base_flange[:2, :3, 3] += 0.03
    judge(given, write(tmp_path / "poses.csv", given.T_base_flange), Reading(), "hand")
