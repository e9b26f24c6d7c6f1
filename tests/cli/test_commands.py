import json
import logging
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from dopepp.cli import network_commands
from dopepp.inference import benchmark
from dopepp.models.checkpoint import Checkpoint
from dopepp.models.network import build_network
from dopepp.models.storage import write_atomic
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual import PRESETS, Factory

K = ["--K", "100", "100", "31.5", "31.5"]
RENDER = ["render", "servoholder", "--preset", "quickstart", "--size", "32x24", "--format", "ndds"]


@pytest.fixture
def checkpoint(tiny_spec, tmp_path):
    weights, recovery = build_network(tiny_spec).state_dict(), {"peak_threshold": 1e-4}
    content = Checkpoint(tiny_spec, weights, [pivconnector()], (64, 64), 8, 1.0, recovery)
    write_atomic(content.to_file(), tmp_path / "best.ckpt")
    return tmp_path / "best.ckpt"


@pytest.fixture
def image_file(tmp_path):
    path = tmp_path / "image.png"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8))
    return path


def test_predict_verifies_and_refines(run, checkpoint, image_file, tmp_path):
    depth = tmp_path / "depth.png"
    cv2.imwrite(str(depth), np.full((64, 64), 500, np.uint16))
    measured = ("--depth", depth)
    for options in (("depth", *measured), ("region",), ("region,depth", *measured)):
        done = run("predict", checkpoint, image_file, *K, "--verify", "--refine", *options)
        for line in done.stdout.splitlines():
            assert 0 <= json.loads(line)["agreement"] <= 1
            assert json.loads(line)["kept"]  # a pose on noise is reported


def test_every_zeroth_frame_is_a_wrong_option(run, checkpoint, image_file):
    done = run("predict", checkpoint, image_file, *K, "--stride", 0, code=2)
    assert "--stride" in done.stderr


def test_the_benchmark_refines_by_region_only(refused, checkpoint):
    assert "--refine depth; allowed: region" in refused(
        "benchmark", checkpoint, "--refine", "depth"
    )


def test_the_benchmark_compares_a_checkpoint_with_a_mesh(run, image_file, monkeypatch):
    loaded = []
    step = np.ones(2)
    monkeypatch.setattr(
        network_commands.options, "load_estimator", lambda path, *given: loaded.append(given)
    )
    monkeypatch.setattr(benchmark, "time_frames", lambda *_: benchmark.Timing(1, step, {}, 1))
    words = ("best.ckpt", "part.stl", "--image", image_file, *K)
    run("benchmark", *words, "--unit", "mm", "--working-distance", "0.3,0.5", "--tilt", 60)
    assert loaded == [("cpu", None, None, None), ("cpu", "mm", "0.3,0.5", 60)]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--refine", "depth"], "--refine depth without --depth"),
        (["--depth", "d.png"], "--depth without --refine depth"),
        (["--refine", "icp"], "refine=('icp',)"),
        (["--refine", "region,"], "refine=('region', '')"),
        (["--track", "--verify"], "--track with --verify"),
        (["--track", "--refine", "nonsense"], "--track with --refine nonsense"),
        (["--views", "v.yaml", "--refine", "nonsense"], "--views with --refine nonsense"),
        (["--part", "x=servoholder"], "not in the checkpoint"),
        (["--refine", "depth", "--depth", "missing.png"], "missing.png"),
    ],
)
def test_wrong_options_of_predict_are_one_line(refused, checkpoint, image_file, options, message):
    assert message in refused("predict", checkpoint, image_file, *K, *options)
    assert refused("predict", image_file, image_file, *K, *options).startswith("got ")


