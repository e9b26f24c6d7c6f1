"""The expected calibration error against a loop over bins."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dopepp.metrics.functional import expected_calibration_error


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 60), bins=st.integers(1, 20))
def test_it_is_its_definition(seed: int, count: int, bins: int) -> None:
    rng = np.random.default_rng(seed)
    scores, correct = rng.integers(0, 41, count) / 40, rng.random(count) < 0.5
    expected = 0.0
    for k in range(bins):
        inside = (scores * bins > k) & (scores * bins <= k + 1)
        if k == 0:
            inside |= scores == 0
        if inside.any():
            expected += inside.mean() * abs(scores[inside].mean() - correct[inside].mean())
    result = expected_calibration_error(torch.from_numpy(scores), torch.from_numpy(correct), bins)
    assert result == pytest.approx(expected, abs=1e-12)


def test_ends_and_mistakes() -> None:
    none = torch.zeros(0)
    assert expected_calibration_error(none, none.bool()) == 0.0
    assert expected_calibration_error(torch.ones(3), torch.ones(3, dtype=torch.bool)) == 0.0
    assert expected_calibration_error(torch.ones(3), torch.zeros(3, dtype=torch.bool)) == 1.0
    for scores in (torch.tensor([1.5]), torch.tensor([torch.nan])):
        with pytest.raises(ValueError, match=r"\[0, 1\]"):
            expected_calibration_error(scores, torch.ones(1, dtype=torch.bool))
    with pytest.raises(ValueError, match="bins"):
        expected_calibration_error(torch.ones(2), torch.ones(1, dtype=torch.bool))
