"""Rates, areas, matches and intervals against loops over their definitions, scipy and by hand."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest, chi2

from dopepp.metrics.functional import (
    BOP_MSPD_THRESHOLDS,
    BOP_THRESHOLDS,
    auc,
    average_precision,
    average_recall,
    coverage,
    expected_calibration_error,
    match,
    pass_rate,
    region_levels,
    wilson_interval,
)

REL = 1e-9
NAN = math.nan
ONES, TRUE = torch.ones(2), torch.tensor([True, True])


def voc_loop(errors, maximum):
    """YCB-Video's rule, written from its description: right-sided rectangles over sorted errors."""
    total, previous, result = 0.0, 0.0, 0
    for error in sorted(e for e in errors if e <= maximum):
        result += 1
        total += (error - previous) * result / len(errors)
        previous = error
    if result == 0:
        return 0.0
    return (total + (maximum - previous) * result / len(errors)) / maximum


ERRORS = st.lists(
    st.one_of(st.floats(0, 0.2), st.sampled_from([0.0, 0.05, 0.1, math.inf, math.nan])), max_size=30
)


@given(ERRORS)
def test_auc_equals_loops(errors):
    values = torch.tensor(errors, dtype=torch.float64)
    exact = sum(1 - e / 0.1 for e in errors if e <= 0.1) / max(len(errors), 1)
    assert auc(values, 0.1) == pytest.approx(exact, rel=REL, abs=1e-15)
    voc = auc(values, 0.1, "voc")
    assert voc == pytest.approx(voc_loop(errors, 0.1), rel=REL, abs=1e-15)
    hits = [e for e in errors if e <= 0.1]
    if hits:  # the documented difference between the two
        assert voc - exact == pytest.approx(max(hits) / (len(errors) * 0.1), rel=1e-6, abs=1e-12)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: match(ONES, torch.zeros(3, 1), 0.1), "2 scores need as many rows"),
        (lambda: average_precision(ONES, TRUE, 1), "2 correct predictions of 1"),
        (lambda: average_precision(ONES, TRUE[:1], 1), "differ"),
        (lambda: expected_calibration_error(1.5 * ONES, TRUE), r"\[0, 1\]"),
        (lambda: expected_calibration_error(ONES * NAN, TRUE), r"\[0, 1\]"),
        (lambda: expected_calibration_error(ONES, TRUE[:1]), "differ"),
    ],
    ids=["rows", "too many", "lengths", "above 1", "NaN", "one label"],
)
def test_wrong_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_pass_rate_is_strict_and_misses_count():
    errors = torch.tensor([0.0, 0.05, 0.1, math.inf, math.nan], dtype=torch.float64)
    assert (pass_rate(errors, 0.05), pass_rate(errors, 0.1)) == (0.2, 0.4)
    assert (pass_rate(torch.empty(0), 0.1), pass_rate(errors[3:], 0.1)) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("scores", "distances", "expected"),
    [
        pytest.param([1, 1], [[0.1, 0.1]] * 2, [0, 1], id="ties go by order, at the limit"),
        pytest.param([1], [[0.1000001]], [-1], id="beyond the limit"),
        pytest.param([1], [[0.02, 0.02]], [0], id="one of two"),
        pytest.param([NAN, 0.1], [[NAN, 0.02], [0.01, NAN]], [1, 0], id="unknown"),
        pytest.param([], np.zeros((0, 3)), [], id="no detections"),
        pytest.param([1, 1], np.zeros((2, 0)), [-1, -1], id="no instances"),
    ],
)
def test_match_of_special_cases(scores, distances, expected):
    distances = torch.tensor(distances, dtype=torch.float64)
    assert match(torch.tensor(scores), distances, 0.1).tolist() == expected


@given(st.integers(0, 6), st.integers(0, 6), st.integers(0, 10_000))
def test_match_equals_a_plain_loop(p, g, seed):
    rng = np.random.default_rng(seed)
    scores, distances, radius = rng.random(p), rng.uniform(0, 0.2, (p, g)), rng.uniform(0, 0.2)
    expected, taken = [-1] * p, set()
    for i in sorted(range(p), key=lambda i: -scores[i]):
        near = sorted((distances[i, j], j) for j in range(g) if j not in taken)
        if near and near[0][0] <= radius:
            expected[i] = near[0][1]
            taken.add(near[0][1])
    result = match(torch.from_numpy(scores), torch.from_numpy(distances), radius)
    assert result.tolist() == expected


