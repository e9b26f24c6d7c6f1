"""Faults of robot poses, each recognised, and the quality of a hand-eye calibration."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.geometry.camera import make_transform
from dopepp.robot.calibration.board import parse_board
from dopepp.robot.calibration.hand_eye import calibrate_hand_eye
from dopepp.robot.calibration.quality import assess, check_poses, expected_error
from dopepp.robot.calibration.records import PoseFormat, read_robot_poses
from tests.robot.calibration.conftest import take


def write(path, T, kind="quaternion", unit=1.0, degrees=False, xyzw=False):
    rotation = Rotation.from_matrix(T[:, :3, :3])
    names, numbers = {
        "quaternion": ("qw,qx,qy,qz", rotation.as_quat(scalar_first=not xyzw)),
        "rotvec": ("rx,ry,rz", rotation.as_rotvec(degrees=degrees)),
        "euler": ("roll,pitch,yaw", rotation.as_euler("xyz", degrees=degrees)),
    }[kind]
    rows = np.hstack([T[:, :3, 3] / unit, numbers])
    np.savetxt(path, rows, "%.17g", ",", header=f"x,y,z,{names}", comments="")
    return path


def check(given, path, pose_format, mount):
    boards, poses = given.boards, read_robot_poses(path)
    return check_poses(poses, range(len(boards)), pose_format, boards, mount)


@pytest.mark.parametrize("mount", ["hand", "bench"])
@pytest.mark.parametrize(
    ("style", "pose_format"),
    [
        ({}, PoseFormat()),
        ({"kind": "rotvec"}, PoseFormat()),
        ({"kind": "euler", "degrees": True}, PoseFormat(degrees=True)),
        ({"unit": 1e-3}, PoseFormat("mm")),
        ({"xyzw": True}, PoseFormat(order="xyzw")),
    ],
)
def test_poses_under_the_right_convention_pass(cell, tmp_path, mount, style, pose_format):
    given = cell(1, mount=mount)
    path = write(tmp_path / "poses.csv", given.T_base_flange, **style)
    flanges = check(given, path, pose_format, mount)
    assert np.allclose(flanges, given.T_base_flange, atol=1e-9)


@pytest.mark.parametrize(("style", "pose_format", "mount", "message"), [
    # style of the file, convention under which it is read, mount, message
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
    ({}, PoseFormat(inverted=True), "hand", "--direction flange-to-base"),
    ({}, PoseFormat(inverted=True), "bench", "--direction flange-to-base"),
])  # fmt: skip
def test_a_wrong_convention_is_recognised(cell, tmp_path, style, pose_format, mount, message):
    given = cell(2, mount=mount)
    path = write(tmp_path / "poses.csv", given.T_base_flange, **style)
    with pytest.raises(UserError, match=re.escape(message)):
        check(given, path, pose_format, mount)


def larger(detections):
    return [replace(detection, points=detection.points * 0.8) for detection in detections]


def unchanged(values):
    return values


@pytest.mark.parametrize(
    ("of_poses", "of_detections", "mount", "message"),
    [
        (unchanged, unchanged, "bench", "--direction base-to-flange, or the camera on the other"),
        (unchanged, larger, "hand", r"squares \(they may be 1\.2\d+ times"),
        (lambda T: T[:1].repeat(20, 0), unchanged, "hand", "the robot rotates by 0"),
        (
            unchanged,
            lambda seen: seen[:1] * 20,
            "hand",
            "the board, seen by the camera, rotates by 0",
        ),
        (lambda T: np.roll(T, 1, axis=0), unchanged, "hand", "poses fit the"),
        (lambda T: np.roll(T, -1, axis=0), unchanged, "hand", "poses fit the"),
    ],
    ids=["other mount", "larger board", "robot at rest", "one image", "one late", "one early"],
)
def test_poses_that_contradict_the_images_are_recognised(
    cell, tmp_path, of_poses, of_detections, mount, message
):
    given = cell(2)
    given.detections = of_detections(given.detections)
    path = write(tmp_path / "poses.csv", of_poses(given.T_base_flange))
    with pytest.raises(UserError, match=message):
        check(given, path, PoseFormat(), mount)


def test_poses_of_another_calibration_are_rejected(cell, tmp_path):
    path = write(tmp_path / "poses.csv", cell(9).T_base_flange)
    with pytest.raises(UserError, match="medians over"):
        check(cell(2), path, PoseFormat(), "hand")


@pytest.mark.parametrize("seed", range(12))
def test_good_poses_with_two_outliers_pass(cell, tmp_path, seed):
    given = cell(seed)
    given.T_base_flange[:2, :3, 3] += 0.03
    check(given, write(tmp_path / "poses.csv", given.T_base_flange), PoseFormat(), "hand")


T_FLANGE_CAM = make_transform(np.eye(3), np.array([0.05, 0.06, 0.04]))


def rotating(given, shifts):
    """Replace poses and images: the flange rotates about its origin at ``shifts``."""
    rng, board = np.random.default_rng(0), parse_board("charuco:9x7:25:18")
    down = np.diag([1.0, -1.0, -1.0])
    turns = Rotation.from_rotvec(rng.uniform(-0.3, 0.3, (20, 3))).as_matrix()
    given.T_base_flange = make_transform(down @ turns, shifts + np.array([0, 0, 0.5]))
    T_base_board = make_transform(down, -down @ board.points.mean(axis=0))
    T_cam_board = np.linalg.inv(given.T_base_flange @ T_FLANGE_CAM) @ T_base_board
    given.detections = [
        take(board, T, given.camera, f"{number:02d}.png", 0.1, rng)
        for number, T in enumerate(T_cam_board)
    ]


@pytest.mark.parametrize("jitter", [0.0, 1e-6, 1e-4])
def test_a_flange_that_only_rotates_about_its_origin_determines_no_scale(cell, tmp_path, jitter):
    given = cell(2)
    rotating(given, jitter * np.random.default_rng(1).normal(size=(20, 3)))
    path = write(tmp_path / "poses.csv", given.T_base_flange)
    flanges = check(given, path, PoseFormat(), "hand")
    calibration = calibrate_hand_eye(flanges, given.boards, "hand")
    assert np.allclose(calibration.T_mount_cam, T_FLANGE_CAM, atol=0.001)


def test_a_few_poses_elsewhere_determine_the_scale(cell, tmp_path):
    given = cell(2)
    rotating(given, np.repeat([[0.0, 0.0, 0.0], [0.15, 0.1, 0.0]], [15, 5], axis=0))
    given.detections = larger(given.detections)
    path = write(tmp_path / "poses.csv", given.T_base_flange)
    with pytest.raises(UserError, match=r"squares \(they may be 1\.2\d+ times"):
        check(given, path, PoseFormat(), "hand")


def test_leave_one_out_finds_the_pose_with_the_largest_influence(cell):
    given = cell(6)
    boards = given.boards
    calibration = calibrate_hand_eye(given.T_base_flange, boards, "hand")
    quality = assess(given.T_base_flange, boards, calibration)
    assert not quality.findings
    assert quality.shift < 0.001
    worst = int(quality.leave_one_out.argmax())
    rest = [k for k in range(len(boards)) if k != worst]
    without = calibrate_hand_eye(given.T_base_flange[rest], [boards[k] for k in rest], "hand")
    moved = np.linalg.norm(without.T_mount_cam[:3, 3] - calibration.T_mount_cam[:3, 3])
    assert quality.leave_one_out[worst] == pytest.approx(moved, rel=0.5)


def test_rotations_about_a_single_axis_are_not_trusted(cell):
    given = cell(7, tilt=0.01)  # from straight above, rotated about the optical axis only
    boards = given.boards
    calibration = calibrate_hand_eye(given.T_base_flange, boards, "hand")
    quality = assess(given.T_base_flange, boards, calibration)
    assert any("nearly parallel axes only" in finding for finding in quality.findings)
    named = re.search(r"the flange's (?:(\w) axis|direction \((.*)\))$", quality.next_pose)
    across = np.eye(3)["xyz".index(named[1])] if named[1] else np.fromstring(named[2], sep=",")
    assert abs(across @ given.T_mount_cam[:3, 2]) > 0.9  # the optical axis


def test_the_expected_error_agrees_with_drawn_calibrations():
    rng = np.random.default_rng(0)
    root = 1e-3 * rng.normal(size=(6, 6))
    steps = rng.normal(size=(20000, 6)) @ root.T
    point = np.array([0, 0, 0.5])
    moved = np.cross(steps[:, :3], point) + steps[:, 3:]
    shift, rotation = expected_error(root @ root.T, 0.5)
    assert shift == pytest.approx(np.sqrt((moved**2).sum(axis=1).mean()), rel=0.03)
    assert rotation == pytest.approx(np.sqrt((steps[:, :3] ** 2).sum(axis=1).mean()), rel=0.03)


def test_poses_without_an_image_of_the_board_are_rejected(tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text("name,x,y,z,rx,ry,rz\na.png,0,0,0,0,0,0\n")
    with pytest.raises(UserError, match="no pose has an image that shows the board"):
        check_poses(read_robot_poses(path), [], PoseFormat(), [], "hand")
