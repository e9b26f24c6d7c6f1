from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from dopepp.training.callbacks.rate_sweep import RateSweep, exponential, smooth, suggest

RATES = np.geomspace(1e-6, 1, 200)


def losses(middle: float, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """Fall from 2 to 1 around a rate, within a factor of about ten, and diverge 100 times above."""
    x = np.log10(RATES / middle)
    valley = 1 + 1 / (1 + np.exp(4 * x)) + np.exp(np.minimum(6 * (x - 2), 50))
    result: np.ndarray = valley + noise * np.random.default_rng(seed).normal(size=len(x))
    return result


@pytest.mark.parametrize("middle", [1e-4, 1e-3])
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_the_rate_at_which_the_loss_falls_fastest(middle: float, noise: float) -> None:
    for seed in range(10):
        found = suggest(RATES, losses(middle, noise, seed))
        assert found is not None
        assert middle / 4 < found.steepest < 4 * middle
        assert found.steepest < found.lowest < 300 * middle


def test_a_loss_that_does_not_fall_suggests_nothing() -> None:
    noise = 0.01 * np.random.default_rng(0).normal(size=200)
    assert suggest(RATES, 1 + noise) is None
    assert suggest(RATES, np.linspace(1, 3, 200)) is None
    assert suggest(RATES[:3], np.ones(3)) is None


def test_smoothing_keeps_constants_and_lies_between_the_extremes() -> None:
    np.testing.assert_allclose(smooth(np.full(37, 2.5)), 2.5)
    values = np.random.default_rng(1).normal(size=100)
    smoothed = smooth(values)
    assert smoothed.std() < 0.5 * values.std()
    assert values.min() < smoothed.min() < smoothed.max() < values.max()


def test_the_schedule_goes_from_the_first_to_the_last_rate() -> None:
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1e-5)
    scheduler = exponential(1e-5, 1e-1)(optimizer, 5)
    rates = []
    for _ in range(5):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    np.testing.assert_allclose(rates, [1e-5, 1e-4, 1e-3, 1e-2, 1e-1], rtol=1e-9)


@pytest.mark.parametrize(("bad", "kept"), [(float("nan"), 20), (1e6, 23)])
def test_a_sweep_ends_where_the_loss_diverges(bad: float, kept: int) -> None:
    sweep: Any = RateSweep()
    group = {"lr": 0.0}
    trainer = SimpleNamespace(
        optimizers=[SimpleNamespace(param_groups=[group])],
        accumulate_grad_batches=1,
        should_stop=False,
    )
    for step in range(40):
        group["lr"] = 10.0 ** (step / 10 - 6)
        sweep.on_train_batch_start(trainer, None, None, step)
        loss = 1.0 if step < 20 else bad
        sweep.on_train_batch_end(trainer, None, {"loss": torch.tensor(loss)}, None, step)
        if trainer.should_stop:
            break
    assert trainer.should_stop
    assert len(sweep.rates) == len(sweep.losses) == kept
    assert sweep.rates[10] == pytest.approx(1e-5)
