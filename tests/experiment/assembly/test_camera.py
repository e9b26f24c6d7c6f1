"""A training for the user's camera: automatic sizes, stored options and image sizes."""

import logging
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dopepp.core.errors import RunError, UserError
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.build_sources import (
    build_datamodule,
    held_out_source,
)
from dopepp.experiment.assembly.camera_fit import fit_to_camera
from dopepp.experiment.config.data_config import evaluation_data
from dopepp.experiment.run import train
from dopepp.experiment.run.train import template_commands
from dopepp.parts.catalogue import pivconnector

FOCAL = round(640 / math.tan(math.radians(69 / 2)), 1)
DIAMETER = pivconnector().diameter
CAMERA = f"""%YAML:1.0
---
image_width: 1280
image_height: 720
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ {FOCAL}, 0., 640., 0., {FOCAL}, 360., 0., 0., 1. ]
"""
SMALL = ("data.samples_per_epoch=8", "data.batch_size=4", "data.num_val=2", "data.num_test=1",
         "data.cache=none", "data.num_workers=0", "data.symmetries=none")  # fmt: skip


@pytest.fixture
def camera(tmp_path, monkeypatch):
    """A camera file whose name is the same in every test's config."""
    monkeypatch.chdir(tmp_path)
    (path := Path("cam.yaml")).write_text(CAMERA)
    return path


@pytest.fixture
def my_part(parsed, camera):
    """The experiment, as ``camera=`` and ``working_distance=`` are spelled out."""

    def make(*overrides, distance="[0.4,0.7]"):
        given = (f"virtual.camera={camera}", f"virtual.working_distance={distance}")
        config = parsed("experiment=my_part", *SMALL, *given, *overrides)
        return fit_to_camera(config, build_parts(config.data))

    return make


def test_template_commands(my_part):
    lens = my_part().data.virtual.camera
    K = " ".join(f"{value:g}" for value in (lens.fx, lens.fy, lens.cx, lens.cy))
    end = f"IMAGE --K {K} --working-distance 0.4,0.7 --tilt 60 --save out"
    assert template_commands(my_part().data) == [f"dopepp predict pivconnector {end}"]
    data = replace(my_part().data, parts=("my part.stl",), unit="inch")
    (command,) = template_commands(data)
    assert command.startswith("dopepp predict 'my part.stl' IMAGE --K ")
    assert " --unit inch " in command
    assert template_commands(replace(data, virtual=replace(data.virtual, camera=None))) == []


def test_a_run_prints_the_command_of_templates(my_part, monkeypatch, capsys, tmp_path):
    def stop(*_):
        raise RunError("stop")

    monkeypatch.setattr(train, "_fit", stop)
    with pytest.raises(RunError, match="stop"):
        train.run_training(my_part(), tmp_path)
    assert "without training: dopepp predict pivconnector IMAGE --K" in capsys.readouterr().out


def test_automatic_sizes_are_stored_in_config_and_checkpoint(my_part, camera, caplog):
    with caplog.at_level(logging.INFO):
        config = my_part()
    assert config.data.network_input == (128, 128)
    scale = config.data.virtual.camera_scale
    assert scale == pytest.approx(70 * math.sqrt(0.4 * 0.7) / FOCAL / DIAMETER, rel=0.01)
    assert "the network's input is scaled by" in caplog.text
    assert "windows of 128×128 pixels" in caplog.text
    stored = config.stored_data()
    lens = {"width": 1280, "height": 720, "fx": FOCAL, "fy": FOCAL, "cx": 640.0, "cy": 360.0}
    assert stored["virtual"]["camera"] == lens
    camera.unlink()  # a checkpoint needs no file
    data = evaluation_data(None, None, stored, "best.ckpt")
    assert data == config.data


