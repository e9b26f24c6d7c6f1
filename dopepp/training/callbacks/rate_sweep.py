"""A sweep of the learning rate: one short training whose rate grows from step to step.

After Smith, "Cyclical Learning Rates for Training Neural Networks", WACV 2017, section 3.3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from lightning.pytorch import Callback, LightningModule, Trainer
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR, LRScheduler

from dopepp.training.system import SchedulerFactory

_DIVERGED: Final = 4.0
"""A smoothed loss of so many times the lowest one will not come back."""
_SMOOTHING: Final = 0.05
"""Standard deviation of the smoothing, as a share of the sweep: noise of single batches goes, the
valley stays."""
_SKIPPED: Final = 0.1
"""Share of the sweep at its beginning in which nothing is looked for: the optimiser's averages and
batch norm's statistics are still settling."""
_MIN_FALL: Final = 0.05
"""A loss that falls by less than this share in the whole sweep says nothing."""


@dataclass(frozen=True)
class Suggestion:
    """What a sweep says.

    Attributes:
        steepest: Rate at which the loss falls fastest: the one to begin with.
        lowest: Rate at which the loss is lowest; it diverges somewhere above.
    """

    steepest: float
    lowest: float


def exponential(first: float, last: float) -> SchedulerFactory:
    """Return a schedule from one rate to another by a constant factor a step."""

    def make(optimizer: Optimizer, num_steps: int) -> LRScheduler:
        growth = math.log(last / first) / max(1, num_steps - 1)
        return LambdaLR(optimizer, lambda step: math.exp(growth * step))

    return make


class RateSweep(Callback):
    """Records rate and loss of every step, and ends the training once the loss has diverged.

    Attributes:
        rates: Learning rates, ascending.
        losses: The loss of each step's batch, before the step is taken.
    """

    def __init__(self) -> None:
        self.rates: list[float] = []
        self.losses: list[float] = []

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Note the rate before the schedule moves on."""
        self._rate = float(trainer.optimizers[0].param_groups[0]["lr"])

    def on_train_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Note the loss; stop where going on makes no sense."""
        loss = float(outputs["loss"]) * trainer.accumulate_grad_batches
        if not math.isfinite(loss):
            trainer.should_stop = True
            return
        self.rates.append(self._rate)
        self.losses.append(loss)
        recent = np.array(self.losses[-5:])
        if np.median(recent) > _DIVERGED * np.min(smooth(np.array(self.losses))):
            trainer.should_stop = True


def smooth(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return a Gaussian mean over neighbours, of what there is near the ends."""
    position = np.arange(len(values))
    width = max(1.0, _SMOOTHING * len(values))
    weight = np.exp(-0.5 * ((position[:, None] - position) / width) ** 2)
    return np.asarray(weight @ values / weight.sum(axis=1))


def suggest(rates: Float[np.ndarray, "n"], losses: Float[np.ndarray, "n"]) -> Suggestion | None:
    """Read a rate off a sweep; None where the loss did not fall.

    Args:
        rates: Ascending, positive.
        losses: Finite, of the same steps.
    """
    first = int(_SKIPPED * len(rates))
    smoothed = smooth(losses)[first:]
    if len(smoothed) < 3:
        return None
    bottom = int(np.argmin(smoothed))
    fall = smoothed[: bottom + 1].max() - smoothed[bottom]
    if bottom < 2 or fall < _MIN_FALL * abs(smoothed[: bottom + 1].max()):
        return None
    slope = np.gradient(smoothed, np.log(rates[first:]))[:bottom]
    steepest = int(np.argmin(slope))
    return Suggestion(float(rates[first + steepest]), float(rates[first + bottom]))