def test_predict_tracks_parts_through_a_folder(run, refused, tmp_path):
    released = Path("pretrained", "pivconnector")
    rendered = Factory([pivconnector()], PRESETS["quickstart"].reframed(640, 480), 2).render(0, 6)
    frames, drawn = tmp_path / "frames", tmp_path / "drawn"
    frames.mkdir()
    for number in range(3):
        cv2.imwrite(str(frames / f"{number:03d}.png"), rendered.image[..., ::-1])
    (frames / "notes.txt").write_text("no frame")
    camera = rendered.scene.K[[0, 1, 0, 1], [0, 1, 2, 2]]
    done = run("predict", released, frames, "--K", *camera, "--track", "--save", drawn)
    records = [json.loads(line) for line in done.stdout.splitlines()]
    assert [Path(entry["image"]).name for entry in records] == ["000.png", "001.png", "002.png"]
    assert {entry["identity"] for entry in records} == {0}
    true = rendered.scene.objects[rendered.scene.targets[0]].T_cam_obj
    for record in records:
        assert np.linalg.norm(np.array(record["T_cam_obj"])[:3, 3] - true[:3, 3]) < 0.003
    assert len(list(drawn.iterdir())) == 3
    assert "without an image" in refused("predict", released, drawn.parent, "--K", *camera)


def test_compare_lists_an_unfinished_run(run, refused, tmp_path):
    (tmp_path / "run" / ".hydra").mkdir(parents=True)
    run("compare", tmp_path / "run", "--out", tmp_path / "out")
    assert "unfinished" in (tmp_path / "out" / "compare.md").read_text()
    assert "missing, which holds no run" in refused("compare", tmp_path / "missing")


def test_render_continues_an_unfinished_data_set(run, tmp_path):
    arguments = [*RENDER, "--workers", "1", "--out", tmp_path, "-n", "2"]
    done = run(*arguments, "--shard", "1/2")
    assert done.stdout.startswith("1 of 1 images rendered in ")
    assert [path.name for path in sorted(tmp_path.glob("0*.json"))] == ["000001.json"]
    done = run(*arguments)
    assert done.stdout.startswith("1 of 2 images rendered in ")
    assert "CPU-ms an image" in done.stdout
    assert len(list(tmp_path.glob("0*.json"))) == 2


def test_the_help_names_every_preset(run):
    text = " ".join(run("render", "--help").stdout.replace("│", " ").split())
    assert ", ".join(PRESETS) in text


CAMERA = """image_width: 1280
image_height: 720
camera_matrix: {rows: 3, cols: 3, data: [931.2, 0, 640, 0, 931.2, 360, 0, 0, 1]}
"""


def test_render_shows_a_users_camera(run, tmp_path, caplog):
    camera, out = tmp_path / "cam.yaml", tmp_path / "out"
    camera.write_text(CAMERA)
    with caplog.at_level(logging.INFO):
        run(
            "render", "servoholder", "--preset", "wide", "--camera", camera, "--format", "ndds",
            "--working-distance", "0.4,0.7", "--workers", "1", "-n", "1", "--out", out,
        )  # fmt: skip
    assert cv2.imread(str(out / "000000.png")).shape == (720, 1280, 3)
    intrinsics = json.loads((out / "000000.json").read_text())["camera_data"]["intrinsics"]
    assert (intrinsics["fx"], intrinsics["cy"]) == (931.2, 360)
    assert "cam.yaml: 1280×720 pixels, 69° × 42°, parts at 0.4 – 0.7 m" in caplog.text
    assert "servoholder: 139 – 244 pixels across; a pixel is 0.43 mm" in caplog.text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--camera", "{camera}"],
            "got --camera without --working-distance 0.3,0.8; allowed: both",
        ),
        (["--working-distance", "0.3,0.8"], "got --working-distance without --camera"),
        (["--camera", "{camera}", "--working-distance", "0.8,0.3"], "got working_distance=[0.8, 0"),
        (["--camera", "{camera}", "--working-distance", "near"], "got --working-distance near; al"),
        (["--camera", "/nowhere", "--working-distance", "0.5,1"], "got camera file /nowhere: No"),
    ],
)
def test_a_wrong_camera_is_one_line(refused, arguments, message, tmp_path):
    (tmp_path / "cam.yaml").write_text(CAMERA)
    given = [text.format(camera=tmp_path / "cam.yaml") for text in arguments]
    line = refused("render", "servoholder", "--out", tmp_path / "out", "-n", "1", *given)
    assert line.startswith(message)


