"""Rates per bin: quantities in closed form, bins and rates by brute force."""

from collections import namedtuple
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest

from dopepp.core.files import read_csv
from dopepp.data.sample import Instance
from dopepp.experiment.results.breakdown import (
    QUANTITIES,
    bin_numbers,
    break_down,
    record_breakdown,
)
from dopepp.experiment.results.frame import ADD_01D, ADD_5CM, reported_rates
from dopepp.geometry.camera import camera_matrix, make_transform, project_keypoints
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.metrics.pose import PoseMetrics
from dopepp.parts.part import Part

K = camera_matrix(600, 610, 320, 240)
RATES = (ADD_5CM, ADD_01D)
Array = NDArray[np.float64]

Detection = namedtuple("Detection", ["object", "score", "T_cam_obj", "covariance"], defaults=[None])


def part(name: str, scale: float = 1.0) -> Part:
    # Away from the origin, so that the centre of the cuboid is not that of the frame.
    points = scale * np.random.default_rng(1).uniform(-0.04, 0.04, (50, 3)) + 0.01
    return Part(name, cuboid_keypoints(points.min(0), points.max(0)), 0.2 * scale, points)


def poses(num: int, seed: int = 0) -> list[Array]:
    centres = np.random.default_rng(seed).uniform([-0.1, -0.1, 0.3], [0.1, 0.1, 2], (num, 3))
    rotations = Rotation.random(num, rng=seed).as_matrix()
    return [make_transform(*pair) for pair in zip(rotations, centres, strict=True)]


def fed(
    parts: list[Part], offsets: dict[str, Array], truths: dict[str, list[Array]]
) -> PoseMetrics:
    """Return metrics with one image per instance and a pose with an offset along x, NaN: missed."""
    metrics = PoseMetrics(parts)
    for name, own in truths.items():
        for number, (T, offset) in enumerate(zip(own, offsets[name], strict=True)):
            estimate = T.copy()
            estimate[0, 3] += offset
            result = [Detection(name, 0.5, estimate)] if np.isfinite(offset) else []
            visible = 0.05 + number / len(own)  # the first does not count
            instance = Instance(name, T, np.zeros((9, 2)), min(1.0, visible))
            metrics.update([item for item in result if name in metrics.parts], [instance], K, 640)
    return metrics


@pytest.fixture
def measured():
    rng = np.random.default_rng(3)
    truths = {"a": poses(30, 1), "b": poses(20, 2)}
    offsets = {
        name: np.where(rng.random(len(own)) < 0.2, np.nan, rng.uniform(0, 0.09, len(own)))
        for name, own in truths.items()
    }
    return fed([part("a"), part("b", 3.0)], offsets, truths), truths, offsets


def test_quantities_in_closed_form(measured):
    metrics, truths, _ = measured
    instances = metrics.instances("a")
    counted = truths["a"][2:]  # two of 30 are less than 10 % visible
    centre = np.append(part("a").cuboid[8], 1)
    centres = np.array([(T @ centre)[:3] for T in counted])
    values = {name: quantity.of(instances) for name, quantity in QUANTITIES.items()}
    np.testing.assert_allclose(values["distance"], np.linalg.norm(centres, axis=1))
    np.testing.assert_allclose(values["visibility"], np.minimum(1, 0.05 + np.arange(2, 30) / 30))
    areas = [ConvexHull(project_keypoints(part("a").cuboid, T, K)[:8]).volume for T in counted]
    np.testing.assert_allclose(values["size"], np.sqrt(areas), rtol=1e-5)
    cosines = [-(T[:3, 2] @ c) / np.linalg.norm(c) for T, c in zip(counted, centres, strict=True)]
    np.testing.assert_allclose(values["rotation"], np.degrees(np.arccos(cosines)), atol=1e-6)


@given(
    values=st.lists(st.integers(0, 12) | st.floats(0, 12), max_size=60), num_bins=st.integers(1, 8)
)
def test_bins_ascend_and_equal_values_share_a_bin(values, num_bins):
    array = np.array(values, np.float64)
    bins = bin_numbers(array, num_bins)
    order = np.argsort(array, kind="stable")
    assert (np.diff(bins[order]) >= 0).all()
    assert set(bins.tolist()) == set(range(len(set(bins.tolist()))))
    assert len(set(bins.tolist())) <= num_bins
    for value in array:
        assert len(set(bins[array == value].tolist())) == 1
    if len(set(values)) == len(values) >= num_bins:
        counts = np.bincount(bins, minlength=num_bins)
        assert np.ptp(counts) <= 1


