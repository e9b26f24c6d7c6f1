"""The accumulator: matching, counting, rates and the cases in which there is nothing to count."""

from __future__ import annotations

import copy
import json
import math
import pickle
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dopepp.data.sample import Instance
from dopepp.errors import UserError
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.metrics.functional import add, add_s, auc, pass_rate
from dopepp.metrics.pose import MEAN, PoseMetrics
from dopepp.metrics.row import PoseRow
from dopepp.parts.part import Part

Array = NDArray[np.float64]


@dataclass
class Detection:
    object: str
    score: float
    T_cam_obj: Array


def part(name: str, seed: int = 0) -> Part:
    points = np.random.default_rng(seed).uniform(-0.05, 0.05, (200, 3)) * [1, 0.6, 0.2]
    return Part(name, cuboid_keypoints(points.min(0), points.max(0)), 0.12, points)


def pose(x: float = 0.0, rotvec: tuple[float, float, float] = (0, 0, 0)) -> Array:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    T[:3, 3] = [x, 0, 0.6]
    return T


def truth(name: str, T: Array, visible: float = 1.0) -> Instance:
    return Instance(name, T, np.zeros((9, 2)), visible)


def test_rows_agree_with_the_functions() -> None:
    rng = np.random.default_rng(0)
    box = part("box")
    metric = PoseMetrics([box])
    estimates, truths = [], []
    for _ in range(25):
        T = pose(rng.normal(0, 0.1), tuple(rng.normal(size=3)))
        E = T @ pose(0, tuple(rng.normal(0, 0.2, 3)))
        E[:3, 3] = T[:3, 3] + rng.normal(0, 0.005, 3)
        metric.update([Detection("box", 0.9, E)], [truth("box", T)])
        estimates.append(E)
        truths.append(T)
    est, gt = (torch.from_numpy(np.stack(x)) for x in (estimates, truths))
    split = est[:, :3, :3], est[:, :3, 3], gt[:, :3, :3], gt[:, :3, 3]
    points = torch.from_numpy(box.points)
    errors, errors_s = add(*split, points), add_s(*split, points)
    row = metric.compute()["box"]
    assert row.num_instances == 25
    assert row.add_01d == pass_rate(errors, 0.012)
    assert row.pass_5cm == pass_rate(errors, 0.05)
    assert row.pass_10cm == pass_rate(errors, 0.1)
    assert row.auc_10cm == pytest.approx(auc(errors, 0.1), rel=1e-12)
    assert row.add_s_01d == pass_rate(errors_s, 0.012)
    assert row.auc_s_10cm == pytest.approx(auc(errors_s, 0.1), rel=1e-12)
    relative = Rotation.from_matrix(split[0]) * Rotation.from_matrix(split[2]).inv()
    angle = np.median(np.degrees(relative.magnitude()))
    assert row.median_rotation_deg == pytest.approx(angle, rel=1e-9)
    distance = np.median(np.linalg.norm(split[1] - split[3], axis=1))
    assert row.median_translation == pytest.approx(distance, rel=1e-9)
    assert (row.miss_rate, row.precision, row.false_positives) == (0, 1, 0)
    np.testing.assert_allclose(metric.errors("box"), errors, rtol=1e-12)
    assert metric.compute()[MEAN].auc_10cm == row.auc_10cm


def test_duplicates_are_false_positives_and_the_better_score_counts() -> None:
    metric = PoseMetrics([part("box")])
    metric.update(
        [Detection("box", 0.2, pose(0)), Detection("box", 0.9, pose(0.03))], [truth("box", pose())]
    )
    row = metric.compute()["box"]
    assert metric.errors("box") == pytest.approx([0.03])
    assert (row.false_positives, row.precision, row.miss_rate) == (1, 0.5, 0)


def test_a_prediction_farther_than_ten_centimetres_is_a_miss_and_a_false_positive() -> None:
    metric = PoseMetrics([part("box")])
    metric.update([Detection("box", 0.9, pose(0.11))], [truth("box", pose())])
    row = metric.compute()["box"]
    assert (row.miss_rate, row.precision, row.false_positives) == (1, 0, 1)
    assert metric.errors("box").tolist() == [math.inf]


def test_the_distance_is_taken_between_centres_not_origins() -> None:
    # The origin lies half a metre beside the part: a small turn moves the centre out of reach.
    points = np.random.default_rng(0).uniform([0.45, -0.05, -0.05], [0.55, 0.05, 0.05], (50, 3))
    far = Part("far", cuboid_keypoints(points.min(0), points.max(0)), 0.1, points)
    metric = PoseMetrics([far])
    metric.update([Detection("far", 1, pose(0, (0, 0, 0.4)))], [truth("far", pose())])
    assert metric.compute()["far"].miss_rate == 1


def test_an_instance_hardly_visible_neither_counts_nor_makes_a_false_positive() -> None:
    metric = PoseMetrics([part("box")])
    hidden = truth("box", pose(0.3), visible=0.0999)
    metric.update([Detection("box", 0.9, pose(0.3))], [truth("box", pose(0), 0.1), hidden])
    row = metric.compute()["box"]
    assert (row.num_instances, row.miss_rate, row.false_positives) == (1, 1, 0)
    # A second prediction there has no instance left to explain it.
    metric.update([Detection("box", s, pose(0.3)) for s in (0.9, 0.8)], [hidden])
    assert metric.compute()["box"].false_positives == 1