def test_a_preview_renders_no_data_set(run, tmp_path):
    out = tmp_path / "out"
    done = run(*RENDER, "-n", "5000", "--preview", "--out", out)
    assert done.stdout == f"{out.resolve()}.preview.png\n"
    assert not out.exists()
    assert cv2.imread(f"{out}.preview.png").shape[2] == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-n", "0"], "got -n 0; allowed: 1 to"),
        (["-n", "1000000001"], "got -n 1000000001; allowed: 1 to 1,000,000,000"),
        ([], "got no number of images; allowed: -n NUMBER, or --preview"),
        (["-n", "5", "--size", "4x4"], "got width=4 of "),
        (["-n", "5", "--size", "big"], "got --size big; allowed: WIDTHxHEIGHT"),
        (["-n", "many"], "Invalid value for '-n'"),
        (["-n", "5", "--colour"], "No such option: --colour"),
        (["-n", "5", "--backgrounds", "skimag"], "got no photo in the folder skimag"),
        (["-n", "5", "--unit", "furlong", "part.stl"], "got unit='furlong' for part.stl"),
        (["-n", "5", "servoholder"], "got parts ['servoholder', 'servoholder'] to render"),
        (["-n", "5", "--format", "coco"], "got --format coco; allowed: bop, ndds, webdataset"),
        (["-n", "5", "--renderer", "gl"], "got renderer 'gl'; allowed: raster, photoreal"),
        (["-n", "5", "--shard", "3/2"], "got shard '3/2'; allowed: i/n with 0 <= i < n"),
        (["-n", "5", "--workers", "0"], "got --workers=0; allowed: an integer from 1 to 1024"),
        (["-n", "5", "--engine", "slurm"], "got --engine slurm; allowed: local, ray"),
        (["-n", "5", "--ray-address", "a:1"], "got --ray-address a:1 with --engine local"),
        (["-n", "5", "--set", "lighting"], "got --set lighting; allowed: FIELD"),
        (["-n", "5", "/nowhere/part.stl"], "got mesh /nowhere/part.stl, no such file"),
        (["-n", "5", "screw"], "got unknown part 'screw'"),
        (["-n", "5", "--negatives", "servoholder"], "got negative servoholder"),
        (["-n", "5", "--negatives", "a.stl", "b.stl"], "got b.stl after --negatives a.stl"),
        (["-n", "5", "--out", "/dev/null/x"], "got folder /dev/null/x: Not a directory"),
    ],
)
def test_a_wrong_render_option_is_one_line_and_code_2(refused, arguments, message, tmp_path):
    assert refused(*RENDER, "--out", tmp_path / "out", *arguments).startswith(message)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["render", "--out", "x", "-n", "5"], "Missing argument"),
        (["render", "servoholder", "-n", "5"], "Missing option '--out'"),
        (["rendr"], "No such command 'rendr'"),
        (["check", "/nowhere"], "got /nowhere, which is not a folder"),
        (["download", "coco"], "got unknown data set 'coco'; allowed: voc2007"),
    ],
)
def test_a_wrong_command_is_one_line_and_code_2(refused, arguments, message):
    assert refused(*arguments).startswith(message)


def test_a_group_without_a_command_shows_its_help_only(run):
    done = run("calibrate", code=2)
    assert "handeye" in done.stdout
    assert not done.stderr


def test_download_prints_the_folder_of_the_photos(run, tmp_path, monkeypatch):
    photos = tmp_path / "voc2007" / "VOCdevkit" / "VOC2007" / "JPEGImages"
    photos.mkdir(parents=True)
    done = run("download", "voc2007", "--out", tmp_path)
    assert (done.exit_code, done.stdout) == (0, f"{photos}\n")

    def refuse(*_: object) -> None:
        raise OSError("Network is unreachable")

    monkeypatch.setattr("socket.getaddrinfo", refuse)
    done = run("download", "voc2007", "--out", tmp_path / "other", code=2)
    assert "no connection: Network is unreachable" in done.stderr


@pytest.fixture
def plate(shared_data):
    return shared_data / "parts" / "so_arm100" / "Seeedstudio_Mounting_Plate_SO101.stl"


