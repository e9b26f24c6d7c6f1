"""Commands with a mesh instead of a checkpoint."""

import json

import cv2
import numpy as np
import pytest
import trimesh

from dopepp.parts.catalogue import pivconnector

RELEASED = "pretrained/pivconnector"
RANGE = ("--working-distance", "0.08,0.2")


@pytest.fixture(scope="module")
def folder(rendered, tmp_path_factory):
    folder = tmp_path_factory.mktemp("mesh")
    cv2.imwrite(str(folder / "part.png"), rendered.image[..., ::-1])
    cv2.imwrite(str(folder / "empty.png"), np.full((480, 640, 3), 90, np.uint8))
    np.savetxt(folder / "K.txt", rendered.scene.K)
    mesh = pivconnector().mesh
    trimesh.Trimesh(1000 * mesh.vertices, mesh.faces).export(folder / "piv.stl")
    return folder


@pytest.fixture
def truth(near_truth, rendered, folder, monkeypatch):
    monkeypatch.chdir(folder)
    near_truth.truth = [rendered.scene.objects[rendered.scene.targets[0]].T_cam_obj]
    return near_truth.truth[0]


MESH = ("piv.stl", "part.png", "--camera", "K.txt", "--unit", "mm", *RANGE)


def test_predict_draws_and_writes_the_pose_of_a_mesh(run, truth, tmp_path):
    files = ("--save", tmp_path / "out", "--json", tmp_path / "p.json", "--csv", tmp_path / "p.csv")
    done = run("predict", *MESH, *files, "--verify")
    (line,) = map(json.loads, done.stdout.splitlines())
    assert line["object"] == "piv"
    assert np.abs(np.array(line["T_cam_obj"]) - truth).max() < 0.01
    assert line["score"] > line["probability"] > 0.5  # scores have a silent level of 0
    assert line["agreement"] > 0.5
    assert len(list((tmp_path / "out").iterdir())) == 1
    (written,) = json.loads((tmp_path / "p.json").read_text())["detections"]
    assert written["agreement"] == line["agreement"]
    assert (tmp_path / "p.csv").read_text().count("\n") == 2


def test_predict_finds_nothing_in_an_empty_image_and_searches_once(run, near_truth, truth):
    near_truth.truth = []
    done = run("predict", "pivconnector", "empty.png", "--camera", "K.txt", *RANGE, "--refine",
               "region")  # fmt: skip
    assert done.stdout == ""
    assert "nothing found: no pose at these distances passes the verification;" in done.stderr


def test_node_doctor_and_benchmark_take_a_mesh(run, truth, intrinsics):
    line = run("node", *MESH, "--json").stdout.splitlines()[0]
    assert "piv" in line
    words = ("part.png", "--model", "piv.stl", "--camera", "K.txt", "--unit", "mm", *RANGE)
    lines = run("doctor", *words).stdout.splitlines()
    assert all(line.startswith("ok ") for line in lines), lines
    assert "piv is detected, score" in lines[5]
    words = ("piv.stl", "--unit", "mm", *RANGE, "--image", "part.png", *intrinsics, "-n", 1)
    assert "piv.stl" in run("benchmark", *words).stdout


def test_doctor_reports_that_no_pose_is_verified(run, near_truth, truth):
    near_truth.truth = []
    words = ("part.png", "--model", "pivconnector", "--camera", "K.txt", *RANGE)
    first = run("doctor", *words, code=1).stdout.splitlines()[0]
    assert first.startswith("!! visibility: no pose of pivconnector passes the verification; fix: ")


WRONG = [
    (("piv.stl",), "got a mesh without a working distance"),
    ((RELEASED, *RANGE), f"got --working-distance with the checkpoint {RELEASED}"),
    (("piv.stl", "--working-distance", "0.3"), "got --working-distance 0.3; allowed: NEAR,FAR"),
    (("piv.stl", "--working-distance", "0.5,0.3"), "working_distance=(0.5, 0.3)"),
    (("piv.stl", *RANGE, "--tilt", "200"), "tilt_deg=200"),
    (("piv.stl", *RANGE, "--unit", "feet"), "unit='feet'"),
    (("piv.stl", *RANGE, "--device", "cuda"), "got --device cuda with the mesh piv.stl"),
    (("none.stl", *RANGE), "none.stl, no such file"),
    ((RELEASED, "--tilt", "40"), f"got --tilt with the checkpoint {RELEASED}"),
    ((RELEASED, "--unit", "mm"), f"got --unit with the checkpoint {RELEASED}"),
]


@pytest.mark.parametrize(("command", "words", "message"), [
    *(("predict", *case) for case in WRONG),
    *((command, *case) for command in ("node", "doctor", "benchmark") for case in WRONG[:2]),
])  # fmt: skip
def test_wrong_options_are_one_line(refused, truth, intrinsics, command, words, message):
    model, *options = words
    commands = {
        "predict": (model, "part.png", *intrinsics),
        "node": (model, "part.png", *intrinsics, "--json"),
        "doctor": ("part.png", "--model", model, *intrinsics),
        "benchmark": (model, "--image", "part.png", *intrinsics),
    }
    assert message in refused(command, *commands[command], *options)


def test_wrong_options_of_single_commands_are_one_line(refused, truth):
    for words, message in (
        (("predict", *MESH, "--part", "piv.stl"), "got --part with the mesh piv.stl"),
        (("predict", "piv.stl", *MESH), "got the mesh piv.stl as a source"),
        (("benchmark", "piv.stl", *RANGE), "piv.stl without --image"),
        (
            ("predict", *MESH, "--depth", "d.png", "--refine", "depth"),
            "templates with refine=('depth',)",
        ),
    ):
        assert message in refused(*words)


def test_intrinsics_of_another_size_are_refused_at_once(run, refused, truth, monkeypatch):
    monkeypatch.setattr("dopepp.inference.template_estimator.load_solid_part", None)
    words = ("--K", 2000, 2000, 1999.5, 1499.5, "--unit", "mm", *RANGE)
    assert "K with fx=2000" in refused("predict", "piv.stl", "part.png", *words)
    done = run("doctor", "part.png", "--model", "piv.stl", *words, code=1)
    assert done.stdout.startswith("!! camera: K with fx=2000")


def test_the_page_shows_poses_without_maps(truth, folder, rendered):
    pytest.importorskip("gradio", reason="without the extra web")
    from dopepp import PoseEstimator
    from dopepp.inference.page import _outputs

    estimator = PoseEstimator.from_mesh("piv.stl", "mm", (0.08, 0.2))
    K = rendered.scene.K
    numbers = (None, K[0, 0], K[1, 1], K[0, 2], K[1, 2], None)
    drawn, message, rows, _, maps = _outputs(estimator, folder / "part.png", "K", numbers, folder)
    assert drawn.shape == (480, 640, 3)
    assert [row[0] for row in rows] == ["piv"]
    assert maps is None
    assert "1 pose" in message
