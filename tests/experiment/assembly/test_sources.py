import logging
import os
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from dopepp.core.errors import UserError
from dopepp.data.formats.ycb_video.ycb_reader import YcbVideoReader
from dopepp.data.rendered import RenderedSource
from dopepp.data.sample import Instance, Sample
from dopepp.experiment.assembly.build_parts import PAPER_OBJECTS, build_parts
from dopepp.experiment.assembly.build_sources import (
    build_datamodule,
    held_out_source,
    note_on_shared_folder,
)
from dopepp.experiment.assembly.build_system import build_untrained
from dopepp.experiment.assembly.renders import with_cache
from dopepp.experiment.config.data_config import DataConfig
from dopepp.experiment.results.folder import METRICS_FILE, read_json
from dopepp.experiment.results.recording import measure_and_record
from dopepp.experiment.run.evaluate import parts_of
from dopepp.inference.network_estimator import NetworkEstimator
from dopepp.metrics.row import shown_columns
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.virtual.factory import Factory, code_hash
from dopepp.virtual.presets import preset_of
from dopepp.virtual.renderers import raster
from tests.data.makers import LAYOUTS, write_set


def counts(data: DataConfig) -> dict[tuple[str, str], tuple[int, int]]:
    """Return the numbers of images and of images per epoch, by split and source."""
    module = build_datamodule(data, build_parts(data), seed=0)
    return {
        (split, info.name): (info.num_images, info.num_per_epoch or info.num_images)
        for split, info in module.summary()
    }


def test_without_a_root_all_images_are_rendered_with_one_warning(tiny, caplog):
    data = tiny("data=hybrid", "data.parts=[servoholder,pivconnector]").data
    with caplog.at_level(logging.WARNING):
        assert list(counts(data).values()) == [(8, 8), (2, 2), (3, 3)]
    (line,) = [record.getMessage() for record in caplog.records]
    assert "no real images" in line
    assert "servoholder, pivconnector" in line


def test_a_cache_holds_all_targets_that_a_preset_allows(tiny, tmp_path, monkeypatch):
    preset = preset_of("quickstart", {"targets_per_image": [0, 60]})
    source = RenderedSource(Factory([servoholder()], preset, 0), 2)
    instance = Instance("servoholder", np.eye(4), np.zeros((9, 2)))
    crowd = Sample(np.zeros((48, 64, 3), np.uint8), np.eye(3), [instance] * 60)
    monkeypatch.setattr(source, "sample", lambda index, epoch=0: crowd)
    data = tiny(f"data.cache_dir={tmp_path}").data
    assert len(with_cache(source, data, "disk", (64, 64)).sample(1).instances) == 60


def test_a_cache_on_disk_belongs_to_code_and_version_of_its_renderer(tiny, tmp_path, monkeypatch):
    data = tiny(f"data.cache_dir={tmp_path}").data
    source = RenderedSource(Factory([servoholder()], preset_of("quickstart"), 0), 2)

    def folder():
        return with_cache(source, data, "disk", (64, 64)).folder

    first = folder()
    assert folder() == first
    monkeypatch.setattr(raster, "identity", lambda: "version 2", raising=False)
    assert folder() != first
    monkeypatch.undo()
    read_bytes = Path.read_bytes

    def changed(path):
        return read_bytes(path) + b"\n" * (path.name == "pictures.py")

    monkeypatch.setattr(Path, "read_bytes", changed)
    code_hash.cache_clear()
    assert folder() != first
    monkeypatch.undo()
    code_hash.cache_clear()
    assert folder() == first


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_cache_on_disk_belongs_to_the_files_of_labelled_images(tiny, tmp_path, layout):
    writer, reader = LAYOUTS[layout]
    renders = RenderedSource(Factory([servoholder()], preset_of("quickstart"), 0), 5)

    def cached(name, samples):
        data = tiny(f"data.cache_dir={tmp_path}", f"data.root={tmp_path / name}").data
        parts = [servoholder()]
        root = write_set(writer, tmp_path / name / "set", parts, samples)
        return with_cache(reader(root, parts), data, "disk", (64, 64))

    samples = [renders.sample(number) for number in range(5)]
    first, other = cached("a", samples[:2]), cached("b", samples[3:])
    for cache, sample in ((first, samples[1]), (other, samples[4])):
        (read,), (expected,) = cache.sample(1).instances, sample.instances
        np.testing.assert_allclose(read.T_cam_obj, expected.T_cam_obj, atol=1e-6)
    assert first.folder != other.folder


