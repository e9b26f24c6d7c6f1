"""Frames without the part: sizes, kinds and photos."""

import logging
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.build_sources import build_datamodule
from dopepp.experiment.assembly.negative_frames import (
    LOOKALIKES,
    OWN,
    PHOTOS,
    SCENES,
    _distances,
    negative_frames,
)
from dopepp.experiment.assembly.photos import held_out_photos, training_backgrounds
from dopepp.experiment.run.described_images import describe_images, differing_images
from dopepp.parts import make_part, servoholder
from dopepp.virtual import PRESETS

pytestmark = pytest.mark.usefixtures("quick_sky")


@pytest.fixture
def photos(tmp_path, monkeypatch):
    """A folder of twelve different photos; its name is the same in every test's config."""
    monkeypatch.chdir(tmp_path)
    (folder := Path("photos")).mkdir()
    rng = np.random.default_rng(0)
    for number in range(12):
        noise = rng.integers(0, 256, (150, 200, 3), np.uint8)
        assert cv2.imwrite(str(folder / f"{number}.png"), cv2.GaussianBlur(noise, (9, 9), 3))
    return folder


def frames(config, split, count=6):
    return negative_frames(config.data, build_parts(config.data), split, count)


def test_frames_of_a_preset_are_large_and_alternate_between_kinds(tiny, photos):
    config = tiny("virtual.backgrounds=./photos")
    source = frames(config, "val", 4)
    samples = [source.sample(index) for index in range(len(source))]
    assert [sample.source for sample in samples] == [PHOTOS, SCENES, LOOKALIKES, PHOTOS]
    preset = config.data.preset
    for index, sample in enumerate(samples):
        assert sample.size == (640, 480)
        assert not sample.instances
        # A part at the same distance covers as many pixels as in the preset.
        assert sample.K[0, 0] == preset.K[0, 0]
        np.testing.assert_allclose(sample.K[:2, 2], [319.5, 239.5])
        np.testing.assert_array_equal(source.sample(index).image, sample.image)
    others = [frames(config, "test", 4).sample(index) for index in range(4)]
    assert not {sample.key for sample in samples[::3]} & {sample.key for sample in others[::3]}
    assert all((a.image != b.image).any() for a, b in zip(samples, others, strict=True))


def test_distances_do_not_depend_on_the_origin_of_the_mesh():
    part, preset = servoholder(), PRESETS["wide"]
    mesh = replace(part.mesh, vertices=part.mesh.vertices + np.array([0.5, -0.3, 0.2]))
    near, far = _distances(preset, [make_part("moved", mesh)])
    np.testing.assert_allclose((near, far), _distances(preset, [part]), atol=0.01)
    assert 0.1 < near < far < 0.27


def test_frames_have_size_and_matrix_of_the_camera(tiny):
    lens = "{width: 800, height: 600, fx: 700.0, fy: 700.0, cx: 402.0, cy: 297.0}"
    distance = "virtual.working_distance=[0.3,0.5]"
    config = tiny("virtual.preset=wide", f"virtual.camera={lens}", distance)
    source = frames(config, "val", 3)
    view = config.data.virtual.view
    for index in range(3):
        sample = source.sample(index)
        assert sample.size == view.size
        np.testing.assert_array_equal(sample.K, view.K)


def test_procedural_backgrounds_are_tuned_and_tested_on_the_photos_of_the_package(tiny):
    data = tiny().data
    val, test = (held_out_photos(data, split) for split in ("val", "test"))
    assert (len(val.paths), len(test.paths)) == (12, 12)
    assert not set(val.paths) & set(test.paths)
    assert training_backgrounds(data).identity() == ["procedural"]


def test_negative_photos_are_divided_between_training_tuning_and_test(tiny, photos):
    config = tiny("virtual.negative_photos=./photos")
    keys = {}
    for split in ("val", "test"):
        source = frames(config, split, 8)
        assert [source.sample(index).source for index in range(4)] == [
            PHOTOS, SCENES, LOOKALIKES, OWN,
        ]  # fmt: skip
        keys[split] = {source.sample(index).key.partition("/")[0] for index in (3, 7)}
    assert len(keys["val"] | keys["test"]) == 4
    identity = training_backgrounds(config.data).identity()
    assert identity[0] == "procedural"
    assert identity[2:4] == ["train photos", "8"]
    for number in range(7):
        (photos / f"{number}.png").unlink()
    with pytest.raises(UserError, match=r"negative_photos=.* with 5 images; .*at least 6"):
        training_backgrounds(config.data)


def test_changed_photos_change_the_described_images(tiny, photos):
    config = tiny("virtual.backgrounds=./photos")

    def described(split):
        module = build_datamodule(config.data, build_parts(config.data), 0)
        return describe_images(getattr(module, f"{split}_source")), module.fingerprint()

    before = {split: described(split) for split in ("train", "val", "test")}
    again = {split: described(split) for split in ("train", "val", "test")}
    assert again == before
    (photos / "0.png").unlink()
    for split in ("train", "val", "test"):
        images, fingerprint = described(split)
        assert fingerprint != before[split][1]
        if split == "train":
            assert differing_images(before[split][0], images)


def test_too_few_photos_are_rejected(tiny, photos):
    for number in range(6, 12):
        (photos / f"{number}.png").unlink()
    assert len(frames(tiny("virtual.backgrounds=./photos"), "val")) == 6
    (photos / "0.png").unlink()
    with pytest.raises(UserError, match=r"with 5 photos, .*at least 6 different"):
        frames(tiny("virtual.backgrounds=./photos"), "val")


def test_training_on_an_undivided_folder_is_warned_about(tiny, photos, caplog):
    for number in range(5, 12):
        (photos / f"{number}.png").unlink()
    with caplog.at_level(logging.WARNING):
        backgrounds = training_backgrounds(tiny("virtual.backgrounds=./photos").data)
    assert backgrounds.identity()[:2] == ["photos", "5"]
    (message,) = [record.getMessage() for record in caplog.records]
    assert "fewer than 6 different photos" in message
