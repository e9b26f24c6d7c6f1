"""The calibration commands on rendered images."""

import csv
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from dopepp.cli.board_images import image_names
from dopepp.core.errors import RunError, UserError
from dopepp.core.files import write_png
from dopepp.geometry.camera import camera_matrix, invert_transform, make_transform
from dopepp.geometry.camera_file import Camera, read_camera
from dopepp.geometry.transform_file import read_transform, transform_record
from dopepp.inference.frames.media import Video
from dopepp.inference.several_views.view_files import read_camera_poses
from dopepp.robot.calibration.board import draw_view, parse_board
from dopepp.robot.calibration.lens import write_camera
from dopepp.robot.calibration.records import write_calibration

SPEC = "charuco:8x6:25:19"
BOARD = parse_board(SPEC)
CAMERA = Camera((640, 480), camera_matrix(560, 560, 322, 236), (0.05, -0.1, 0, 0, 0), "true")


def draw_pose(rng, tilt, spread, distances):
    """Return T_cam_board of a tilted board (radians) whose centre is near the optical axis."""
    rotation = Rotation.from_euler("xyz", rng.uniform(-tilt, tilt, 3)).as_matrix()
    near = np.append(rng.uniform(-spread, spread, 2), rng.uniform(*distances))
    return make_transform(rotation, near - rotation @ BOARD.points.mean(axis=0))


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """A folder with ten images, a video, poses.csv and camera.yaml; the true T_flange_cam."""
    folder, rng = tmp_path_factory.mktemp("cell"), np.random.default_rng(0)
    X = make_transform(Rotation.random(rng=rng).as_matrix(), [0.03, -0.05, 0.08])
    Y = make_transform(Rotation.random(rng=rng).as_matrix(), [0.5, 0.1, 0.02])
    write_camera(folder / "camera.yaml", CAMERA)
    rows, fourcc = [], cv2.VideoWriter_fourcc(*"MJPG")
    video = cv2.VideoWriter(str(folder / "board.avi"), fourcc, 10, CAMERA.size)
    for name in (f"{number}.png" for number in range(10)):
        T_cam_board = draw_pose(rng, 0.5, 0.08, (0.24, 0.32))
        image = draw_view(BOARD, T_cam_board, CAMERA, rng)
        write_png(folder / name, image)
        for _ in range(3):
            video.write(image)
        M = Y @ invert_transform(T_cam_board) @ invert_transform(X)
        quaternion = Rotation.from_matrix(M[:3, :3]).as_quat(scalar_first=True)
        rows.append([name, *(M[:3, 3] + 2e-4 * rng.normal(size=3)), *quaternion])
    video.release()
    with (folder / "poses.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["name", "x", "y", "z", "qw", "qx", "qy", "qz"], *rows])
    return folder, X


@pytest.mark.parametrize("source", ["", "board.avi"])
def test_a_camera_is_calibrated_from_images_or_distinct_views_of_a_video(
    run, cell, tmp_path, source
):
    out = tmp_path / "camera.yaml"
    words = ("--board", SPEC, "--out", out, "--force")
    done = run("calibrate", "camera", cell[0] / source, *words)
    assert "reprojection error 0." in done.output
    assert np.allclose(read_camera(out).K, CAMERA.K, atol=10 if source else 2.5)
    assert not source or "10 distinct views in 15 images" in done.stderr


def test_a_camera_that_stops_is_calibrated_from_its_views(run, cell, tmp_path, monkeypatch):
    whole = Video.frames

    def frames(video, stride=1):
        yield from whole(video, stride)
        raise RunError("camera 0: no image for 5 s")

    monkeypatch.setattr(Video, "frames", frames)
    out = tmp_path / "camera.yaml"
    words = ("--board", SPEC, "--out", out, "--force")
    done = run("calibrate", "camera", cell[0] / "board.avi", *words)
    assert "no image for 5 s; the views so far are used" in done.stderr
    assert out.exists()


def test_the_hand_eye_transform_is_calibrated_and_written(run, cell, tmp_path):
    (folder, X), out = cell, tmp_path / "hand_eye.yaml"
    words = ("--board", SPEC, "--camera", folder / "camera.yaml", "--mount", "hand", "--out", out)
    done = run("calibrate", "handeye", folder, folder / "poses.csv", *words)
    assert "expected error at the board's distance" in done.output
    T = read_transform(out, "T_flange_cam")
    assert np.linalg.norm(T[:3, 3] - X[:3, 3]) < 0.0015
    assert np.degrees(Rotation.from_matrix(T[:3, :3].T @ X[:3, :3]).magnitude()) < 0.2
    content = yaml.safe_load(out.read_text())
    assert (content["trusted"], content["poses_used"]) == (True, 10)
    # A doubtful calibration is written with --force only.
    out.unlink()
    few = tmp_path / "few.csv"
    few.write_text("".join((folder / "poses.csv").read_text().splitlines(True)[:5]))
    done = run("calibrate", "handeye", folder, few, *words, code=2)
    assert "only 4 poses" in done.output
    assert not out.exists()
    run("calibrate", "handeye", folder, few, *words, "--force")
    content = yaml.safe_load(out.read_text())
    assert content["trusted"] is False
    assert "only 4 poses" in content["doubts"][0]


def test_a_tip_and_a_bench_are_written(run, tmp_path):
    rng = np.random.default_rng(0)
    rotations = Rotation.from_euler("xyz", rng.uniform(-0.6, 0.6, (6, 3)))
    positions = np.array([0.4, 0, 0.1]) - rotations.apply([0, 0.01, 0.12])
    rows = np.hstack([1000 * positions, rotations.as_rotvec(degrees=True)])
    np.savetxt(tmp_path / "p.csv", rows, delimiter=",", header="x,y,z,rx,ry,rz", comments="")
    words = ("--unit", "mm", "--angles", "deg", "--out", tmp_path / "tool.yaml")
    run("calibrate", "tcp", tmp_path / "p.csv", *words)
    tip = yaml.safe_load((tmp_path / "tool.yaml").read_text())["tip"]
    assert np.allclose(tip, [0, 0.01, 0.12], atol=1e-6)
    points = np.array([[0, 0, 0], [300, 0, 1], [0, 300, 0], [300, 300, 1.0]])
    np.savetxt(tmp_path / "b.csv", points, delimiter=",", header="x,y,z", comments="")
    out = tmp_path / "bench.yaml"
    run("calibrate", "bench", tmp_path / "b.csv", "--unit", "mm", "--out", out)
    assert read_transform(out, "T_base_bench")[2, 2] > 0.99


def test_a_bench_is_calibrated_from_a_board_on_it(run, refused, cell, tmp_path):
    folder, X = cell
    hand_eye, out = tmp_path / "hand_eye.yaml", tmp_path / "bench.yaml"
    write_calibration(hand_eye, "hand-eye", {"T_flange_cam": transform_record(X)}, (), False)
    words = ("--board", SPEC, "--camera", folder / "camera.yaml", "--out", out)
    options = ("--hand-eye", hand_eye, "--poses", folder / "poses.csv")
    run("calibrate", "bench", folder, *words, *options)
    T = read_transform(out, "T_base_bench")
    assert np.linalg.norm(T[:3, 3] - [0.5, 0.1, 0.02]) < 0.001  # the true position of the board
    for more, message in (
        ((), "--camera and --hand-eye"),
        (("--hand-eye", hand_eye), "without --poses"),
        (("--hand-eye", tmp_path / "none.yaml"), "none.yaml"),
    ):
        assert message in refused("calibrate", "bench", folder, *words, *more)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("board", "chess:8x6:20", "--out", "b.pdf"), "one even and one odd"),
        (("board", "chess:8x5:20", "--out", "b.txt"), ".pdf"),
        (("camera", ".", "--board", SPEC, "--out", "c.yaml"), "without an image"),
        (("camera", ".", "--board", SPEC, "--out", "c.json"), ".yaml"),
        (("tcp", "none.csv", "--out", "t.yaml"), "none.csv"),
        (("tcp", "none.csv", "--out", "t.yaml", "--unit", "feet"), "--unit feet"),
        (("bench", "none.csv", "--out", "t.yaml"), "none.csv"),
        (("bench", ".", "--out", "t.yaml"), "without --board"),
        (("bench", "b.csv", "--camera", "c.yaml", "--out", "t.yaml"), "--camera without --board"),
        (("camera", "none.mp4", "--board", SPEC, "--out", "c.yaml"), "none.mp4"),
        (("tcp", "none.csv", "--out", "t.yaml", "--angles", "grad"), "--angles grad"),
    ],
)
def test_wrong_options_are_one_line(refused, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    assert message in refused("calibrate", *words)


def test_images_are_in_the_order_of_their_numbers(tmp_path):
    for name in ("10.png", "9.png"):
        (tmp_path / name).touch()
    assert image_names(tmp_path) == ["9.png", "10.png"]
    for path in (tmp_path / "9.png", tmp_path / "none"):
        with pytest.raises(UserError, match=f"{path.name}, which is not a folder"):
            image_names(path)


def test_images_without_the_board_are_an_error(run, cell, tmp_path):
    words = ("--board", "chess:9x6:20", "--out", tmp_path / "c.yaml")
    done = run("calibrate", "camera", cell[0], *words, code=2)
    assert "no board in any of 10 images" in done.output


@pytest.fixture(scope="module")
def rig_folder(tmp_path_factory):
    """Images and files of two cameras at five moments, and the true T_left_right."""
    folder, rng = tmp_path_factory.mktemp("rig"), np.random.default_rng(1)
    T_left_right = make_transform(Rotation.from_euler("y", -0.5).as_matrix(), [0.16, 0.0, 0.04])
    poses = {"left": np.eye(4), "right": T_left_right}
    for name in poses:
        (folder / name).mkdir()
        write_camera(folder / f"{name}.yaml", CAMERA)
    for moment in range(5):
        T_left_board = draw_pose(rng, 0.3, 0.02, (0.3, 0.34))
        for name, T in poses.items():
            image = draw_view(BOARD, invert_transform(T) @ T_left_board, CAMERA, rng)
            write_png(folder / name / f"{moment}.png", image)
    return folder, T_left_right


def test_a_rig_is_calibrated_for_several_views(run, rig_folder, tmp_path):
    folder, T_left_right = rig_folder
    T_base_left = make_transform(Rotation.random(rng=0).as_matrix(), [0.5, 0.1, 0.7])
    hand_eye = {"T_base_cam": transform_record(T_base_left)}
    write_calibration(tmp_path / "hand_eye.yaml", "hand-eye", hand_eye, (), False)
    words = ("--board", SPEC, "--out", tmp_path / "rig.yaml")
    done = run("calibrate", "rig", folder, *words, "--hand-eye", tmp_path / "hand_eye.yaml")
    assert "right: 5 images with another camera" in done.output
    poses = read_camera_poses(tmp_path / "rig.yaml")
    left, right = (poses.of(Path(f"{name}.png")) for name in ("left", "right"))
    np.testing.assert_allclose(left.T_world_cam, T_base_left, atol=1e-9)
    T = invert_transform(left.T_world_cam) @ right.T_world_cam
    assert np.linalg.norm(T[:3, 3] - T_left_right[:3, 3]) < 0.001
    assert right.camera.size == (640, 480)
    assert 1e-6 < poses.error[0] < 1e-3
    run("calibrate", "rig", folder, *words[:2], "--out", tmp_path / "left.yaml")
    in_base, in_left = (
        np.array(yaml.safe_load((tmp_path / name).read_text())["views"]["right"]["covariance"])
        for name in ("rig.yaml", "left.yaml")
    )
    axes = np.kron(np.eye(2), T_base_left[:3, :3])
    np.testing.assert_allclose(in_base, axes @ in_left @ axes.T, atol=1e-6 * in_left.max())


def test_a_rig_is_not_trusted_if_its_hand_eye_file_is_not(refused, rig_folder, tmp_path):
    doubtful, out = tmp_path / "hand_eye.yaml", tmp_path / "rig.yaml"
    record = {"T_base_cam": transform_record(np.eye(4))}
    write_calibration(doubtful, "hand-eye", record, ["few poses"], True)
    words = ("--board", SPEC, "--hand-eye", doubtful, "--out", out)
    assert f"{doubtful} is not trusted" in refused("calibrate", "rig", rig_folder[0], *words)


def test_the_error_of_a_faulty_rig_names_the_camera(run, refused, rig_folder, tmp_path):
    rig, out = tmp_path / "rig", tmp_path / "rig.yaml"
    shutil.copytree(rig_folder[0], rig)
    words = ("calibrate", "rig", rig, "--board", SPEC, "--out", out)
    for path in sorted((rig / "right").iterdir())[2:]:
        path.unlink()
    assert "right sees the board with another camera 2 times" in refused(*words)
    assert not out.exists()
    for path in (rig / "right").iterdir():
        path.rename(path.with_stem(f"other_{path.stem}"))
    assert "right without images of the board at the same moments as left" in refused(*words)
    (rig / "right.yaml").unlink()
    assert "right.yaml" in refused(*words)
    shutil.rmtree(rig / "right")
    assert "a rig of 1 cameras" in refused(*words)
