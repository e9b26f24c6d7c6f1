"""``dopepp predict`` with a released network and several cameras."""

import errno
import json
import re
import shutil
import time

import cv2
import numpy as np
import pytest
import torch

from dopepp.geometry.camera import make_transform
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual import PRESETS, Factory, render
from dopepp.virtual.sensor import capture

RELEASED = "pretrained/pivconnector"
LENS = np.array([-0.25, 0.1, 0.001, -0.002, 0.0])


@pytest.fixture(scope="session")
def poses(run):
    def poses(*words):
        lines = run("predict", RELEASED, *words).stdout.splitlines()
        return [np.array(json.loads(line)["T_cam_obj"]) for line in lines]

    return poses


@pytest.fixture(scope="module")
def folder(rendered, tmp_path_factory):
    """Images of a part with different sizes, depths and lenses, and files of their cameras."""
    folder = tmp_path_factory.mktemp("images")
    image, K = rendered.image[..., ::-1], rendered.scene.K
    pixels = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), -1).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(pixels, K, LENS, P=K).reshape(480, 640, 2)
    written = {
        "whole.png": image,
        "deep.png": 257 * image.astype(np.uint16),
        "lens.png": cv2.remap(image, straight.astype(np.float32), None, cv2.INTER_LINEAR),
        "half.png": cv2.resize(image, (320, 240), interpolation=cv2.INTER_AREA),
        "cut.png": image[:400, 8:],
        "grey.png": cv2.cvtColor(image, cv2.COLOR_BGR2GRAY),
        "4k.png": cv2.resize(image, (3840, 2160)),
        "dot.png": image[:1, :1],
        "empty.png": np.full_like(image, 90),
        "corner.png": image[400:, :200],
    }
    for name, content in written.items():
        cv2.imwrite(str(folder / name), content)
    cv2.imwrite(str(folder / "anim.gif"), image)
    storage = cv2.FileStorage(str(folder / "lens.yaml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", LENS)
    storage.release()
    np.savetxt(folder / "K.txt", K)
    (folder / "plain.json").write_text(
        json.dumps({"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "width": 640,
                    "height": 480, "depth_scale": 1.0})
    )  # fmt: skip
    return folder


def test_a_camera_file_and_k_give_the_same_pose(poses, folder, intrinsics):
    (expected,) = poses(folder / "whole.png", *intrinsics)
    for name in ("K.txt", "plain.json"):
        (result,) = poses(folder / "whole.png", "--camera", folder / name)
        np.testing.assert_allclose(result, expected, atol=1e-9)
    (deep,) = poses(folder / "deep.png", *intrinsics)
    np.testing.assert_allclose(deep, expected, atol=1e-9)


def test_resized_and_cropped_images_give_the_same_pose(poses, folder, intrinsics, rendered):
    true = rendered.scene.objects[rendered.scene.targets[0]].T_cam_obj[:3, 3]
    plain = ("--camera", folder / "plain.json", "--refine", "region")
    for name, options in (
        ("half.png", ("--K-size", 640, 480)),
        ("cut.png", ("--crop", 8, 0, 632, 400)),
    ):
        (result,) = poses(folder / name, *plain, *options)
        assert np.linalg.norm(result[:3, 3] - true) < 0.001


def test_the_distortion_of_the_lens_is_corrected(poses, folder, rendered, tmp_path):
    true = rendered.scene.objects[rendered.scene.targets[0]].T_cam_obj[:3, 3]
    image, refine = folder / "lens.png", ("--refine", "region")
    lens = ("--camera", folder / "lens.yaml", *refine, "--save", tmp_path)
    (result,) = poses(image, *lens)
    assert np.linalg.norm(result[:3, 3] - true) < 0.0005
    without = poses(image, "--camera", folder / "K.txt", *refine)
    assert all(np.linalg.norm(item[:3, 3] - true) > 0.001 for item in without)
    drawn = tmp_path / "lens.png"
    # The overlay shows the undistorted image, which equals the rendered image.
    shown = cv2.imread(str(drawn))[200:450, 20:300, ::-1].astype(float)
    assert np.abs(shown - rendered.image[200:450, 20:300]).mean() < 12


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("whole.png", ["--camera", "K.txt", "--K", "9", "9", "9", "9"], "--K and --camera"),
        ("whole.png", ["--camera", "none.yaml"], "none.yaml: No such file"),
        ("whole.png", ["--camera", "whole.png"], "camera file"),
        ("half.png", ["--camera", "K.txt"], "at 100% of its width"),
        ("cut.png", ["--camera", "plain.json"], "--crop X Y 632 400 if it was cropped"),
        ("4k.png", ["--camera", "K.txt"], "likely of 640×480"),
        ("whole.png", ["--K", "0.1", "0.1", "319.5", "239.5"], "field of view of 5° – 150°"),
        ("anim.gif", ["--camera", "K.txt"], "magick anim.gif image.png"),
        ("whole.png", ["--camera", "K.txt", "--device", "nope"], "device nope ("),
        pytest.param(
            "whole.png",
            ["--camera", "K.txt", "--device", "cuda"],
            "device cuda (",
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="it has CUDA"),
        ),
        ("97", ["--camera", "K.txt"], "got camera 97, which cannot be opened"),
    ],
)
def test_wrong_input_is_one_line(refused, folder, name, options, message, monkeypatch):
    monkeypatch.chdir(folder)
    line = refused("predict", RELEASED, name, *options)
    assert line.startswith("got ")
    assert message in line


