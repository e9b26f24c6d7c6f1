"""Files of camera poses in three formats, written here by independent code."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.geometry.transform_file import ROUNDED, parse_transform, read_transform
from dopepp.inference.several_views.view_files import read_camera_poses

TURN = Rotation.from_euler("xyz", [20, -30, 140], degrees=True)
SHIFT = np.array([0.3, -0.2, 0.7])
T_WORLD_CAM = np.eye(4)
T_WORLD_CAM[:3, :3], T_WORLD_CAM[:3, 3] = TURN.as_matrix(), SHIFT
X, Y, Z, W = TURN.as_quat().tolist()
FORMS = (
    {"matrix": T_WORLD_CAM.tolist()},
    {"translation": dict(zip("xyz", SHIFT.tolist(), strict=True)),
     "rotation": {"x": X, "y": Y, "z": Z, "w": W}},
    {"position": SHIFT.tolist(), "quaternion_wxyz": [W, X, Y, Z]},
    {"position": SHIFT.tolist(), "quaternion_xyzw": [X, Y, Z, W]},
)  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_a_pose_is_read(form):
    assert_allclose(parse_transform(form, "here"), T_WORLD_CAM, atol=1e-12)


@pytest.mark.parametrize(
    "form",
    [None, {}, [1, 2], {"matrix": (2 * T_WORLD_CAM).tolist()}, {"matrix": np.eye(3).tolist()},
     {"position": [0, 0], "quaternion_wxyz": [1, 0, 0, 0]}, {"position": [0, 0, float("nan")],
     "quaternion_wxyz": [1, 0, 0, 0]}, {"position": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 0]},
     {"position": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1, 0]}, {"matrix": [[10**400] * 4] * 4},
     {"translation": {"x": 0, "y": 0}, "rotation": {"x": 0, "y": 0, "z": 0, "w": 1}}],
)  # fmt: skip
def test_other_forms_are_rejected(form):
    with pytest.raises(UserError, match="here"):
        parse_transform(form, "here")


def test_matrices_of_calibrations_must_be_exact(tmp_path):
    path = tmp_path / "hand_eye.yaml"
    rounded = T_WORLD_CAM.copy()
    rounded[0, 0] += 1e-4
    path.write_text(yaml.safe_dump({"T_flange_cam": {"matrix": rounded.tolist()}}))
    with pytest.raises(UserError, match=r"hand_eye\.yaml: T_flange_cam"):
        read_transform(path, "T_flange_cam")
    assert_allclose(read_transform(path, "T_flange_cam", ROUNDED), T_WORLD_CAM, atol=2e-4)
    with pytest.raises(UserError, match=r"the fields T_flange_cam;.* --mount bench"):
        read_transform(path, "T_base_cam")


def test_camera_of_all_views_or_of_a_single_view(tmp_path):
    (tmp_path / "one.txt").write_text("600 601 319.5 239.5")
    (tmp_path / "two.txt").write_text("700 701 319.5 239.5")
    views = {
        "a.png": {"T_world_cam": FORMS[0]},
        "b.png": {"T_world_cam": FORMS[1], "camera": "two.txt"},
    }
    content = {"camera": "one.txt", "camera_error": [3e-4, 0.05], "views": views}
    (tmp_path / "views.yaml").write_text(yaml.safe_dump(content))
    poses = read_camera_poses(tmp_path / "views.yaml")
    assert poses.error == pytest.approx((3e-4, np.radians(0.05)))
    first, second = poses.of(tmp_path / "a.png"), poses.of(tmp_path / "b.png")
    assert (first.camera.K[0, 0], second.camera.K[0, 0]) == (600, 700)
    assert_allclose(second.T_world_cam, T_WORLD_CAM, atol=1e-12)
    with pytest.raises(UserError, match=r"pose for c\.png"):
        poses.of(tmp_path / "c.png")


def test_flange_poses_require_the_hand_eye_result(tmp_path):
    T_flange_cam = np.eye(4)
    T_flange_cam[:3, 3] = 0.01, 0.02, 0.03
    hand_eye = {"T_flange_cam": {"matrix": T_flange_cam.tolist()}}
    (tmp_path / "hand_eye.yaml").write_text(yaml.safe_dump(hand_eye))
    path, views = tmp_path / "views.yaml", {"a.png": {"T_base_flange": FORMS[0]}}
    path.write_text(yaml.safe_dump({"hand_eye": "hand_eye.yaml", "views": views}))
    pose = read_camera_poses(path).of(tmp_path / "a.png")
    assert_allclose(pose.T_world_cam, T_WORLD_CAM @ T_flange_cam, atol=1e-12)
    path.write_text(yaml.safe_dump({"views": views}))
    with pytest.raises(UserError, match="T_world_cam"):
        read_camera_poses(path)


def test_a_bop_scene_has_camera_poses(tmp_path):
    T_cam_world = np.linalg.inv(T_WORLD_CAM)
    record = {
        "cam_K": [600, 0, 320, 0, 600, 240, 0, 0, 1],
        "cam_R_w2c": T_cam_world[:3, :3].ravel().tolist(),
        "cam_t_w2c": (1000 * T_cam_world[:3, 3]).tolist(),
    }
    path = tmp_path / "scene_camera.json"
    path.write_text(json.dumps({"12": record}))
    pose = read_camera_poses(path).of(tmp_path / "rgb/000012.png")
    assert_allclose(pose.T_world_cam, T_WORLD_CAM, atol=1e-12)
    assert pose.camera.K[0, 2] == 320
    path.write_text(json.dumps({"12": {"cam_K": record["cam_K"]}}))
    with pytest.raises(UserError, match="cam_R_w2c"):
        read_camera_poses(path)


def test_a_colmap_model_has_camera_poses(tmp_path):
    inverse = TURN.inv()
    x, y, z, w = inverse.as_quat()
    shift = " ".join(map(str, -inverse.apply(SHIFT)))
    (tmp_path / "cameras.txt").write_text("# cameras\n3 PINHOLE 640 480 600 601 320 240\n")
    (tmp_path / "images.txt").write_text(
        f"# images\n1 {w} {x} {y} {z} {shift} 3 shots/a b.png\n10.5 20.5 -1\n"
        "2 1 0 0 0 0 0 0 3 c.png\n\n"
    )
    poses = read_camera_poses(tmp_path / "images.txt")
    pose = poses.of(tmp_path / "a b.png")
    assert_allclose(pose.T_world_cam, T_WORLD_CAM, atol=1e-12)
    assert pose.camera.K[0].tolist() == [600, 0, 319.5]  # COLMAP's pixels start at a corner
    assert_allclose(poses.of(tmp_path / "c.png").T_world_cam, np.eye(4))
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 4 a.png\n\n")
    with pytest.raises(UserError, match="CAMERA_ID"):
        read_camera_poses(tmp_path / "images.txt")


def test_images_of_one_name_have_the_poses_of_their_folders(tmp_path):
    (tmp_path / "cameras.txt").write_text("3 PINHOLE 640 480 600 601 320 240\n")
    path = tmp_path / "images.txt"
    path.write_text("1 1 0 0 0 0 0 0 3 left/1.png\n\n2 1 0 0 0 -2 0 0 3 right/1.png\n\n")
    poses = read_camera_poses(path)
    shifts = [poses.of(Path("rig", side, "1.png")).T_world_cam[0, 3] for side in ("left", "right")]
    assert shifts == [0, 2]
    with pytest.raises(UserError, match="without a camera pose for 1"):
        poses.of(tmp_path / "1.png")
    path.write_text("1 1 0 0 0 0 0 0 3 left/0.png\n\n2 1 0 0 0 -2 0 0 3 right/1.png\n\n")
    with pytest.raises(UserError, match="without a camera pose for 1"):
        read_camera_poses(path).of(tmp_path / "left" / "1.png")


def test_cameras_with_numbers_as_names_have_the_poses_of_their_folders(tmp_path):
    views = {"0": {"T_world_cam": FORMS[0]}, "1": {"T_world_cam": {"matrix": np.eye(4).tolist()}}}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump({"views": views}))
    poses = read_camera_poses(tmp_path / "rig.yaml")
    for name in ("0001.png", "0.png"):
        assert_allclose(poses.of(tmp_path / "1" / name).T_world_cam, np.eye(4))
        assert_allclose(poses.of(tmp_path / "0" / name).T_world_cam, T_WORLD_CAM, atol=1e-12)
