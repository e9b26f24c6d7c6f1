"""Average precision and recall against their definitions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dopepp.errors import UserError
from dopepp.metrics.functional import (
    BOP_MSPD_THRESHOLDS,
    BOP_THRESHOLDS,
    average_precision,
    average_recall,
    pass_rate,
)

Array = NDArray[np.float64]


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
