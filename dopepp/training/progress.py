"""The progress bar: of the present epoch, with the time left for the whole run."""

from __future__ import annotations

import time
from datetime import timedelta

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import TQDMProgressBar

_REFRESH_EVERY = 5
"""Batches; drawing the bar costs more than a small network's step."""


class RunProgress(TQDMProgressBar):
    """Adds ``left``, the time until the run's last step, to the bar of the epoch.

    Extrapolated from all steps since the run began or was resumed, their validations included.
    """

    def __init__(self) -> None:
        super().__init__(refresh_rate=_REFRESH_EVERY)
        self._start, self._first_step = 0.0, 0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock."""
        super().on_train_start(trainer, pl_module)
        self._start, self._first_step = time.monotonic(), trainer.global_step

    def get_metrics(
        self, trainer: Trainer, pl_module: LightningModule
    ) -> dict[str, int | str | float | dict[str, float]]:
        """Return what stands behind the bar."""
        metrics = super().get_metrics(trainer, pl_module)
        done = trainer.global_step - self._first_step
        if done <= 0:
            return metrics
        missing = max(0.0, trainer.estimated_stepping_batches - trainer.global_step)
        seconds = (time.monotonic() - self._start) * missing / done
        return {"left": str(timedelta(seconds=round(seconds))), **metrics}