@pytest.mark.parametrize(
    ("option", "name", "message"),
    [
        ("--save", "file", "file"),
        ("--save", "/proc/none", "No such file"),
        ("--json", "", "Is a directory"),
        ("--csv", "poses.txt", ".csv"),
    ],
)
def test_output_paths_are_checked_before_the_network_is_loaded(
    refused, folder, intrinsics, option, name, message, tmp_path, monkeypatch
):
    def load(*_: object, **__: object) -> None:
        raise AssertionError("the work has begun")

    monkeypatch.setattr("dopepp.inference.estimator.PoseEstimator.load", load)
    (tmp_path / "file").touch()
    words = (folder / "whole.png", *intrinsics, option, tmp_path / name)
    assert message in refused("predict", RELEASED, *words)


@pytest.mark.parametrize(
    ("name", "camera", "silent"),
    [
        ("grey.png", (554, 416, 319.5, 239.5), False),
        ("empty.png", (554, 416, 319.5, 239.5), True),
        ("corner.png", (554, 416, 99.5, 39.5), False),
        ("4k.png", (3326, 1871, 1919.5, 1079.5), False),
        ("dot.png", (1, 1, 0, 0), True),
        ("whole.png", (1108, 832, 319.5, 239.5), False),
        ("whole.png", (277, 208, 319.5, 239.5), False),
    ],
)
def test_every_image_has_poses_or_a_reason_in_time(run, folder, name, camera, silent):
    """Refine the poses; ``silent`` means that the image shows no part."""
    start = time.process_time()
    done = run("predict", RELEASED, folder / name, "--K", *camera, "--refine", "region")
    assert time.process_time() - start < 60
    assert not (silent and done.stdout)
    if not done.stdout:
        weaker = r"(; \d+ weaker below [\d.]+ \(--conf [\d.]+ shows them\))?"
        assert re.match(rf"nothing found{weaker}: pivconnector: ", done.stderr)
        assert any(word in done.stderr for word in ("belief", "score", "points", "pose"))
        assert done.stderr.count("\n") == 1


