"""The shading protocol with methods whose answers are known."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.data.sample import Instance, Sample
from dopepp.experiment.reports.condition import record_condition
from dopepp.experiment.reports.evaluators import Cost, FileMethod, FilePose, ImageId
from dopepp.experiment.reports.report import measure
from dopepp.experiment.reports.shading import SHADING, check_masks, measure_shading
from dopepp.experiment.reports.tables import ADD_01D, ADD_5CM
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.parts.part import Part

NUM_IMAGES = 6
SHARES = (0.2, 0.6, 0.8)
COLOUR = 255


class Discs:
    """Noise with a disc on it, of which a third is visible."""

    name = "discs"

    def __init__(self, *, masks: bool = True, contrast: bool = True) -> None:
        self.masks, self.contrast = masks, contrast

    def __len__(self) -> int:
        return NUM_IMAGES

    def sample(self, index: int, epoch: int = 0) -> Sample:
        rng = np.random.default_rng([9, index])
        image = rng.integers(0, 200 if self.contrast else 1, (60, 80, 3), np.uint8)
        rows, columns = np.mgrid[:60, :80]
        mask = np.hypot(rows - 30, columns - 40) <= 15
        image[mask] = COLOUR
        T = np.eye(4)
        T[:3, 3] = [0, 0, 0.5]
        one = Instance("disc", T, np.zeros((9, 2)), 0.3, mask if self.masks else None)
        return Sample(image, np.diag([80.0, 80, 1]), [one], None, self.name, str(index))


class Finder:
    """Finds the disc, a bit beside it, while a share of its pixels is in sight."""

    def __init__(self, needed: float, offset: float) -> None:
        points = np.random.default_rng(0).uniform(-0.05, 0.05, (30, 3))
        cuboid = cuboid_keypoints(points.min(0), points.max(0))
        self.parts: Sequence[Part] = [Part("disc", cuboid, 0.1, points)]
        self.needed, self.offset = needed, offset

    def detect(self, sample: Sample, image: ImageId) -> tuple[Sequence[FilePose], float | None]:
        seen = np.count_nonzero((sample.image == COLOUR).all(axis=2)) / 709  # pixels of the disc
        if seen < self.needed:
            return [], None
        T = np.eye(4)
        T[:3, 3] = [self.offset, 0, 0.5]
        return [FilePose("disc", 1.0, T, np.zeros((9, 2)))], None

    def cost(self, seconds: Sequence[float]) -> Cost:
        return Cost()


METHODS = {"dope": Finder(0.7, 0.02), "dopepp": Finder(0.3, 0.005)}


def run(source: Discs, folder: Path, num_examples: int = 2) -> None:
    reports = measure(METHODS, [source.sample(i) for i in range(NUM_IMAGES)], 0).reports
    measured = measure_shading(METHODS, source, SHARES, 1, reports, num_examples)
    record_condition(folder, SHADING, *measured, (ADD_5CM, ADD_01D))


def test_every_method_is_measured_at_every_share(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(Discs(), tmp_path)
    with (tmp_path / "shading.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    # At 80 % less than a tenth of the object is left, and it counts all the same.
    assert {row["num_instances"] for row in rows} == {str(NUM_IMAGES)}
    assert {row["num_outside_tolerance"] for row in rows} == {"0"}
    table = {(row["method"], float(row["share"])): row for row in rows}
    assert list(table) == [(name, share) for name in METHODS for share in (0, *SHARES)]
    for (method, share), row in table.items():
        assert float(row["share_reached"]) == pytest.approx(share, abs=0.001)
        found = 1 - share >= METHODS[method].needed
        assert float(row["pass_5cm"]) == found
        assert float(row["add_01d"]) == (found and method == "dopepp")
        assert float(row["miss_rate"]) == 1 - found
        assert float(row["auc_10cm"]) == pytest.approx(found * (1 - METHODS[method].offset / 0.1))
        assert row["median_rotation_deg"] == ("0.0" if found else "")

    lines = (tmp_path / "shading.md").read_text().splitlines()
    first = lines.index("| method | object | 0 % | 20 % | 60 % | 80 % |")
    assert lines[first - 2] == "## ADD<5cm %"
    assert lines[first + 2] == "| dope | disc | 100.0 | 100.0 | 0.0 | 0.0 |"
    assert lines[first + 3] == "| dopepp | disc | 100.0 | 100.0 | 100.0 | 0.0 |"
    assert "rotation °" in capsys.readouterr().out
    sheet = cv2.imread(str(tmp_path / "shading_examples.png"))
    assert sheet.shape[1] > 4 * 320  # a column per share
    assert cv2.imread(str(tmp_path / "shading.png")).std() > 0


def test_shares_that_are_not_reached_are_counted_and_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run(Discs(contrast=False), tmp_path, 0)
    said = f"At 60 %, {NUM_IMAGES} of {NUM_IMAGES} instances are not within 2 points"
    assert said in caplog.text
    assert said in (tmp_path / "shading.md").read_text()
    assert not (tmp_path / "shading_examples.png").exists()


def test_what_cannot_be_shaded_is_refused_before_anything_is_measured() -> None:
    SHADING.check_methods(METHODS)
    check_masks(Discs())
    with pytest.raises(UserError, match="shading on discs, 6 images without an instance mask"):
        check_masks(Discs(masks=False))
    poses = FileMethod.__new__(FileMethod)
    with pytest.raises(UserError, match="shading with results of posecnn"):
        SHADING.check_methods({**METHODS, "posecnn": poses})
