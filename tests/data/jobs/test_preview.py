"""The preview sheet of a render job."""

import re

import cv2
import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.data import render_preview
from dopepp.data.render_job import make_job
from dopepp.data.render_preview import preview_sheet, scene_tiles, write_preview
from tests.data.makers import small_job

SMALL = ("width=96", "height=72")


def test_a_sheet_has_four_panels_a_scene_and_shows_the_jobs_first_images():
    factory = make_job(["servoholder", "pivconnector"], changes=SMALL).factory
    sheet = preview_sheet(factory, num_scenes=2)
    lines, sheet = sheet[: 2 * 18], sheet[2 * 18 :]
    assert (lines < 128).any(axis=(1, 2)).reshape(2, 18).any(axis=1).all()  # one for each part
    assert sheet.shape == (2 * (240 + 18) + 3 * 6, 4 * 320 + 5 * 6, 3)
    image = factory.render(0, 1).image
    shown = sheet[6 + 258 + 6 :][:240, 6 : 6 + 320]
    small = cv2.resize(shown, (96, 72), interpolation=cv2.INTER_AREA).astype(int)
    assert np.abs(small - image).mean() < 4


def test_captions_describe_the_panels():
    changes = ["targets_per_image=[5,5]"]
    job = make_job(["servoholder"], preset="bin", changes=changes, size="160x120")
    rendered = job.factory.render(0, 0)
    image, posed, masks, depth = scene_tiles(rendered, "image 0")
    assert re.fullmatch("image 0: 160×120, .*on a plane", image.caption)
    assert posed.caption == f"{len(rendered.scene.targets)} servoholder"
    assert masks.caption.startswith("visible: ")
    assert depth.caption.startswith("depth: red 0.")
    # Cuboids are drawn where the pixels of the parts are.
    changed = (cv2.resize(posed.image, (160, 120)).astype(int) - image.image).any(axis=2)
    assert changed[rendered.instances >= 0].mean() > 2 * changed[rendered.instances < 0].mean()


def test_captions_without_a_target():
    job = make_job(["servoholder"], changes=["targets_per_image=[0,0]", *SMALL])
    captions = [tile.caption for tile in scene_tiles(job.factory.render(0, 0), "image 0")]
    assert captions[1:] == ["no target", "no instance; distractors: 0", "no depth"]


def test_the_sheet_is_written_next_to_the_folder_or_to_a_path(tmp_path, monkeypatch):
    sheet = np.zeros((5, 7, 3), np.uint8)
    monkeypatch.setattr(render_preview, "preview_sheet", lambda factory: sheet)
    assert write_preview(small_job(), tmp_path / "data") == tmp_path / "data.preview.png"
    named = write_preview(small_job(), tmp_path / "sheet.png")
    assert {path.name for path in tmp_path.iterdir()} == {"data.preview.png", "sheet.png"}
    assert cv2.imread(str(named)).shape == sheet.shape
    with pytest.raises(UserError, match=r"sheet\.png.*a writable file"):
        write_preview(small_job(), named / "x")