def test_an_instance_that_counts_is_matched_before_a_hidden_one() -> None:
    metric = PoseMetrics([part("box")])
    metric.update(
        [Detection("box", 0.9, pose(0.01))],
        [truth("box", pose(0.01), 0.05), truth("box", pose(0.0), 0.9)],
    )
    assert metric.errors("box") == pytest.approx([0.01])


def test_objects_do_not_match_each_other() -> None:
    metric = PoseMetrics([part("a"), part("b")])
    metric.update([Detection("a", 0.9, pose())], [truth("b", pose()), truth("other", pose())])
    rows = metric.compute()
    assert (rows["a"].num_instances, rows["a"].false_positives) == (0, 1)
    assert (rows["b"].num_instances, rows["b"].miss_rate) == (1, 1)


def test_a_detection_of_an_unknown_object_is_refused() -> None:
    metric = PoseMetrics([part("a"), part("b")])
    with pytest.raises(UserError, match="got a detection of 'c'; allowed: the scored parts a, b"):
        metric.update([Detection("c", 1, pose())], [])


@pytest.mark.parametrize("names", [[], ["a", "a"], ["a", "mean"]])
def test_parts_must_have_names_of_their_own(names: list[str]) -> None:
    with pytest.raises(UserError, match="one or more parts of different names"):
        PoseMetrics([part(name) for name in names])


def test_all_missed_gives_zero_and_no_nan() -> None:
    metric = PoseMetrics([part("box")])
    for _ in range(3):
        metric.update([], [truth("box", pose())])
    row = metric.compute()["box"]
    assert row == PoseRow(
        object="box",
        method="estimate",
        num_instances=3,
        add_01d=0.0,
        pass_5cm=0.0,
        pass_10cm=0.0,
        auc_10cm=0.0,
        add_s_01d=0.0,
        auc_s_10cm=0.0,
        median_rotation_deg=None,
        median_translation=None,
        miss_rate=1.0,
        precision=0.0,
        false_positives=0,
    )


@pytest.mark.filterwarnings("ignore:The ``compute`` method of metric PoseMetrics was called")
def test_nothing_at_all_is_not_available() -> None:
    metric = PoseMetrics([part("a"), part("b")])
    for row in metric.compute().values():
        assert row == PoseRow(row.object, "estimate", num_instances=0, false_positives=0)
    assert metric.errors("a").shape == (0,)


def test_an_object_without_ground_truth_stays_out_of_the_mean() -> None:
    metric = PoseMetrics([part("a"), part("b"), part("c")])
    metric.update(
        [Detection("a", 1, pose()), Detection("c", 1, pose())],
        [truth("a", pose()), truth("b", pose())],
    )
    rows = metric.compute()
    assert rows["c"].add_01d is None
    assert rows["c"].texts()["ADD-0.1d %"] == "n/a"
    assert rows[MEAN].add_01d == 0.5
    assert rows[MEAN].median_rotation_deg == 0.0  # only a was matched
    assert (rows[MEAN].num_instances, rows[MEAN].false_positives) == (2, 1)
    assert json.loads(json.dumps(rows["c"].to_record(), allow_nan=False))["add_01d"] is None


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_pose_that_is_not_finite_is_a_miss_and_a_false_positive(bad: float) -> None:
    metric = PoseMetrics([part("box")])
    metric.update([Detection("box", 0.9, np.full((4, 4), bad))], [truth("box", pose())])
    row = metric.compute()["box"]
    assert (row.miss_rate, row.false_positives, row.auc_10cm) == (1, 1, 0)
    assert not any(isinstance(v, float) and math.isnan(v) for v in row.to_record().values())


def test_reset_pickle_and_copy() -> None:
    metric = PoseMetrics([part("box")])
    metric.update([Detection("box", 0.9, pose(0.01))], [truth("box", pose())])
    for twin in (copy.deepcopy(metric), pickle.loads(pickle.dumps(metric))):
        assert twin.compute() == metric.compute()
    metric.reset()
    metric.update([], [truth("box", pose())])
    assert metric.compute()["box"].num_instances == 1
    assert metric.errors("box").tolist() == [math.inf]


def test_forward_returns_the_image_and_keeps_the_sum() -> None:
    metric = PoseMetrics([part("box")])
    assert metric([Detection("box", 1, pose())], [truth("box", pose())])["box"].add_01d == 1
    assert metric([], [truth("box", pose())])["box"].add_01d == 0
    assert metric.compute()["box"].add_01d == 0.5


def test_references_use_the_instances_that_count() -> None:
    metric = PoseMetrics([part("a"), part("b")])
    for angle in (0.0, 0.1, 0.2):
        metric.update([], [truth("a", pose(0, (0, 0, angle))), truth("a", pose(0.3), 0.01)])
    table = metric.references()
    assert list(table) == ["chance, all rotations", "chance, test range", "best constant pose"]
    for rows in table.values():
        assert rows["a"].num_instances == 3
        assert rows["b"].add_01d is None
        assert rows[MEAN].add_01d == rows["a"].add_01d


def test_plot_shows_one_curve_per_object() -> None:
    metric = PoseMetrics([part("a"), part("b")], method="DOPE++")
    metric.update([Detection("a", 1, pose(0.05))], [truth("a", pose()), truth("b", pose())])
    figure, axes = metric.plot()
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["a (AUC 50.0 %)", "b (AUC 0.0 %)"]
    assert figure.axes == [axes]