def test_the_unit_of_a_file_is_guessed_and_a_wrong_one_named(refused, plate, tmp_path, caplog):
    out = tmp_path / "out"
    line = refused("render", plate, "--unit", "m", "-n", "5", "--out", out)
    assert "allowed: a diameter of 5 mm – 5 m; fix: state the file's unit: unit=mm" in line
    refused("render", plate, "-n", "0", "--out", out)
    assert "states no unit: assuming mm" in caplog.text
    assert not out.exists()


@pytest.mark.slow
def test_a_mesh_in_inches_is_rendered_at_its_size(run, plate, tmp_path):
    mesh = trimesh.load_mesh(plate)
    inches, out = tmp_path / "plate.stl", tmp_path / "out"
    corners = mesh.vertices.copy()
    mesh.apply_scale(1 / 25.4).export(inches)
    done = run(
        "render", inches, "--unit", "inch", "--out", out, "-n", "2", "--size", "96,72",
        "--preset", "table", "--backgrounds", "skimage", "--workers", "1",
    )  # fmt: skip
    (record,) = json.loads((out / "models" / "models_info.json").read_text()).values()
    sizes = [record[f"size_{axis}"] for axis in "xyz"]
    assert sizes == pytest.approx(np.ptp(corners, axis=0).tolist(), rel=1e-5)  # millimetres
    assert cv2.imread(str(next(out.rglob("rgb/*")))).shape == (72, 96, 3)
    done = run("check", out)
    assert (done.exit_code, done.stderr) == (0, "")
    assert done.stdout == f"{out}: BOP, 2 images, 0 defects\n"
    (path,) = out.rglob("scene_gt.json")
    path.write_text(path.read_text().replace('"obj_id": 1', '"obj_id": 7'))
    done = run("check", out, code=1)
    assert f"{path.relative_to(out)}: " in done.stdout
    listed = done.stdout.splitlines()
    few = run("check", out, "--most", "1").stdout.splitlines()
    assert (few[0], few[-1]) == (listed[0], listed[-1])
    assert few[1] == f"… and {len(listed) - 2} more"


SLOW_LAYOUTS = [pytest.param(name, marks=pytest.mark.slow) for name in ("ndds", "webdataset")]


@pytest.mark.parametrize("layout", ["bop", *SLOW_LAYOUTS])
def test_neither_render_nor_check_imports_torch(layout, command, tmp_path):
    # This interpreter also does the work of the worker processes.
    code = f"""
import sys
from typer.testing import CliRunner
from dopepp.cli import app
from dopepp.data.render_job import claim, make_job
from dopepp.data.render_run import RenderTasks, RenderTask
from pathlib import Path
out = {str(tmp_path / "out")!r}
arguments = ["render", "servoholder", "--preset", "quickstart", "--size", "32x24",
             "--format", {layout!r}, "--preview", "-n", "2", "--out", out]
done = CliRunner().invoke(app, arguments)
assert done.exit_code == 0, done.output
job = make_job(["servoholder"], preset="quickstart", size="32x24", layout={layout!r})
claim(Path(out), job.record)
job.writer(Path(out)).prepare()
perform = RenderTasks(job, Path(out))
for task in (RenderTask(0, range(2)), RenderTask(0, range(2), finalizes=True)):
    perform(task)
done = CliRunner().invoke(app, ["check", out])
assert done.exit_code == 0, done.output
print(sorted({{"torch", "lightning", "torchmetrics", "ray", "webdataset"}} & set(sys.modules)))
"""
    done = command("-c", code)
    assert (done.out, done.code) == ("[]\n", 0), done.err


def test_a_missing_camera_is_an_error_before_pytorch_is_imported(command, image_file):
    code = f"""
import sys
from typer.testing import CliRunner
from dopepp.cli import app
for verb in ["predict", "x.ckpt"], ["doctor", "--model", "x.ckpt"]:
    done = CliRunner().invoke(app, [*verb, {str(image_file)!r}])
    print(done.exit_code, {{"torch", "numba", "scipy.spatial"}} & set(sys.modules), done.stderr)
"""
    assert command("-c", code).out.count("2 set() got neither --K nor --camera") == 2
