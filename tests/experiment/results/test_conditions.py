"""Shading and scale, measured with methods of known poses."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.core.files import read_csv
from dopepp.data.sample import Instance, Sample
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.build_sources import held_out_source
from dopepp.experiment.assembly.renders import scaled_test_renders
from dopepp.experiment.results.conditions import (
    SCALE,
    SHADING,
    Condition,
    check_masks,
    measure_scales,
    measure_shading,
    record_condition,
)
from dopepp.experiment.results.frame import ADD_01D, ADD_5CM
from dopepp.experiment.results.measurement import FilePose, ImageId, measure
from dopepp.experiment.results.report import Cost
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.parts.part import Part
from tests.data.makers import MadeSource, pose_at


def discs(*, masks: bool = True, contrast: bool = True) -> MadeSource:
    """Return images of noise with a disc whose visible fraction is 0.3."""
    rows, columns = np.mgrid[:60, :80]
    mask = np.hypot(rows - 30, columns - 40) <= 15

    def make(index: int, epoch: int) -> Sample:
        rng = np.random.default_rng([9, index])
        image = rng.integers(0, 200 if contrast else 1, (60, 80, 3), np.uint8)
        image[mask] = COLOUR
        T, shown = pose_at(0, 0, 0.5), mask if masks else None
        disc = Instance("disc", T, np.zeros((9, 2)), 0.3, shown)
        return Sample(image, np.diag([80.0, 80, 1]), [disc], None, "discs", str(index))

    return MadeSource(make, NUM_IMAGES, "discs")


RATES = (ADD_5CM, ADD_01D)
NUM_IMAGES = 6
SHARES = (0.2, 0.6, 0.8)
COLOUR = 255


class Finder:
    """Method that reports the true pose with an offset for every instance that it detects."""

    min_score = 0.0

    def __init__(self, part: Part, offset: float, sees: Callable[[Sample, Instance], bool]) -> None:
        self.parts: Sequence[Part] = [part]
        self.offset, self.sees = offset, sees

    def detect(self, sample: Sample, image: ImageId) -> tuple[Sequence[FilePose], float | None]:
        result = []
        for instance in sample.instances:
            if self.sees(sample, instance):
                T = instance.T_cam_obj.copy()
                T[0, 3] += self.offset
                result.append(FilePose(instance.label, 1.0, T, instance.keypoints))
        return result, None

    def cost(self, seconds: Sequence[float]) -> Cost:
        return Cost()


def disc_finder(needed: float, offset: float) -> Finder:
    """Return a method that detects the disc while a share of its 709 pixels is visible."""
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (30, 3))
    disc = Part("disc", cuboid_keypoints(points.min(0), points.max(0)), 0.1, points)
    return Finder(
        disc, offset, lambda sample, _: (sample.image == COLOUR).all(axis=2).sum() >= needed * 709
    )


NEEDED = {"dope": 0.7, "dopepp": 0.3}
METHODS = {"dope": disc_finder(0.7, 0.02), "dopepp": disc_finder(0.3, 0.005)}


def run_shading(source: MadeSource, folder: Path, num_examples: int = 2) -> None:
    reports = measure(METHODS, [source.sample(i) for i in range(NUM_IMAGES)], 0).reports
    measured = measure_shading(METHODS, source, SHARES, 1, reports, num_examples)
    record_condition(folder, SHADING, *measured, RATES)


def check_images(folder: Path, condition: Condition, columns: int) -> None:
    sheet = cv2.imread(str(folder / f"{condition.name}_examples.png"))
    assert sheet.shape[1] > columns * 320
    assert cv2.imread(str(folder / f"{condition.name}.png")).std() > 0


class Doubtful(Finder):
    """Method that reports wrong poses, with the true poses as candidates of lower score."""

    min_score = 0.5

    def detect(self, sample: Sample, image: ImageId) -> tuple[Sequence[FilePose], float | None]:
        ((pose,), _) = super().detect(sample, image)
        beside = pose.T_cam_obj.copy()
        beside[0, 3] += 0.5
        return [replace(pose, score=0.9, T_cam_obj=beside), replace(pose, score=0.4)], None


def test_all_candidates_count_for_ap_and_reported_poses_for_everything_else():
    part = METHODS["dope"].parts[0]
    method = Doubtful(part, 0.0, lambda *_: True)
    measured = measure({"doubtful": method}, [discs().sample(0)], 0)
    for row in measured.reports[0].rows.values():
        assert (row.precision, row.miss_rate, row.false_per_frame) == (0, 1, 1)
        assert row.average_precision == pytest.approx(0.5)  # right at rank two, of one instance
    method.min_score = 0.4
    (report,) = measure({"doubtful": method}, [discs().sample(0)], 0).reports
    assert (report.rows["disc"].precision, report.rows["disc"].add_01d) == (0.5, 1)
    assert [pose.score for _, pose, _ in measured.poses["doubtful"]] == [0.9, 0.4]


def test_every_method_is_measured_at_every_share(tmp_path):
    run_shading(discs(), tmp_path)
    rows = read_csv(tmp_path / "shading.csv")
    # At 80 %, less than a tenth of the object is visible, and the object still counts.
    assert {row["num_instances"] for row in rows} == {str(NUM_IMAGES)}
    assert {row["num_outside_tolerance"] for row in rows} == {"0"}
    table = {(row["method"], float(row["share"])): row for row in rows}
    assert list(table) == [(name, share) for name in METHODS for share in (0, *SHARES)]
    for (method, share), row in table.items():
        seen = 1 - share >= NEEDED[method]
        auc = seen * (1 - METHODS[method].offset / 0.1)
        rates = [float(row[f]) for f in ("pass_5cm", "add_01d", "miss_rate", "share_reached")]
        assert rates[:3] == [seen, seen and method == "dopepp", 1 - seen]
        assert rates[3] == pytest.approx(share, abs=0.001)
        assert float(row["auc_10cm"]) == pytest.approx(auc)
        assert row["median_rotation_deg"] == ("0.0" if seen else "")
    check_images(tmp_path, SHADING, 4)


def test_unreached_shares_are_counted_and_reported(tmp_path, caplog):
    run_shading(discs(contrast=False), tmp_path, 0)
    note = f"At 60 %, the covered share of {NUM_IMAGES} of {NUM_IMAGES} instances is off"
    assert note in caplog.text
    assert not (tmp_path / "shading_examples.png").exists()


def test_impossible_conditions_are_rejected_early(tiny):
    check_masks(discs())
    with pytest.raises(UserError, match="shading on discs, 6 images without an instance mask"):
        check_masks(discs(masks=False))
    data = replace(tiny().data, root=Path("photos"))
    with pytest.raises(UserError, match=r"scale=2 on the images in data\.root=") as error:
        scaled_test_renders(data, [], 2.0)
    assert "\n" not in str(error.value)


def test_every_method_is_measured_at_every_scale(tiny, tmp_path, caplog):
    data = tiny().data
    (part,) = build_parts(data)
    source = held_out_source(data, [part], "test")
    scaled = {scale: scaled_test_renders(data, [part], scale) for scale in (0.5, 20.0)}
    samples = [source.sample(index) for index in range(3)]
    for index, sample in enumerate(samples):
        near, far = sample.instances[0], scaled[0.5].sample(index).instances[0]
        centre, farther = (item.T_cam_obj @ [*part.cuboid[8], 1] for item in (near, far))
        np.testing.assert_allclose(farther[:3], 2 * centre[:3])
        assert not scaled[20.0].sample(index).instances  # too near to stand

    farthest = 1.05 * max(sample.instances[0].T_cam_obj[2, 3] for sample in samples)
    methods = {
        "dope": Finder(part, 0.02, lambda _, instance: bool(instance.T_cam_obj[2, 3] < farthest)),
        "dopepp": Finder(part, 0.005, lambda *_: True),
    }
    levels, tiles = measure_scales(methods, scaled, measure(methods, samples, 1), 1)
    record_condition(tmp_path, SCALE, levels, tiles, RATES)

    rows = {(row["method"], float(row["scale"])): row for row in read_csv(tmp_path / "scale.csv")}
    assert list(rows) == [(name, scale) for name in methods for scale in (0.5, 1, 20)]
    for (method, scale), row in rows.items():
        if scale == 20:
            facts = [row[f] for f in ("num_instances", "visible_fraction", "add_01d")]
            assert facts == ["0", "", ""]
            continue
        seen = method == "dopepp" or scale == 1
        assert float(row["visible_fraction"]) > 0.7
        rates = [float(row[f]) for f in ("num_instances", "pass_5cm", "add_01d", "miss_rate")]
        assert rates == [3, seen, method == "dopepp", 1 - seen]
    assert "Evaluated instances at ×20: none; at ×1: 3, " in caplog.text
    assert [tile.caption for tile in tiles] == [f"test/0/0, ×{scale}" for scale in ("0.5", 1, 20)]
    check_images(tmp_path, SCALE, 3)


def test_reports_of_other_methods_are_left_out(tmp_path):
    source = discs()
    reports = measure(METHODS, [source.sample(0)], 0).reports
    levels, _ = measure_shading({"dope": METHODS["dope"]}, source, SHARES, 1, reports)
    assert [list(level.rows) for level in levels] == [["dope"]] * 4
    record_condition(tmp_path, SHADING, levels, [], RATES)
    assert {row["method"] for row in read_csv(tmp_path / "shading.csv")} == {"dope"}
