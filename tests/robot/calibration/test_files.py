import json
import re

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.robot.calibration.records import PoseFormat, match_images, read_robot_poses

TURN = Rotation.from_euler("xyz", [0.3, -0.5, 1.2])
AT = [0.4, -0.1, 0.3]


def record():
    return {"name": "a.png", "x": AT[0], "y": AT[1], "z": AT[2]}


RECORDS = [
    dict(zip(("qw", "qx", "qy", "qz"), TURN.as_quat(scalar_first=True).tolist(), strict=True)),
    dict(zip(("rx", "ry", "rz"), TURN.as_rotvec().tolist(), strict=True)),
    dict(zip(("roll", "pitch", "yaw"), TURN.as_euler("xyz").tolist(), strict=True)),
]


@pytest.mark.parametrize("rotation", RECORDS)
@pytest.mark.parametrize("suffix", [".csv", ".json", ".yaml"])
def test_a_pose_is_the_same_in_every_format(tmp_path, rotation, suffix):
    path, whole = tmp_path / f"poses{suffix}", {**record(), **rotation}
    if suffix == ".csv":
        text = ";".join(whole) + "\n" + ";".join(map(str, whole.values())) + "\n"
    else:
        text = (json.dumps if suffix == ".json" else yaml.safe_dump)([whole])
    path.write_text(text)
    poses = read_robot_poses(path)
    T = poses.transforms(PoseFormat())[0]
    assert poses.names == ("a.png",)
    assert np.allclose(T[:3, :3], TURN.as_matrix())
    assert np.allclose(T[:3, 3], AT)
    assert np.allclose(poses.transforms(PoseFormat(inverted=True))[0] @ T, np.eye(4))


def test_a_matrix_stands_for_both(tmp_path):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = TURN.as_matrix(), AT
    (tmp_path / "poses.json").write_text(json.dumps({"a.png": {"matrix": T.tolist()}}))
    poses = read_robot_poses(tmp_path / "poses.json")
    assert poses.names == ("a.png",)
    assert np.allclose(poses.transforms(PoseFormat())[0], T)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("p.txt", "", "a .csv, .json or .yaml file"),
        ("p.csv", "", "without a pose"),
        ("p.csv", "x,y,z\n1,2,3\n", "qw, qx, qy, qz or"),
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
def test_a_file_that_is_none_is_refused_in_one_line(tmp_path, name, text, said):
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match=re.escape(said)) as caught:
        read_robot_poses(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_poses_go_with_their_pictures(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("image,x,y,z,rx,ry,rz\nb,1,2,3,0,0,0\na,1,2,3,0,0,0\n")
    assert match_images(read_robot_poses(path), ["a.png", "b.png", "c.png"]) == [(0, 1), (1, 0)]
    with pytest.raises(UserError, match="the first 'b'"):
        match_images(read_robot_poses(path), ["a.png"])
    path.write_text("x,y,z,rx,ry,rz\n1,2,3,0,0,0\n")
    assert match_images(read_robot_poses(path), ["a.png"]) == [(0, 0)]
    with pytest.raises(UserError, match="1 poses and 2 images"):
        match_images(read_robot_poses(path), ["a.png", "b.png"])