@pytest.mark.parametrize("name", ["-color.png", "-label.png", "-meta.mat"])
def test_a_cache_on_disk_is_not_reused_for_changed_files(tiny, ycb_root, tmp_path, name):
    root = tmp_path / "ycb"
    shutil.copytree(ycb_root, root)
    data = tiny(f"data.cache_dir={tmp_path}", f"data.root={root}", "data.format=ycb_video").data

    def folder():
        source = YcbVideoReader(root, [part], ["0000/000001"])
        return with_cache(source, data, "disk", (64, 64)).folder

    part = replace(servoholder(), name=(root / "image_sets/classes.txt").read_text().split()[0])
    first = folder()
    assert folder() == first
    os.utime(root / f"data/0000/000001{name}", (1, 1))
    assert folder() != first


@pytest.mark.parametrize("role", ["parts", "negatives"])
def test_a_cache_on_disk_belongs_to_the_appearance_of_all_parts(tiny, tmp_path, role):
    data = tiny(f"data.cache_dir={tmp_path}").data
    plain = replace(servoholder(), name="coloured")

    def folder(part):
        parts = {"parts": [pivconnector()], role: [part]}
        factory = Factory(preset=preset_of("quickstart"), seed=0, **parts)
        return with_cache(RenderedSource(factory, 2), data, "disk", (64, 64)).folder

    def coloured(grey):
        colours = np.full((len(plain.mesh.vertices), 3), grey, np.uint8)
        return replace(plain, mesh=replace(plain.mesh, colours=colours))

    assert coloured(10).mesh_hash == coloured(200).mesh_hash
    assert len({folder(part) for part in (plain, coloured(10), coloured(200))}) == 3
    assert folder(coloured(10)) == folder(coloured(10))


def test_held_out_images_are_equal_for_all_seeds_and_differ_between_splits(tiny):
    data = tiny().data
    parts = build_parts(data)
    part, other = (build_datamodule(data, parts, seed) for seed in (1, 2))
    changed = build_datamodule(replace(data, eval_seed=5), parts, 1)
    seen = [part.train_source.sample(0, 0).image.mean()]
    for split in ("val_source", "test_source"):
        images = [getattr(module, split).sample(0, 0).image for module in (part, other, changed)]
        np.testing.assert_array_equal(images[0], images[1])
        assert not np.array_equal(images[0], images[2])
        seen.append(images[0].mean())
    assert len(set(seen)) == 3


@pytest.mark.usefixtures("quick_sky")
def test_a_root_mixes_real_frames_with_renders(parsed, ycb_root):
    options = (f"data.root={ycb_root}", "data.samples_per_epoch=100", "data.num_workers=0")
    data = parsed("data=hybrid", *options).data
    parts = build_parts(data)
    assert [part.name for part in parts] == list(PAPER_OBJECTS)
    assert all(part.mesh is not None for part in parts)
    # Half real; of the other half a fifth from data_syn, whose frames count as virtual.
    assert counts(data) == {
        ("train", "ycb_video/data"): (2, 50), ("train", "virtual"): (100, 40),
        ("train", "ycb_video/data_syn"): (6, 10), ("val", "ycb_video/data"): (1, 1),
        ("test", "ycb_video/data"): (1, 1),
    }  # fmt: skip


def test_an_object_in_no_training_source_is_named(parsed, ycb_root):
    overrides = ("data=ycb_video", f"data.root={ycb_root}", "data.samples_per_epoch=32")
    data = parsed(*overrides, "data.objects=[003_cracker_box,019_pitcher_base]").data
    module = build_datamodule(data, build_parts(data), seed=0)
    assert {info.name for _, info in module.summary()} == {"ycb_video/data"}
    with pytest.raises(UserError, match="no instance of 019_pitcher_base in the training data"):
        module.check_objects()


def test_an_object_without_ground_truth_in_the_test_set_has_no_rates(tiny, ycb_root, tmp_path):
    objects = "data.objects=[003_cracker_box,010_potted_meat_can]"
    config = tiny("data=hybrid", "virtual.preset=null", f"data.root={ycb_root}", objects)
    data = replace(config.data, frames=("0050/000003",))
    estimator = NetworkEstimator(*build_untrained(config, build_parts(data)))
    parts = parts_of([estimator], data)
    report, _ = measure_and_record({"dopepp": estimator}, parts, data, tmp_path, num_shown=1)
    present, absent = (report.rows[name] for name in ("003_cracker_box", "010_potted_meat_can"))
    assert present.num_instances == 1
    written = read_json(tmp_path / METRICS_FILE)["objects"]["010_potted_meat_can"]
    assert (written["num_instances"], written["add_01d"]) == (0, None)
    texts = {column.heading: column.text(absent) for column in shown_columns(absent)}
    assert texts["ADD-0.1d %"] == "n/a"
    # The mean is over the object that was there.
    assert report.mean.add_01d == present.add_01d


