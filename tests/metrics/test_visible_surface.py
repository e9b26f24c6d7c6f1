"""VSD against a loop over pixels; average precision and recall against their definitions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dopepp.core.errors import UserError
from dopepp.metrics.functional import (
    BOP_MSPD_THRESHOLDS,
    BOP_THRESHOLDS,
    average_precision,
    average_recall,
    pass_rate,
    vsd,
)

Array = NDArray[np.float64]
K = np.array([[100.0, 0, 7], [0, 110, 6], [0, 0, 1]])


def loop_vsd(est: Array, gt: Array, test: Array, tau: float, delta: float) -> float:
    cost, union = 0, 0
    for v in range(est.shape[0]):
        for u in range(est.shape[1]):
            ray = np.sqrt(((u - K[0, 2]) / K[0, 0]) ** 2 + ((v - K[1, 2]) / K[1, 1]) ** 2 + 1)
            a, b, c = ray * est[v, u], ray * gt[v, u], ray * test[v, u]
            in_gt = b > 0 and (c == 0 or b - c <= delta)
            in_est = a > 0 and (c == 0 or a - c <= delta or in_gt)
            union += in_gt or in_est
            if in_gt != in_est or (in_gt and in_est and abs(a - b) >= tau):
                cost += 1
    return cost / union if union else 1.0


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 100_000))
def test_vsd_is_its_definition(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = (3, 11, 13)
    est, gt, test = (
        np.where(rng.random(shape) < 0.6, rng.normal(0.8, 0.01, shape), 0.0) for _ in range(3)
    )
    est[2], gt[2] = 0.0, 0.0
    taus = [0.004, 0.01, 0.03]
    expected = [[loop_vsd(est[n], gt[n], test[n], tau, 0.015) for tau in taus] for n in range(3)]
    depths = [torch.from_numpy(depth) for depth in (est, gt, test)]
    camera = torch.from_numpy(K)
    np.testing.assert_allclose(vsd(*depths, camera, taus), expected, atol=1e-12)
    shares = [tau / 0.2 for tau in taus]
    np.testing.assert_allclose(vsd(*depths, camera, shares, diameter=0.2), expected, atol=1e-12)


def test_vsd_of_what_nobody_sees_is_one_and_of_the_truth_is_zero() -> None:
    depth = torch.zeros(1, 8, 8)
    depth[:, 2:6, 2:6] = 0.5
    camera = torch.from_numpy(K)
    assert vsd(depth, depth, torch.zeros(1, 8, 8), camera, [0.01]).tolist() == [[0.0]]
    before_it = torch.full((1, 8, 8), 0.2)
    assert vsd(depth, depth, before_it, camera, [0.01]).tolist() == [[1.0]]


def test_vsd_refuses_what_means_nothing() -> None:
    depth, camera = torch.zeros(1, 4, 4), torch.from_numpy(K)
    for taus, delta in (([], 0.015), ([0.0], 0.015), ([0.01], -1.0)):
        with pytest.raises(UserError, match="taus"):
            vsd(depth, depth, depth, camera, taus, delta)
    with pytest.raises(ValueError, match="one shape"):
        vsd(depth, depth, torch.zeros(1, 4, 5), camera, [0.01])


def loop_average_precision(scores: Array, correct: NDArray[np.bool_], instances: int) -> float:
    order = np.argsort(-scores, kind="mergesort")
    found, curve = 0, []
    for rank, index in enumerate(order, start=1):
        found += bool(correct[index])
        curve.append((found / instances, found / rank))
    return float(
        np.mean(
            [
                max((p for r, p in curve if r >= level), default=0.0)
                for level in np.linspace(0.0, 1.0, 101)
            ]
        )
    )


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 100_000), count=st.integers(1, 40))
def test_average_precision_is_its_definition(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    scores = rng.integers(0, 10, count) / 10.0
    correct = rng.random(count) < 0.6
    instances = int(correct.sum()) + int(rng.integers(0, 5)) or 1
    expected = loop_average_precision(scores, correct, instances)
    result = average_precision(torch.from_numpy(scores), torch.from_numpy(correct), instances)
    assert result == pytest.approx(expected, abs=1e-12)


def test_average_precision_at_the_ends() -> None:
    none = torch.zeros(0)
    assert average_precision(none, none.bool(), 3) == 0.0
    assert average_precision(torch.ones(2), torch.zeros(2, dtype=torch.bool), 0) == 0.0
    assert average_precision(torch.ones(2), torch.ones(2, dtype=torch.bool), 2) == 1.0
    unknown = torch.tensor([torch.nan, 0.1])
    assert average_precision(unknown, torch.tensor([False, True]), 1) == 1.0
    with pytest.raises(ValueError, match="3 correct predictions of 2"):
        average_precision(torch.ones(3), torch.ones(3, dtype=torch.bool), 2)
    with pytest.raises(ValueError, match="differ"):
        average_precision(torch.ones(3), torch.ones(2, dtype=torch.bool), 2)


def test_average_recall_is_the_mean_of_strict_pass_rates() -> None:
    errors = torch.tensor([0.05, 0.07, 0.3, torch.inf, torch.nan])
    rates = [pass_rate(errors, threshold) for threshold in BOP_THRESHOLDS]
    assert rates[0] == 0.0
    assert rates[-1] == pytest.approx(0.6)
    assert average_recall(errors, BOP_THRESHOLDS) == pytest.approx(sum(rates) / 10)
    assert average_recall(torch.zeros(0), BOP_MSPD_THRESHOLDS) == 0.0
    assert (len(BOP_THRESHOLDS), BOP_THRESHOLDS[2], BOP_MSPD_THRESHOLDS[-1]) == (10, 0.15, 50.0)
    with pytest.raises(UserError, match="no thresholds"):
        average_recall(errors, [])