def test_rates_of_bins_by_brute_force(measured, tmp_path):
    metrics, truths, offsets = measured
    record_breakdown(tmp_path, {"dopepp": metrics}, "distance", 4, RATES)
    rows = read_csv(tmp_path / "by_distance.csv")
    everything = [
        (float(np.linalg.norm((T @ np.append(part(name, scale).cuboid[8], 1))[:3])), scale, offset)
        for name, scale in (("a", 1.0), ("b", 3.0))
        for T, offset in list(zip(truths[name], offsets[name], strict=True))[
            2 if name == "a" else 1 :
        ]
    ]
    everything.sort()
    groups = np.array_split(np.arange(len(everything)), 4)
    assert sum(int(row["num_instances"]) for row in rows) == len(everything)
    start = 0
    for row, group in zip(rows, groups, strict=True):
        num = int(row["num_instances"])
        assert abs(num - len(group)) <= 1
        inside = everything[start : start + num]
        start += num
        assert float(row["from"]) == pytest.approx(inside[0][0])
        assert float(row["to"]) == pytest.approx(inside[-1][0])
        # All points move alike, so ADD is the offset.
        passed = sum(offset < 0.02 * scale for _, scale, offset in inside)
        assert float(row["add_01d"]) == pytest.approx(passed / num)
        assert float(row["pass_5cm"]) == pytest.approx(sum(o < 0.05 for *_, o in inside) / num)
        interval = binomtest(passed, num).proportion_ci(method="wilson")
        assert float(row["add_01d_low"]) == pytest.approx(interval.low)
        assert float(row["add_01d_high"]) == pytest.approx(interval.high)
        assert float(row["miss_rate"]) == pytest.approx(np.mean([np.isnan(o) for *_, o in inside]))
        if row["median_rotation_deg"]:
            assert float(row["median_rotation_deg"]) == pytest.approx(0, abs=1e-6)
    image = cv2.imread(str(tmp_path / "by_distance.png"))
    assert image.std() > 0


def test_numbers_with_equal_text_share_a_bin(measured, monkeypatch):
    metrics, *_ = measured
    fractions = iter([0.99991, 0.99994, 0.99998, 1.0] * 50)
    alike = QUANTITIES["visibility"]._replace(
        of=lambda poses: np.array([next(fractions) for _ in poses.T_gt])
    )
    monkeypatch.setitem(QUANTITIES, "visibility", alike)
    bins, _ = break_down({"dopepp": metrics}, "visibility", 4, RATES)
    assert [(each.low, each.high) for each in bins] == [(0.99991, 1.0)]


def test_methods_share_bins_and_score_their_own_objects(measured):
    metrics, truths, _ = measured
    perfect = fed([part("a")], {"a": np.zeros(30)}, {"a": truths["a"]})
    bins, values = break_down({"dope": perfect, "dopepp": metrics}, "size", 3, RATES)
    dope, dopepp = ([v for v in values if v.method == name] for name in ("dope", "dopepp"))
    alone = break_down({"dopepp": metrics}, "size", 3, RATES)
    assert (bins, str(dopepp)) == (alone[0], str(alone[1]))
    assert sum(value.value for value in dope if value.measure == "num_instances") == 28
    assert {item.text for item in dope if item.measure == "add_01d"} <= {"n/a", "100.0"}


@pytest.mark.filterwarnings("ignore:The ``compute`` method of metric PoseMetrics was called")
def test_without_instances_there_is_a_warning(tmp_path, caplog):
    record_breakdown(tmp_path, {"dopepp": PoseMetrics([part("a")])}, "rotation", 5, RATES)
    assert "by=rotation: no bins, because the test set has no evaluated instance" in caplog.text
    assert not list(tmp_path.iterdir())


def test_the_reported_rate_depends_on_the_data():
    for root, rate in ((Path("data"), "pass_10cm"), (None, "pass_5cm")):
        data: Any = SimpleNamespace(format="ycb_video", root=root)
        columns = reported_rates(data, [part("a")])
        assert [column.field for column in columns] == [rate, "add_01d"]


def test_symmetric_parts_have_a_symmetric_rate(tmp_path):
    half_turn = np.diag([-1.0, -1, 1, 1])
    symmetric = replace(part("a"), symmetries_discrete=half_turn[None])
    data: Any = SimpleNamespace(format="bop", root=None)
    rates = reported_rates(data, [symmetric])
    assert [column.field for column in rates][2:] == ["mssd_01d"]
    metrics = PoseMetrics([symmetric])
    for T in poses(10):
        metrics.update([Detection("a", 0.5, T @ half_turn)], [Instance("a", T, np.zeros((9, 2)))],
                       K, 640)  # fmt: skip
    record_breakdown(tmp_path, {"dopepp": metrics}, "distance", 1, rates)
    (row,) = read_csv(tmp_path / "by_distance.csv")
    assert (float(row["add_01d"]), float(row["mssd_01d"])) == (0, 1)
    assert float(row["median_rotation_deg"]) == pytest.approx(0, abs=1e-5)