def test_test_data_without_symmetries_use_the_symmetries_of_the_checkpoint(parsed):
    data = parsed("data=virtual", "data.parts=[servoholder]").data
    (part,) = build_parts(data)
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])[None]
    trained = SimpleNamespace(parts=[replace(part, symmetries_discrete=half_turn)])
    (taken,) = parts_of([trained], data)
    np.testing.assert_array_equal(taken.symmetries_discrete, half_turn)
    (refused,) = parts_of([trained], replace(data, symmetries="none"))
    assert not refused.has_symmetries


def test_a_users_mesh_with_its_unit(tiny, tmp_path):
    path = tmp_path / "bracket.stl"
    trimesh.creation.box((8.0, 5.0, 3.0)).export(path)
    data = tiny(f"data.parts=['{path}']", "data.unit=cm").data
    (part,) = build_parts(data)
    assert part.name == "bracket"
    assert part.diameter == pytest.approx(np.sqrt(0.08**2 + 0.05**2 + 0.03**2))
    sample = held_out_source(data, [part], "test").sample(0, 0)
    assert sample.instances[0].label == "bracket"
    assert sample.instances[0].mask.any()


@pytest.mark.parametrize(
    ("override", "got"),
    [
        ("data.parts=[gear]", "unknown part 'gear'"),
        ("data.parts=[gear.stl]", "gear.stl, no such file"),
        ("data.parts=[]", "parts []"),
        ("data.parts=[pivconnector,pivconnector]", "pivconnector"),
        ("data.objects=[003_cracker_box]", "without data.root"),
        ("data.frames=[0050/000003]", "without data.root"),
        ("data=ycb_video", "data=ycb_video without data.root"),
        ("data.root=/nowhere", "data.root=/nowhere, which has no data/"),
        ("data.batch_size=9", "8 training images for batches of 9"),
        ("virtual.preset=moon", "preset 'moon'"),
        ("++virtual.scene.gravity=1", "virtual.scene.gravity=1"),
        ("++virtual.scene.turning=free", "virtual.scene.turning='free'"),
        ("virtual.backgrounds=/nowhere", "/nowhere"),
        ("data.masking.probability=2", "probability"),
    ],
)
def test_a_mistake_in_the_data_is_one_line(override, got, tiny):
    with pytest.raises(UserError) as error:
        counts(tiny(override).data)
    assert got in error.value.got
    assert "\n" not in str(error.value)


def test_a_unit_applies_to_mesh_files_only(tiny):
    (part,) = build_parts(tiny("data.unit=parsec").data)
    assert part.name == "pivconnector"


def test_preset_changes_reach_the_renders(tiny):
    plain, changed = tiny(), tiny("++virtual.scene.horizontal_fov_deg=20")
    fx = [
        held_out_source(config.data, build_parts(config.data), "test").sample(0, 0).K[0, 0]
        for config in (plain, changed)
    ]
    assert fx[1] == pytest.approx(64 / np.tan(np.radians(10)), rel=1e-6)
    assert fx[0] < fx[1]


@pytest.mark.parametrize(("overrides", "words"), [
    (("data=bop",), "the last 10% of the images in train_pbr, which is shared with train and val; "
                    "data.image_sets.train=none data.image_sets.val=none measures"),
    (("data=bop", "data.image_sets.val=other"), "the last 20% of the images in train_pbr, "
        "which is shared with train; data.image_sets.train=none measures"),
    (("data=ndds",), "the last 10% of the images in ., which"),
    (("data=bop", "data.image_sets.test=test"), None),
    (("data=bop", "data.image_sets.train=none", "data.image_sets.val=none"), None),
    (("data=bop", "data/test=photoreal"), None),
    (("data=ycb_video",), None),
    (("data=ndds", "data.format=posed"), None),
    (("data=virtual",), None),
])  # fmt: skip
def test_a_shared_folder_is_reported_with_overrides_that_change_the_share(overrides, words, tiny):
    root = () if "data=virtual" in overrides else ("data.root=somewhere",)
    note = note_on_shared_folder(tiny(*overrides, *root).data)
    assert (note is None) == (words is None)
    assert words is None or words in note
