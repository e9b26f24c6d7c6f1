import itertools
from typing import Any

import numpy as np
import pytest
import torch

from dopepp.core.errors import RunError
from dopepp.core.files import read_csv
from dopepp.experiment.run.lr_finder import find_learning_rate, suggest
from dopepp.models.losses import SpatialCrossEntropy

RATES = np.geomspace(1e-6, 1, 200)


def losses(middle: float, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """Fall from 2 to 1 around a rate, within a factor of about ten, and diverge 100 times above."""
    x = np.log10(RATES / middle)
    valley = 1 + 1 / (1 + np.exp(4 * x)) + np.exp(np.minimum(6 * (x - 2), 50))
    return valley + noise * np.random.default_rng(seed).normal(size=len(x))


@pytest.mark.parametrize("middle", [1e-4, 1e-3])
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_the_suggestion_is_where_the_loss_falls_fastest(middle, noise):
    for seed in range(10):
        result = suggest(RATES, losses(middle, noise, seed))
        assert middle / 4 < result.steepest < 4 * middle
        assert result.steepest < result.lowest < 300 * middle


def test_a_loss_that_does_not_fall_has_no_suggestion():
    noise = 0.01 * np.random.default_rng(0).normal(size=200)
    assert suggest(RATES, 1 + noise) is None
    assert suggest(RATES, np.linspace(1, 3, 200)) is None
    assert suggest(RATES[:3], np.ones(3)) is None


def test_a_sweep_ends_at_a_non_finite_loss(tiny, tmp_path, monkeypatch):
    number, forward = itertools.count(), SpatialCrossEntropy.forward

    def broken(self: SpatialCrossEntropy, *maps: Any) -> Any:
        loss, terms = forward(self, *maps)
        return loss * (1 if next(number) < 14 else np.nan), terms

    monkeypatch.setattr(SpatialCrossEntropy, "forward", broken)
    config = tiny("lr_finder.num_steps=20", "lr_finder.min_lr=1e-7", "lr_finder.max_lr=1e-5")
    find_learning_rate(config, tmp_path)
    assert next(number) == 15  # none was made after the first that is not
    rates = [float(row["learning_rate"]) for row in read_csv(tmp_path / "lr_finder.csv")]
    # Lightning's first step is at the lowest rate, and the n-th n / 20 of the way to the highest.
    expected = [1e-7, *(1e-7 * 100 ** (n / 20) for n in range(2, 15))]
    assert rates == pytest.approx(expected)
    assert not list(tmp_path.glob("**/*.ckpt"))


def test_a_loss_that_diverges_at_once_has_no_table(tiny, tmp_path, monkeypatch):
    broken = {"none": torch.full((4,), np.nan, requires_grad=True)}
    monkeypatch.setattr(SpatialCrossEntropy, "parts", lambda *_: broken)
    with pytest.raises(RunError, match=r"diverged after 0 steps .* smaller lr_finder\.min_lr"):
        find_learning_rate(tiny(), tmp_path)