def test_training_uses_windows_and_evaluation_whole_images(my_part):
    data = my_part().data
    parts = build_parts(data)
    module = build_datamodule(data, parts, 0)
    for sample in (module.train_item(0, 0), module.val_item(0, 0)):
        assert sample.size == (128, 128)
        assert sample.K[0, 0] == pytest.approx(FOCAL * data.virtual.camera_scale)
    for split in ("val", "test"):
        sample = held_out_source(data, parts, split).sample(0)
        assert (sample.size, sample.K[0, 0]) == ((1280, 720), FOCAL)
        assert 0.38 < sample.instances[0].T_cam_obj[2, 3] < 0.72
    corners = {tuple(module.train_item(0, n).K[:2, 2].round(3)) for n in range(4)}
    assert len(corners) == 4


def test_given_sizes_are_kept(my_part):
    config = my_part("data.input_size=[96,96]")
    assert config.data.network_input == (96, 96)
    assert config.data.virtual.camera_scale * FOCAL * DIAMETER / 0.4 < 96 / 1.29
    assert my_part("virtual.camera_scale=0.5").data.virtual.camera_scale == 0.5
    scene = my_part("++virtual.scene.turning.tilt_deg=30").data.virtual.scene
    assert scene == {"turning": {"tilt_deg": 30}}


def test_on_a_table(my_part):
    data = my_part("virtual.preset=table").data
    sample = build_datamodule(data, build_parts(data), 0).train_item(0, 0)
    assert sample.instances
    assert sample.size == data.network_input


@pytest.mark.parametrize(
    ("distance", "overrides", "got"),
    [
        ("[0.8,0.3]", (), "working_distance=[0.8, 0.3]"),
        ("[0.05,0.3]", (), "working_distance from 0.05 m, where pivconnector (108 mm across)"),
        ("[0.4,20]", (), "working_distance to 20 m, where pivconnector"),
        ("null", (), "camera without working_distance"),
        ("[0.4]", (), "working_distance=[0.4]"),
        ("[0.4,0.7]", ("virtual.camera=null",), "working_distance without camera"),
        ("[0.4,0.7]", ("virtual.camera=/nowhere.yaml",), "camera file /nowhere.yaml"),
        (
            "[0.4,0.7]",
            ("virtual.camera_scale=1.0", "data.input_size=[128,128]"),
            "data.input_size=[128, 128] for parts 253 pixels across",
        ),
        ("[0.4,0.7]", ("virtual.camera_scale=0.1",), "working_distance to 0.7 m, where"),
    ],
)
def test_a_mistake_is_one_line(distance, overrides, got, my_part):
    with pytest.raises(UserError) as error:
        my_part(*overrides, distance=distance)
    assert error.value.got.startswith(got), error.value.got
    assert "\n" not in str(error.value)


def test_a_camera_file_without_image_size_is_rejected(my_part, camera):
    camera.write_text("\n".join(CAMERA.splitlines()[:2] + CAMERA.splitlines()[4:]) + "\n")
    with pytest.raises(UserError, match="does not state the size of its images"):
        my_part()


def test_without_a_camera_the_config_is_unchanged(parsed):
    for experiment in ("quickstart", "my_part"):
        config = parsed(f"experiment={experiment}")
        assert fit_to_camera(config, []) is config
    message = r"neither data\.input_size nor a camera.*add the camera's file"
    with pytest.raises(UserError, match=message):
        build_datamodule(config.data, build_parts(config.data), 0)


def test_a_camera_can_be_given_as_numbers(parsed):
    lens = "{width: 640, height: 480, fx: 600, fy: 600, cx: 320, cy: 240}"
    distance = "virtual.working_distance=[0.3,0.4]"
    config = parsed("experiment=my_part", f"virtual.camera={lens}", distance)
    np.testing.assert_array_equal(config.data.virtual.view.K[0], [600, 0, 320])
    with pytest.raises(UserError, match=r"virtual\.camera\.width"):
        parsed("experiment=my_part", f"virtual.camera={lens.replace('640', '6')}")
