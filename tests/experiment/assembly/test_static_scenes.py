"""Static scenes: rendered by several cameras, written as BOP, and measured with several views."""

import json
import math
import shutil

import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.data.formats.bop.bop_reader import BopReader
from dopepp.data.render_job import make_job
from dopepp.data.render_run import render_dataset
from dopepp.experiment.assembly.static_scenes import StaticScenes, with_views
from dopepp.experiment.results.measurement import EstimatorMethod, ViewsMethod
from dopepp.experiment.run.evaluate import run_evaluation
from dopepp.geometry.camera import invert_transform
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual.factory import BESIDE_DEG, Factory
from dopepp.virtual.presets import PRESETS
from tests.data.jobs.test_rendering import InlinePool

NUM_SCENES, NUM_VIEWS = 2, 3


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A data set of three scenes with three images each."""
    folder = tmp_path_factory.mktemp("scenes") / "data"
    job = make_job(["pivconnector"], preset="wide", size="320x240", views=NUM_VIEWS)
    render_dataset(job, folder, NUM_SCENES * NUM_VIEWS, InlinePool)
    return folder


@pytest.fixture
def reader(root):
    return BopReader(root, [pivconnector()], "train_pbr")


def test_static_scenes_add_images_of_the_same_scene(reader):
    assert {scene for scene, _ in reader.image_ids} == {f"{n:06d}" for n in range(NUM_SCENES)}
    scenes = StaticScenes(reader, NUM_VIEWS)
    assert len(scenes) == NUM_SCENES * NUM_VIEWS
    for index in range(len(scenes)):
        sample = scenes.sample(index)
        keys = [sample.key, *(other.key for other in sample.others)]
        assert len(set(keys)) == NUM_VIEWS
        assert {key.split("/")[0] for key in keys} == {keys[0].split("/")[0]}
        np.testing.assert_array_equal(sample.image, reader.sample(index).image)
        places = [
            picture.T_world_cam @ picture.instances[0].T_cam_obj
            for picture in (sample, *sample.others)
        ]
        for place in places[1:]:
            np.testing.assert_allclose(place, places[0], atol=1e-6)


def test_views_about_25_degrees_apart_are_chosen(root, tmp_path):
    cameras = root / "train_pbr" / "000000" / "scene_camera.json"
    for degrees, chosen in (((80, 24), 2), ((30, 2), 1)):
        changed = json.loads(cameras.read_text())
        for number, angle in enumerate((0, *degrees)):
            sine, cosine = math.sin(math.radians(angle)), math.cos(math.radians(angle))
            changed[f"{number}"]["cam_R_w2c"] = [cosine, 0, -sine, 0, 1, 0, sine, 0, cosine]
        copied = tmp_path / f"{chosen}"
        shutil.copytree(root, copied)
        (copied / "train_pbr" / "000000" / cameras.name).write_text(json.dumps(changed))
        scenes = StaticScenes(BopReader(copied, [pivconnector()], "train_pbr"), 2)
        assert [other.key for other in scenes.sample(0).others] == [f"000000/{chosen:06d}"]


def test_scenes_without_enough_images_or_poses_are_rejected(reader, tmp_path):
    with pytest.raises(UserError, match=r"data\.views=4 with 3 test images of scene 000000"):
        StaticScenes(reader, NUM_VIEWS + 1)
    job = make_job(["pivconnector"], preset="wide", size="64x48")
    render_dataset(job, tmp_path / "single", 2, InlinePool)
    single = BopReader(tmp_path / "single", [pivconnector()], "train_pbr")
    with pytest.raises(UserError, match="cam_R_w2c"):
        StaticScenes(single, 2)


@pytest.mark.parametrize("preset", ["wide", "table"])
def test_further_cameras_are_above_the_table(preset):
    factory = Factory([pivconnector()], PRESETS[preset].resized(64, 48), 0)
    for index in range(6):
        first, second = factory.render(0, index).scene, factory.render(0, index, view=1).scene
        T_new_cam = second.T_cam_world
        numbers = [scene.targets[0] for scene in (first, second)]
        poses = [
            scene.objects[n].T_cam_obj for scene, n in zip((first, second), numbers, strict=True)
        ]
        np.testing.assert_allclose(poses[1], T_new_cam @ poses[0], atol=1e-9)
        cosine = T_new_cam[2, 2]
        assert BESIDE_DEG[0] <= math.degrees(math.acos(cosine)) <= BESIDE_DEG[1]
        assert first.sensor.noise_seed != second.sensor.noise_seed
        if first.plane is not None:
            # The camera's centre in the first camera, against the plane there.
            centre = invert_transform(T_new_cam)[:3, 3]
            assert np.dot(first.plane.normal, centre) > first.plane.offset + 0.02


def test_several_views_are_measured_in_addition(root, composed, tmp_path):
    options = (
        "ckpt_path=pretrained/pivconnector_wide", "data=bop", f"data.root={root}",
        "data.image_sets={train: null, val: null, test: train_pbr}", "num_pictures=1",
    )  # fmt: skip
    config = composed(*options, "data.views=2", "refine=region", config="evaluate")
    network, refined, views = run_evaluation(config, tmp_path / "run")
    assert views.name == "dopepp_fast + region, 2 views"
    assert views.num_images == refined.num_images == NUM_SCENES * NUM_VIEWS
    assert views.mean.add_01d >= refined.mean.add_01d
    assert views.mean.add_01d >= 0.8
    assert "2 views" in (tmp_path / "run" / "compare.md").read_text()
    record = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (record["name"], record["refined"]["name"]) == (network.name, refined.name)
    config = composed(*options, "data.views=2", config="evaluate")
    with pytest.raises(UserError, match=r"data\.views=2 without refine=region"):
        run_evaluation(config, tmp_path / "other")


def test_readme_and_metrics_describe_the_result_on_single_images(
    root, composed, monkeypatch, tmp_path
):
    for method in (EstimatorMethod, ViewsMethod):
        monkeypatch.setattr(method, "detect", lambda *_: ([], 0.01))
    options = (
        "templates=[0.3,0.6]", "data=bop", f"data.root={root}", "data.views=2", "num_pictures=0",
        "data.image_sets={train: null, val: null, test: train_pbr}",
    )  # fmt: skip
    single, views = run_evaluation(composed(*options, config="evaluate"), tmp_path)
    assert (single.name, views.name) == ("templates", "templates, 2 views")
    assert json.loads((tmp_path / "metrics.json").read_text())["name"] == "templates"
    readme = (tmp_path / "README.md").read_text()
    assert "templates" in readme
    assert "2 views" not in readme


def test_renders_on_demand_have_no_views():
    class Renders:
        name = "virtual"

    with pytest.raises(UserError, match="dopepp render … --views 2"):
        with_views(Renders(), 2)


@pytest.mark.parametrize(
    ("given", "named"),
    [({"layout": "ndds", "views": 2}, "--views 2 with --format ndds"), ({"views": 17}, "--views")],
)
def test_views_that_cannot_be_rendered(given, named):
    with pytest.raises(UserError, match=named):
        make_job(["pivconnector"], **given)