@given(seed=st.integers(0, 100_000), count=st.integers(1, 40))
def test_average_precision_is_its_definition(seed, count):
    rng = np.random.default_rng(seed)
    scores = rng.integers(0, 10, count) / 10.0
    correct = rng.random(count) < 0.6
    instances = int(correct.sum()) + int(rng.integers(0, 5)) or 1
    actual, curve = 0, []
    for rank, index in enumerate(np.argsort(-scores, kind="mergesort"), start=1):
        actual += bool(correct[index])
        curve.append((actual / instances, actual / rank))
    levels = np.linspace(0.0, 1.0, 101)
    best = [max((p for r, p in curve if r >= level), default=0.0) for level in levels]
    result = average_precision(torch.from_numpy(scores), torch.from_numpy(correct), instances)
    assert result == pytest.approx(np.mean(best), abs=1e-12)


def test_average_precision_at_the_ends():
    assert average_precision(ONES[:0], TRUE[:0], 3) == 0.0
    assert average_precision(ONES, ~TRUE, 0) == 0.0
    assert average_precision(ONES, TRUE, 2) == 1.0
    assert average_precision(torch.tensor([NAN, 0.1]), torch.tensor([False, True]), 1) == 1.0


def test_average_recall_is_the_mean_of_strict_pass_rates():
    errors = torch.tensor([0.05, 0.07, 0.3, torch.inf, torch.nan])
    rates = [pass_rate(errors, threshold) for threshold in BOP_THRESHOLDS]
    assert (rates[0], rates[-1]) == (0.0, pytest.approx(0.6))
    assert average_recall(errors, BOP_THRESHOLDS) == pytest.approx(sum(rates) / 10)
    assert average_recall(torch.zeros(0), BOP_MSPD_THRESHOLDS) == 0.0
    assert (len(BOP_THRESHOLDS), BOP_THRESHOLDS[2], BOP_MSPD_THRESHOLDS[-1]) == (10, 0.15, 50.0)


@given(st.integers(0, 5000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilsons_interval_is_scipys(counts):
    passed, num = counts
    low, high = wilson_interval(passed, num)
    if num == 0:  # without trials the rate is unknown
        assert (low, high) == (0.0, 1.0)
        return
    theirs = binomtest(passed, num).proportion_ci(0.95, method="wilson")
    assert (low, high) == pytest.approx((theirs.low, theirs.high), abs=1e-9)
    assert 0 <= low <= passed / num <= high <= 1


@given(seed=st.integers(0, 10_000), count=st.integers(1, 60))
def test_calibration_error_is_its_definition(seed, count):
    rng = np.random.default_rng(seed)
    scores, correct = rng.integers(0, 41, count) / 40, rng.random(count) < 0.5
    expected = 0.0
    for k in range(10):
        inside = (scores * 10 > k) & (scores * 10 <= k + 1)
        if k == 0:
            inside |= scores == 0
        if inside.any():
            expected += inside.mean() * abs(scores[inside].mean() - correct[inside].mean())
    result = expected_calibration_error(torch.from_numpy(scores), torch.from_numpy(correct))
    assert result == pytest.approx(expected, abs=1e-12)


def test_calibration_error_of_extreme_scores():
    assert expected_calibration_error(ONES[:0], TRUE[:0]) == 0.0
    assert expected_calibration_error(ONES, TRUE) == 0.0
    assert expected_calibration_error(ONES, ~TRUE) == 1.0


@given(st.lists(st.floats(0, 40) | st.sampled_from([1e3, 1e200]), max_size=30))
def test_levels_of_regions_are_those_of_chi_squared(distances):
    expected = chi2.cdf(np.square(distances), 6)
    levels = region_levels(torch.tensor(distances, dtype=torch.float64))
    np.testing.assert_allclose(levels, expected, rtol=1e-12, atol=1e-14)


def test_coverage_of_correct_and_of_too_small_covariances():
    rng = np.random.default_rng(0)
    distances = torch.from_numpy(np.linalg.norm(rng.normal(size=(20_000, 6)), axis=1))
    for level in (0.1, 0.5, 0.9, 0.99):
        assert coverage(distances, level) == pytest.approx(level, abs=0.01)
        # Half of the true deviations give twice the distance.
        expected = chi2.cdf(chi2.ppf(level, 6) / 4, 6)
        assert coverage(2 * distances, level) == pytest.approx(expected, abs=0.01)
    assert coverage(torch.tensor([0.0, math.inf, math.nan, math.inf])) == 0.25
    assert coverage(torch.zeros(0)) == 0.0
