import json
import re

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.robot.calibration.records import PoseFormat, match_images, read_points, read_robot_poses

ROTATION = Rotation.from_euler("xyz", [0.3, -0.5, 1.2])
POSITION = [0.4, -0.1, 0.3]


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        ("qw qx qy qz", ROTATION.as_quat(scalar_first=True)),
        ("rx ry rz", ROTATION.as_rotvec()),
        ("roll pitch yaw", ROTATION.as_euler("xyz")),
    ],
    ids=["quaternion", "rotation vector", "angles"],
)
@pytest.mark.parametrize("suffix", [".csv", ".json", ".yaml"])
def test_a_pose_is_the_same_in_every_format(tmp_path, names, numbers, suffix):
    values = ["a.png", *POSITION, *numbers.tolist()]
    fields = dict(zip(["name", "x", "y", "z", *names.split()], values, strict=True))
    path = tmp_path / f"poses{suffix}"
    if suffix == ".csv":
        text = ";".join(fields) + "\n" + ";".join(map(str, fields.values())) + "\n"
    else:
        text = (json.dumps if suffix == ".json" else yaml.safe_dump)([fields])
    path.write_text(text)
    poses = read_robot_poses(path)
    T = poses.transforms(PoseFormat())[0]
    assert poses.names == ("a.png",)
    assert np.allclose(T[:3, :3], ROTATION.as_matrix())
    assert np.allclose(T[:3, 3], POSITION)
    assert np.allclose(poses.transforms(PoseFormat(inverted=True))[0] @ T, np.eye(4))


def test_a_matrix_replaces_position_and_rotation(tmp_path):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = ROTATION.as_matrix(), POSITION
    (tmp_path / "poses.json").write_text(json.dumps({"a.png": {"matrix": T.tolist()}}))
    poses = read_robot_poses(tmp_path / "poses.json")
    assert poses.names == ("a.png",)
    assert np.allclose(poses.transforms(PoseFormat())[0], T)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("p.txt", "", "a .csv, .json or .yaml file"),
        ("p.csv", "", "without a pose"),
        ("p.csv", "x,y,z\n1,2,3\n", "qw, qx, qy, qz or"),
        ("p.csv", "x,y,z\n" + 200_000 * "1", "field larger than field limit"),
        ("p.csv", "x,y,z,rx,ry,rz\n1,2,3,0,0,nan\n", "pose 1: rz='nan'"),
        ("p.csv", "x,y,z,rx,ry,rz\n1,2,3,0,0\n", "pose 1: rz=None"),
        ("p.csv", "x,y,z,qw,qx,qy,qz\n1,2,3,0,0,0,0\n", "unit quaternions"),
        ("p.json", "[1, 2]", "not a list of records"),
        ("p.json", '[{"matrix": [[1, 2], [3, 4]]}]', "4×4 numbers"),
        ("p.json", '[{"matrix": "x"}]', "4×4 numbers"),
        ("p.yaml", "&a [*a]", "anchors"),
        ("p.yaml", "!!python/object/apply:os.system ['true']", "anchors and tags"),
    ],
)
def test_an_invalid_file_is_rejected_in_one_line(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match=re.escape(message)) as error:
        read_robot_poses(tmp_path / name)
    assert "\n" not in str(error.value)


def test_poses_are_paired_with_their_images(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("image,x,y,z,rx,ry,rz\nb,1,2,3,0,0,0\na,1,2,3,0,0,0\n")
    pairs = match_images(read_robot_poses(path), ["a.png", "b.png", "c.png"])
    assert pairs == {"b.png": 0, "a.png": 1}
    with pytest.raises(UserError, match="the first 'b'"):
        match_images(read_robot_poses(path), ["a.png"])
    path.write_text("image,x,y,z,rx,ry,rz\nb,1,2,3,0,0,0\nb.png,4,5,6,0,0,0\n")
    with pytest.raises(UserError, match=r"2 poses of the image b\.png"):
        match_images(read_robot_poses(path), ["a.png", "b.png"])
    path.write_text("x,y,z,rx,ry,rz\n1,2,3,0,0,0\n")
    assert match_images(read_robot_poses(path), ["a.png"]) == {"a.png": 0}
    with pytest.raises(UserError, match="1 poses and 2 images"):
        match_images(read_robot_poses(path), ["a.png", "b.png"])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("p.csv", "X, Y, Z, RX, RY, RZ, Name\n1, 2, 3, 0, 0, 0, 1\n1, 2, 3, 0, 0, 0, 0 \n"),
        ("p.json", '[{"Name": "1", "X": 1, "Y": 2, "Z": 3, "RX": 0, "RY": 0, "RZ": 0},'
         '{"Name": 0, "X": 1, "Y": 2, "Z": 3, "RX": 0, "RY": 0, "RZ": 0}]'),
        ("p.yaml", "1: {x: 1, y: 2, z: 3, rx: 0, ry: 0, rz: 0}\n"
         "0: {x: 1, y: 2, z: 3, rx: 0, ry: 0, rz: 0}\n"),
    ],
)  # fmt: skip
def test_names_may_be_numbers_and_fields_in_capitals(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    pairs = match_images(read_robot_poses(tmp_path / name), ["0.png", "1.png"])
    assert pairs == {"1.png": 0, "0.png": 1}


def test_touched_points_need_named_columns_of_any_separator(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text("x;y;z\n1;2;3\n")
    assert np.allclose(read_points(path, "mm"), [[0.001, 0.002, 0.003]])
    path.write_text("1,2,3\n4,5,6\n")
    with pytest.raises(UserError, match="the columns 1, 2, 3; allowed: columns x, y and z"):
        read_points(path, "mm")


def test_lines_may_end_with_a_carriage_return(tmp_path):
    (tmp_path / "points.csv").write_bytes(b"x;y;z\r1;2;3\r4;5;6\r")
    points = read_points(tmp_path / "points.csv", "m")
    assert points.tolist() == [[1, 2, 3], [4, 5, 6]]
