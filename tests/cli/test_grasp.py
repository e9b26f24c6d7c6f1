"""The grasp commands: a few grasps, and wrong options."""

import importlib.util
import json

import mujoco
import pytest
import trimesh


@pytest.fixture(autouse=True)
def _quick_calibration(request, monkeypatch):
    if "slow" not in request.keywords:
        monkeypatch.setattr("dopepp.robot.grasping.rehearsal.VIEWS", 8)


@pytest.fixture
def grasped(run, tmp_path):
    def grasped(*words):
        done = run("grasp", "--out", tmp_path / "out", *words)
        return json.loads((tmp_path / "out" / "grasps.json").read_text()), done.output

    return grasped


def test_a_network_and_exact_poses_grip_the_same_parts(grasped, tmp_path):
    content, output = grasped("-n", 3, "--poses", "network,exact,random", "--workers", 1)
    sources = content["sources"]
    assert sources["network"]["recognised"] == 3
    assert sources["network"]["caught"] >= 2
    assert sources["exact poses"]["caught"] == 3
    assert sources["random poses"]["caught"] <= 1
    assert "94.0 % (89.8 – 96.5)" in output  # the paper's


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("count", [20, 200])
def test_nearly_all_single_parts_are_caught(grasped, tmp_path, count):
    content, _ = grasped("-n", count, "--poses", "network,exact")
    network, exact = (content["sources"][name] for name in ("network", "exact poses"))
    assert network["recognised"] >= 0.95 * count
    assert network["caught"] >= 0.93 * count
    assert exact["caught"] - network["caught"] <= 0.05 * count


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["distractors", "heap"])
def test_other_layouts_end_in_a_report(grasped, tmp_path, layout):
    content, _ = grasped("-n", 3, "--layout", layout, "--poses", "network,exact")
    assert content["layout"] == layout


def test_the_arm_takes_a_second_image_and_states_the_reason(grasped):
    content, output = grasped("-n", 1, "--views", 2, "--poses", "network,exact", "--workers", 1)
    first, exact = content["trials"]
    assert first["caught"]
    assert "reduces the expected error" in first["second_view"]
    assert first["second_view"] in output
    assert exact["second_view"] == ""


@pytest.mark.slow
def test_templates_grip_a_part_without_training(grasped, tmp_path):
    content, output = grasped("-n", 1, "--poses", "templates", "--workers", 1)
    assert content["sources"]["templates"]["caught"] == 1
    assert content["network"] is None
    assert "## Table 9: templates" in output


def test_proposed_grasps_hold_a_new_part(grasped, run, tmp_path):
    trimesh.creation.box((60, 30, 20)).export(tmp_path / "block.stl")
    mesh, grasps = (tmp_path / "block.stl", "--unit", "mm"), tmp_path / "block.yaml"
    assert "grasps" in run("grasp", "propose", *mesh, "--out", grasps).output
    options = ("--poses", "exact", "-n", 2, "--grasps", grasps, "--rest", "any", "--workers", 1)
    content, _ = grasped("--part", *mesh, *options)
    assert content["sources"]["exact poses"]["caught"] == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--layout", "pile"], "--layout pile"),
        (["--renderer", "blender"], "--renderer blender"),
        (["--rest", "back"], "--rest back"),
        (["--poses", "truth"], "--poses truth"),
        (["-n", "0"], "-n=0"),
        (["--views", "3"], "--views=3"),
        (["--views", "2", "--no-refine"], "--views 2 with --no-refine"),
        (["--yaw", "270"], "--yaw=270"),
        (["--part", "gearbox"], "gearbox"),
        (["--network", "pretrained/servoholder"], "was not trained on pivconnector"),
        (["--video", "film.avi"], "film.avi"),
        (["--grasps", "none.yaml"], "none.yaml"),
    ],
)
def test_wrong_options_are_one_line(refused, tmp_path, words, message):
    assert message in refused("grasp", "--out", tmp_path, "--workers", 1, *words)


def test_a_part_without_a_grasp_or_a_network_is_rejected(refused, tmp_path):
    trimesh.creation.box((60, 30, 20)).export(tmp_path / "block.stl")
    words = ["--part", tmp_path / "block.stl", "--unit", "mm", "--out", tmp_path]
    assert "without a network" in refused("grasp", *words)
    line = refused("grasp", *words, "--poses", "exact")
    assert "part block without a grasp" in line
    assert "dopepp grasp propose block" in line


def test_grasps_out_of_reach_are_an_error(run, tmp_path):
    below = "{point: [0, 0, 0], closing: [0, 1, 0], approach: [0, 0, 1], width: 0.052}"
    (tmp_path / "below.yaml").write_text(f"part: pivconnector\ngrasps: [{below}]\n")
    words = ["--poses", "exact", "-n", 2, "--grasps", tmp_path / "below.yaml", "--workers", 1]
    done = run("grasp", *words, "--out", tmp_path / "out", code=2)
    assert "whose grasps were not reachable in any" in done.output


def test_a_missing_extra_is_named(refused, tmp_path, monkeypatch):
    monkeypatch.setattr("dopepp.core.errors.find_spec", lambda name: None)
    assert "dopepp[robot]" in refused("grasp", "--out", tmp_path)


def test_a_missing_viewer_is_an_error_before_the_first_grasp(refused, tmp_path, monkeypatch):
    def find_spec(name):
        return None if name == "rerun" else importlib.util.find_spec(name)

    monkeypatch.setattr("dopepp.core.errors.find_spec", find_spec)
    words = ("--poses", "exact", "-n", 2, "--workers", 1, "--rerun", tmp_path / "film.rrd")
    assert "dopepp[rerun]" in refused("grasp", "--out", tmp_path / "out", *words)
    assert not (tmp_path / "out" / "grasps.json").exists()


@pytest.mark.parametrize("words", [["--video", "film.mp4"], ["--renderer", "mujoco"]])
def test_missing_opengl_is_an_error_before_the_first_grasp(run, tmp_path, monkeypatch, words):
    def fail(*_):
        raise RuntimeError("no EGL display")

    monkeypatch.setattr(mujoco, "Renderer", fail)
    monkeypatch.chdir(tmp_path)
    done = run("grasp", "--out", tmp_path / "out", "--workers", 1, *words, code=2)
    assert "without OpenGL (RuntimeError: no EGL display)" in done.output
    assert not (tmp_path / "out" / "grasps.json").exists()


@pytest.mark.slow
def test_a_film_and_a_recording_show_the_first_grasp(grasped, tmp_path):
    grasped(
        "--poses", "exact", "-n", 1, "--workers", 1,
        "--video", tmp_path / "film.mp4", "--rerun", tmp_path / "film.rrd",
    )  # fmt: skip
    assert (tmp_path / "film.mp4").stat().st_size > 50_000
    assert (tmp_path / "film.rrd").stat().st_size > 1_000_000
