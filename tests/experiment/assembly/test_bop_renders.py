"""``data=bop_renders``: train on renders of BOP models and evaluate on the real images."""

import json
import math
import os
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image

from dopepp.core.errors import UserError
from dopepp.data.formats.bop.bop_models import bop_parts
from dopepp.data.formats.bop.bop_reader import BopReader
from dopepp.data.formats.bop.bop_results import BopResult, write_results
from dopepp.data.formats.bop.bop_writer import BopWriter
from dopepp.data.rendered import RenderedSource
from dopepp.experiment.assembly.build_parts import build_negatives, build_parts
from dopepp.experiment.assembly.build_sources import (
    build_datamodule,
    held_out_source,
)
from dopepp.experiment.assembly.camera_fit import fit_to_camera
from dopepp.experiment.assembly.negative_frames import frame_view, negative_frames
from dopepp.experiment.assembly.renders import validation_renders
from dopepp.experiment.results.false_alarms import frames_without_parts
from dopepp.geometry.camera import project_keypoints
from dopepp.models.checkpoint import Checkpoint
from dopepp.parts.part import make_part
from dopepp.virtual import Factory
from dopepp.virtual.presets import preset_of
from tests.data.makers import write_set
from tests.parts.makers import mesh_of

SCENE = {"width": 96, "height": 64, "intrinsics_px": [210.0, 211.0, 47.0, 30.0],
         "placement": {"nearest": 0.42, "farthest": 0.58}, "targets_per_image": [2, 2]}  # fmt: skip


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Two coloured boxes and four images with depth, no training images, no masks."""
    parts = []
    for name, size, colour in (("red", 0.08, (200, 30, 30)), ("blue", 0.09, (20, 40, 190))):
        box = mesh_of(trimesh.creation.box((size, 0.7 * size, 0.5 * size)))
        parts.append(make_part(name, replace(box, colours=np.full((8, 3), colour, np.uint8))))
    source = RenderedSource(Factory(parts, preset_of("upright", SCENE), 3), 4, "test")
    samples = [source.sample(index) for index in range(4)]
    folder = tmp_path_factory.mktemp("bop") / "set"
    write_set(BopWriter, folder, parts, samples)
    (folder / "train_pbr").rename(folder / "test")
    return folder


@pytest.fixture
def config(parsed, root):
    """Parse ``data=bop_renders`` with few, small images."""

    def make(*overrides):
        given = ("data.samples_per_epoch=8", "data.batch_size=4", "data.num_val=2",
                 "data.num_workers=0", "model.width=0.0625")  # fmt: skip
        return parsed("data=bop_renders", f"data.root={root}", *given, *overrides)

    return make


def test_frames_without_objects_have_the_camera_of_the_labelled_images(parsed, root, quick_sky):
    sets = (f"data.image_sets.{split}=test" for split in ("train", "val", "test"))
    data = parsed("data=bop", f"data.root={root}", *sets).data
    parts = build_parts(data)
    frames = negative_frames(data, parts, "val", 3)
    for index in range(3):
        sample = frames.sample(index)
        assert sample.size == (96, 64)
        np.testing.assert_array_equal(sample.K, [[210, 0, 47], [0, 211, 30], [0, 0, 1]])
    near, far = frame_view(data, parts).distance
    assert 0.40 <= near < far <= 0.60


@pytest.mark.parametrize("symmetries", ["auto", "none"])
def test_distances_without_a_camera_belong_to_the_camera_of_the_images(parsed, root, symmetries):
    config = parsed("experiment=dragon", f"data.root={root}", "data.objects=[red]",
                    f"data.symmetries={symmetries}")  # fmt: skip
    fitted = fit_to_camera(config, build_parts(config.data)).data.virtual
    assert (fitted.camera.fx, fitted.camera.fy) == (210.0, 211.0)
    assert fitted.working_distance == (0.42, 0.6)


def test_renders_have_the_camera_of_the_real_images(config, caplog):
    caplog.set_level("INFO")
    given = config("virtual.preset=upright")
    parts = build_parts(given.data)
    chosen = fit_to_camera(given, parts)
    assert vars(chosen.data.virtual.camera) == {
        "width": 96, "height": 64, "fx": 210.0, "fy": 211.0, "cx": 47.0, "cy": 30.0
    }  # fmt: skip
    near, far = chosen.data.virtual.working_distance
    assert 0.40 <= near < far <= 0.60
    assert chosen.plain["virtual"]["working_distance"] == [near, far]
    assert "its annotated distances" in caplog.text
    module = build_datamodule(chosen.data, parts, 0)
    names = [(split, info.name) for split, info in module.summary()]
    assert names == [("train", "virtual"), ("val", "virtual"), ("test", "bop/test")]
    assert isinstance(module.test_source, BopReader)
    assert module.test_source.sample(0).K[0, 0] == 210.0
    changed = config("virtual.working_distance=[0.4,0.7]")
    assert fit_to_camera(changed, parts).data.virtual.working_distance == (0.4, 0.7)


def test_images_without_annotations_need_only_the_working_distance(config, root, tmp_path):
    private = shutil.copytree(root, tmp_path / "set")
    for annotation in private.glob("**/scene_gt*.json"):
        annotation.unlink()
    given = config(f"data.root={private}", "virtual.preset=upright")
    parts = build_parts(given.data)
    with pytest.raises(UserError, match=r"no annotated object in bop/test.*working_distance="):
        fit_to_camera(given, parts)
    changed = config(f"data.root={private}", "virtual.working_distance=[0.4,0.7]")
    virtual = fit_to_camera(changed, parts).data.virtual
    assert (virtual.camera.fx, virtual.working_distance) == (210.0, (0.4, 0.7))


def test_models_outside_data_objects_are_negatives(config):
    given = config("virtual.preset=upright", "data.objects=[red]")
    parts = build_parts(given.data)
    factory = held_out_source(fit_to_camera(given, parts).data, parts, "val").factory
    assert [part.name for part in factory.parts] == ["red"]
    assert factory.negatives[0].name == "blue"
    assert build_negatives(given.data, parts)[0] is factory.negatives[0]  # read once


def test_a_listed_negative_is_read_again_only_after_a_change(config, tmp_path):
    path = tmp_path / "other.stl"
    trimesh.creation.box((20.0, 30.0, 40.0)).export(path)
    given = config(f"virtual.negatives=[{path}]", "data.unit=mm", "data.objects=[red]")
    parts = build_parts(given.data)
    first = build_negatives(given.data, parts)[0]
    assert build_negatives(given.data, parts)[0] is first
    trimesh.creation.box((20.0, 30.0, 50.0)).export(path)
    os.utime(path, ns=(0, path.stat().st_mtime_ns + 1))
    second = build_negatives(given.data, parts)[0]
    expected = (math.hypot(0.02, 0.03, 0.04), math.hypot(0.02, 0.03, 0.05))
    assert (first.diameter, second.diameter) == pytest.approx(expected)


def test_validation_renders_of_a_checkpoint_do_not_need_the_data_set(config, tmp_path):
    given = config("data.objects=[red]")
    parts = build_parts(given.data)
    stored = fit_to_camera(given, parts).stored_data()
    elsewhere = {**stored, "root": str(tmp_path / "elsewhere")}
    checkpoint = Checkpoint({}, {}, parts, (64, 64), 8, 1.0, data={"config": elsewhere})
    source = validation_renders(checkpoint, tmp_path / "best.ckpt", 3)
    preset, sample = source.factory.preset, source.sample(2)
    assert (len(source), preset.name) == (3, "ycb")
    assert "blue" not in [part.name for part in source.factory.negatives]
    assert {instance.label for instance in sample.instances} <= {"red"}


def test_a_model_with_the_mesh_of_a_learned_part_is_no_negative(config, root, tmp_path):
    copy = shutil.copytree(root, tmp_path / "set")
    models = copy / "models"
    shutil.copy(models / "obj_000001.ply", models / "obj_000003.ply")
    info = json.loads((models / "models_info.json").read_text())
    info["3"] = {**info["1"], "name": "twin"}
    (models / "models_info.json").write_text(json.dumps(info))
    given = config(f"data.root={copy}", "virtual.preset=upright", "data.objects=[red]")
    parts = build_parts(given.data)
    factory = held_out_source(fit_to_camera(given, parts).data, parts, "val").factory
    assert "twin" not in [part.name for part in factory.negatives]
    assert factory.negatives[0].name == "blue"


def test_real_frames_and_renders_are_windows_of_equal_scale(config, root):
    given = config(
        "virtual.preset=upright", "data.real_fraction=0.5", "data.image_sets.train=test",
        "virtual.camera_scale=0.9",
    )  # fmt: skip
    parts = build_parts(given.data)
    data = fit_to_camera(given, parts).data
    width, height = data.network_input
    module = build_datamodule(data, parts, 0)
    samples = [module.train_item(0, index) for index in range(8)]
    by_source = {sample.source: sample for sample in samples}
    assert set(by_source) == {"bop/test", "virtual"}
    cuboids = {part.name: part.cuboid for part in parts}
    for sample in samples:
        assert sample.size == (width, height)
        assert sample.K[0, 0] == pytest.approx(0.9 * 210, rel=0.02)
        for instance in sample.instances:
            shown = project_keypoints(cuboids[instance.label], instance.T_cam_obj, sample.K)
            np.testing.assert_allclose(instance.keypoints, shown, atol=1e-6)


def test_images_without_the_part_have_the_camera_of_the_labelled_images(parsed, root, tmp_path):
    Image.new("RGB", (192, 128)).save(tmp_path / "desk.png")
    sets = "data.image_sets={train: null, val: null, test: test}"
    data = parsed("data=bop", f"data.root={root}", sets).data
    frame = frames_without_parts(tmp_path, None, data, build_parts(data)).sample(0)
    assert (frame.size, frame.K[0, 0]) == ((96, 64), 210.0)


def test_a_real_fraction_requires_an_image_set_for_training(config):
    data = config("data.real_fraction=0.5").data
    with pytest.raises(UserError, match=r"data.image_sets.train=null with data.real_fraction=0.5"):
        build_datamodule(data, build_parts(data), 0)


def test_validation_falls_back_to_renders(config, root, tmp_path, caplog):
    empty = tmp_path / "set"
    (empty / "val" / "000000" / "rgb").mkdir(parents=True)
    (empty / "models").symlink_to(root / "models")
    (empty / "test").symlink_to(root / "test")
    (empty / "val" / "000000" / "rgb" / "000000.png").symlink_to(
        root / "test" / "000000" / "rgb" / "000000.png"
    )
    camera = {"0": {"cam_K": [110.0, 0, 47, 0, 111, 30, 0, 0, 1], "depth_scale": 1}}
    (empty / "val" / "000000" / "scene_camera.json").write_text(json.dumps(camera))
    data = config(f"data.root={empty}", "data.image_sets.val=val").data
    parts = build_parts(data)
    assert held_out_source(data, parts, "val").describe()[0].name == "virtual"
    assert "bop/val shows none of red, blue: validating on renders" in caplog.text


def test_true_poses_from_a_file_have_perfect_scores(call, root, tmp_path):
    source = BopReader(root, bop_parts(root), "test", targets="auto")
    numbers = {"red": 1, "blue": 2}
    rows = [
        BopResult(0, index, numbers[instance.label], 1.0, instance.T_cam_obj)
        for index in range(len(source))
        for instance in source.sample(index).instances
    ]
    path = tmp_path / "truth_set-test.csv"
    write_results(path, rows)
    done = call(
        "evaluate.py", "data=bop_renders", f"data.root={root}", f"results={path}",
        f"output_dir={tmp_path}", "virtual=default", code=0,
    )  # fmt: skip
    match = re.search(r"BOP, (\d+) targets: AR ([\d.]+)% \(VSD ([\d.]+)%", done.out)
    assert match, done.out[-3000:]
    assert float(match[2]) > 99
    (metrics,) = tmp_path.glob("**/metrics.json")
    scores = json.loads(metrics.read_text())["bop"]
    assert scores["num_targets"] == sum(len(source.sample(i).instances) for i in range(4))
    assert scores["ar_mssd"] == scores["ar_mspd"] == scores["add_or_s_01d"] == 1.0
