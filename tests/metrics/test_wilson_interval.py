from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binomtest

from dopepp.metrics.functional import wilson_interval


@settings(deadline=None, max_examples=100)
@given(
    counts=st.integers(1, 5000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))),
    confidence=st.floats(0.5, 0.999),
)
def test_it_is_scipys(counts: tuple[int, int], confidence: float) -> None:
    passed, num = counts
    low, high = wilson_interval(passed, num, confidence)
    theirs = binomtest(passed, num).proportion_ci(confidence, method="wilson")
    assert (low, high) == pytest.approx((theirs.low, theirs.high), abs=1e-9)
    assert 0 <= low <= passed / num <= high <= 1


def test_without_trials_nothing_is_known() -> None:
    assert wilson_interval(0, 0) == (0.0, 1.0)


@pytest.mark.parametrize("arguments", [(-1, 2), (3, 2), (1, 2, 0.0), (1, 2, 1.0)])
def test_impossible_counts_are_refused(arguments: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=f"passed={arguments[0]}"):
        wilson_interval(*arguments)
