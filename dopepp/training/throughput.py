"""How fast training runs and what it waits for."""

from __future__ import annotations

import logging
import time
from typing import Any, Final

from lightning.pytorch import Callback, LightningModule, Trainer

from dopepp.data.batch import Batch

_log = logging.getLogger(__name__)

_STARVED: Final = 0.2
"""A larger share of waiting is worth a hint."""


class Throughput(Callback):
    """Logs images per second and the share of an epoch spent waiting for the loader.

    ``throughput/images_per_s`` counts training time only; ``throughput/loader_wait`` is the share
    of it between the end of one step and the arrival of the next batch. Both are said in a line
    per epoch, with what helps where the loader is too slow.
    """

    def __init__(self) -> None:
        self._images, self._waited = 0, 0.0
        self._started = self._step_ended = 0.0

    def state_dict(self) -> dict[str, Any]:
        """Return what has been counted of this epoch."""
        elapsed = self._step_ended - self._started
        return {"images": self._images, "waited_s": self._waited, "elapsed_s": elapsed}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on counting an epoch that was cut off."""
        self._images, self._waited = state_dict["images"], state_dict["waited_s"]
        self._started, self._step_ended = -float(state_dict["elapsed_s"]), 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Leave out the time between a cut-off epoch and its continuation."""
        pause = time.perf_counter() - self._step_ended
        self._started, self._step_ended = self._started + pause, self._step_ended + pause

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clocks."""
        self._images, self._waited = 0, 0.0
        self._started = self._step_ended = time.perf_counter()

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Batch, batch_idx: int
    ) -> None:
        """Count the time since the last step ended as waiting."""
        self._waited += time.perf_counter() - self._step_ended

    def on_train_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Batch,
        batch_idx: int,
    ) -> None:
        """Count the batch's images, over all processes."""
        self._images += len(batch) * trainer.world_size
        self._step_ended = time.perf_counter()

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the epoch's figures."""
        elapsed = max(self._step_ended - self._started, 1e-9)
        speed, waiting = self._images / elapsed, self._waited / elapsed
        pl_module.log("throughput/images_per_s", speed, rank_zero_only=False)
        pl_module.log("throughput/loader_wait", waiting, rank_zero_only=False)
        if trainer.is_global_zero:
            hint = (
                "; data.cache=memory or disk renders each image once" if waiting > _STARVED else ""
            )
            _log.info(
                "epoch %d: %.0f images/s, %.0f %% of the time waiting for the loader%s",
                trainer.current_epoch, speed, 100 * waiting, hint,
            )  # fmt: skip