def test_several_views_of_a_scene(run, tmp_path):
    scene = Factory([pivconnector()], PRESETS["quickstart"].reframed(640, 480), 2).scene(0, 9)
    target = scene.objects[scene.targets[0]].T_cam_obj
    rotation = rotation_vector_to_matrix(np.array([0.0, 0.4, 0.0]))
    T_new_cam = make_transform(rotation, target[:3, 3] - rotation @ target[:3, 3])
    views = {}
    for name, T in (("a.png", np.eye(4)), ("b.png", T_new_cam)):
        view = scene.seen_from(T)
        cv2.imwrite(str(tmp_path / name), capture(render(view).image, view.sensor)[..., ::-1])
        views[name] = {"T_world_cam": {"matrix": np.linalg.inv(T).tolist()}}
    np.savetxt(tmp_path / "K.txt", scene.K)
    path = tmp_path / "views.yaml"
    path.write_text(json.dumps({"camera": "K.txt", "views": views}))  # JSON is YAML
    images = [tmp_path / name for name in views]
    outputs = ("--save", tmp_path / "out", "--json", tmp_path / "scene.json")
    done = run("predict", RELEASED, *images, "--views", path, *outputs)
    record = json.loads(done.stdout)
    assert np.linalg.norm(np.array(record["T_world_obj"]) - target, axis=0)[3] < 5e-4
    assert [view["status"] for view in record["views"]] == ["supports", "supports"]
    assert "1 part: 2 of 2 views" in done.stderr
    assert json.loads((tmp_path / "scene.json").read_text())["detections"] == [record]
    drawn = sorted(file.name for file in (tmp_path / "out").iterdir())
    assert drawn == ["0_a.png", "1_b.png"]

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dopepp.core.files.Path.write_bytes", full)
        for option, name in (("--save", "out"), ("--json", "scene.json")):
            words = (*images, "--views", path, option, tmp_path / name)
            done = run("predict", RELEASED, *words, code=1)
            line = f"no space left for {tmp_path / name}: free some disk space"
            assert done.stderr.splitlines()[-1] == line
    for name in views:  # a folder for each camera, as for a rig
        (tmp_path / name[0]).mkdir()
        shutil.copy(tmp_path / name, tmp_path / name[0] / "7.png")
    rig = {"camera": "K.txt", "views": {name[0]: view for name, view in views.items()}}
    (tmp_path / "rig.yaml").write_text(json.dumps(rig))
    folders = [tmp_path / name / "7.png" for name in "ab"]
    again = run("predict", RELEASED, *folders, "--views", tmp_path / "rig.yaml")
    assert [view["image"] for view in json.loads(again.stdout)["views"]] == ["a/7.png", "b/7.png"]
    folders, rig_path = [tmp_path / name for name in "ab"], tmp_path / "rig.yaml"
    for folder in folders:
        shutil.copy(folder / "7.png", folder / "8.png")
    command = ("predict", RELEASED, *folders, "--views", rig_path, "--track")
    tracked = run(*command, "--save", tmp_path / "drawn", "--json", tmp_path / "sets.json")
    lines = [json.loads(line) for line in tracked.stdout.splitlines()]
    assert [(line["number"], line["identity"]) for line in lines] == [(0, 0), (1, 0)]
    assert np.linalg.norm(np.array(lines[1]["T_world_obj"]) - target, axis=0)[3] < 5e-4
    written = [json.loads(line) for line in (tmp_path / "sets.json").read_text().splitlines()]
    assert [line["number"] for line in written] == [0, 1]
    assert [line["images"] for line in written] == [["a/7.png", "b/7.png"], ["a/8.png", "b/8.png"]]
    files = {str(file.relative_to(tmp_path / "drawn")) for file in tmp_path.glob("drawn/*/*")}
    assert files == {"0_a/7.png", "0_a/8.png", "1_b/7.png", "1_b/8.png"}
    (folders[1] / "8.png").unlink()
    assert "with 2 frames and" in run(*command, code=2).stderr
    views["b.png"]["T_world_cam"]["matrix"][0][3] += 0.05
    path.write_text(json.dumps({"camera": "K.txt", "views": views}))
    done = run("predict", RELEASED, *images, "--views", path)
    assert done.stdout == ""
    assert "a camera pose is wrong" in done.stderr
    for source, problem in ((images[0], "1 image;"), ("97", "a recording or a camera;")):
        assert problem in run("predict", RELEASED, source, "--views", path, code=2).stderr
    path.write_text(json.dumps({"views": views}))
    assert "--camera" in run("predict", RELEASED, *images, "--views", path, code=2).stderr
