"""The scale protocol: a method whose answers are known, and untrained networks from end to end."""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from dopepp.experiment.reports.condition import record_condition
from dopepp.experiment.reports.scale import SCALE, measure_scales

from dopepp.core.errors import UserError
from dopepp.data.sample import Sample
from dopepp.experiment.build.sources import (
    build_parts,
    build_scaled_test_source,
    build_test_source,
)
from dopepp.experiment.build.system import build_system
from dopepp.experiment.command_line import entry
from dopepp.experiment.config.run import RunConfig
from dopepp.experiment.evaluate import measure_and_record
from dopepp.experiment.reports.evaluators import Cost, FileMethod, FilePose, ImageId
from dopepp.experiment.reports.protocols import SHORT_NAMES, Protocols
from dopepp.experiment.reports.report import measure
from dopepp.experiment.reports.tables import ADD_01D, ADD_5CM
from dopepp.inference.estimator import PoseEstimator
from dopepp.models.checkpoint.schema import load_network, write_atomic
from dopepp.parts.part import Part

Composer = Callable[..., dict[str, Any]]
Parser = Callable[..., RunConfig]
SCALES = (0.5, 20.0)


class Finder:
    """Gives the true pose, a bit beside it, of what is at most so far away."""

    def __init__(self, part: Part, farthest: float, offset: float) -> None:
        self.parts: Sequence[Part] = [part]
        self.farthest, self.offset = farthest, offset

    def detect(self, sample: Sample, image: ImageId) -> tuple[Sequence[FilePose], float | None]:
        found = []
        for one in sample.instances:
            if one.T_cam_obj[2, 3] < self.farthest:
                T = one.T_cam_obj.copy()
                T[0, 3] += self.offset
                found.append(FilePose(one.label, 1.0, T, one.keypoints))
        return found, None

    def cost(self, seconds: Sequence[float]) -> Cost:
        return Cost()


def test_every_method_is_measured_at_every_scale(
    tiny: Parser, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = tiny().data
    (part,) = build_parts(data)
    source = build_test_source(data, [part])
    scaled = {scale: build_scaled_test_source(data, [part], scale) for scale in SCALES}
    usual = [source.sample(index).instances[0] for index in range(3)]
    far = [scaled[0.5].sample(index).instances[0] for index in range(3)]
    for one, other in zip(usual, far, strict=True):
        centre, farther = (i.T_cam_obj @ [*part.cuboid[8], 1] for i in (one, other))
        np.testing.assert_allclose(farther[:3], 2 * centre[:3])
    assert not any(scaled[20.0].sample(index).instances for index in range(3))  # too near to stand

    farthest = 1.05 * max(one.T_cam_obj[2, 3] for one in usual)
    methods = {"dope": Finder(part, farthest, 0.02), "dopepp": Finder(part, 10.0, 0.005)}
    unmoved = measure(methods, [source.sample(index) for index in range(3)], 1)
    levels, tiles = measure_scales(methods, scaled, unmoved, 1)
    record_condition(tmp_path, SCALE, levels, tiles, (ADD_5CM, ADD_01D))

    with (tmp_path / "scale.csv").open(newline="") as stream:
        rows = {(row["method"], float(row["scale"])): row for row in csv.DictReader(stream)}
    assert list(rows) == [(name, scale) for name in methods for scale in (0.5, 1, 20)]
    for (method, scale), row in rows.items():
        if scale == 20:
            assert row["num_instances"] == "0"
            assert (row["visible_fraction"], row["add_01d"]) == ("", "")
            continue
        found = method == "dopepp" or scale == 1
        assert row["num_instances"] == "3"
        assert float(row["visible_fraction"]) > 0.7
        assert float(row["pass_5cm"]) == found
        assert float(row["add_01d"]) == (method == "dopepp")
        assert float(row["miss_rate"]) == 1 - found
    assert levels[1].rows == {report.name: report.rows for report in unmoved.reports}
    note = "Instances that count at ×20: none; at ×1: 3, of which "
    assert note in caplog.text
    text = (tmp_path / "scale.md").read_text()
    assert note in text
    assert "| method | object | ×0.5 | ×1 | ×20 |" in text
    assert "| dope | pivconnector | 0.0 | 100.0 | n/a |" in text
    assert [tile.caption for tile in tiles] == [f"test/0/0, ×{scale}" for scale in ("0.5", 1, 20)]
    sheet = cv2.imread(str(tmp_path / "scale_examples.png"))
    assert sheet.shape[1] > 3 * 320  # a column per scale
    assert cv2.imread(str(tmp_path / "scale.png")).std() > 0


def test_untrained_networks_end_to_end(tiny: Parser, tmp_path: Path) -> None:
    config = tiny("data.num_test=2")
    data, parts = config.data, build_parts(config.data)
    system = build_system(config, parts, "")
    weights = {f"network.{name}": value for name, value in system.network.state_dict().items()}
    write_atomic({"state_dict": weights, "dopepp": system.payload}, tmp_path / "untrained.ckpt")
    estimator = PoseEstimator(*load_network(tmp_path / "untrained.ckpt"))
    both, protocols = {"dope": estimator, "dopepp": estimator}, Protocols(scales=(0.5,))
    reports = measure_and_record(both, parts, data, tmp_path, num_pictures=2, protocols=protocols)
    with (tmp_path / "scale.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["method"], row["scale"]) for row in rows] == [
        (name, scale) for name in both for scale in ("0.5", "1.0")
    ]
    assert {row["num_instances"] for row in rows} == {"2"}
    for report, row in zip(reports, rows[1::2], strict=True):
        assert float(row["auc_10cm"]) == report.rows["pivconnector"].auc_10cm
    for name in ("scale.png", "scale_examples.png", "overlay.png"):
        assert cv2.imread(str(tmp_path / name)) is not None, name


def test_a_camera_that_cannot_be_moved_is_refused(tiny: Parser) -> None:
    data = replace(tiny().data, root=Path("photos"))
    with pytest.raises(UserError, match=r"scale=2 on the images in data\.root=") as error:
        build_scaled_test_source(data, [], 2.0)
    assert "\n" not in str(error.value)
    poses = FileMethod.__new__(FileMethod)
    with pytest.raises(UserError, match="scale with results of posecnn"):
        SCALE.check_methods({"posecnn": poses})


def test_scale_is_short_for_an_option(composed: Composer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "scale=[0.5,1,2]", "data.num_test=3"])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    seen: list[str] = []
    entry(lambda: seen.extend(sys.argv[1:]), ["data"], SHORT_NAMES)
    assert seen == ["scale_factors=[0.5,1,2]", "++data.num_test=3"]
    config = composed(seen[0], config="evaluate")
    assert Protocols.of(config) == Protocols(scales=(0.5, 2.0))
    assert not replace(Protocols.of(config), scales=())
    assert not Protocols.of(composed())  # a training has no such option


@pytest.mark.parametrize(
    "given",
    [0, [0.5, 0], [-1], [float("nan")], [float("inf")], [21], [1], [], "big", [True], {"a": 2}],
)
def test_wrong_scales_are_told_in_one_line(given: object) -> None:
    config = {"shading": None, "by": None, "num_bins": 5, "scale_factors": given}
    with pytest.raises(UserError, match=r"scale=.*; allowed: factors from 0\.05 to 20") as error:
        Protocols.of(config)
    assert "\n" not in str(error.value)
    assert Protocols.of({**config, "scale_factors": 2}).scales == (2.0,)
