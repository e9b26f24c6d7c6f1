"""How fast training runs and what it waits for."""

from __future__ import annotations

import time
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

from dopepp.data.batch import Batch


class Throughput(Callback):
    """Logs images per second and the share of an epoch spent waiting for the loader.

    ``throughput/images_per_s`` counts training time only; ``throughput/loader_wait`` is the share
    of it between the end of one step and the arrival of the next batch.
    """

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
        pl_module.log("throughput/images_per_s", self._images / elapsed, rank_zero_only=False)
        pl_module.log("throughput/loader_wait", self._waited / elapsed, rank_zero_only=False)
