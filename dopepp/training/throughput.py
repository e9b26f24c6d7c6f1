"""Throughput, remaining time and profiles of a training run."""

from __future__ import annotations

import logging
import time
from datetime import timedelta
from pathlib import Path
from typing import Any, Final, Literal

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import TQDMProgressBar
from lightning.pytorch.profilers import Profiler, PyTorchProfiler, SimpleProfiler

from dopepp.data.batch import Batch

_log = logging.getLogger(__name__)

FOLDER: Final = "profile"  # folder of the run with the report and the trace


class Throughput(Callback):
    """Logs ``throughput/images_per_s`` and the share of time ``throughput/loader_wait``.

    ``cache`` is the option ``data.cache``: without a cache, a slow loader gets advice to use one.
    """

    def __init__(self, cache: str = "none") -> None:
        self._is_cached = cache != "none"
        self._images, self._waited = 0, 0.0
        self._started = self._step_ended = self._validation_started = 0.0

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Reset the number of images and the waiting time."""
        self._images, self._waited = 0, 0.0
        self._started = self._step_ended = time.perf_counter()

    on_train_start = on_train_epoch_start  # a resumed epoch is measured from its resumed step

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Add the time since the end of the last step to the waiting time."""
        self._waited += time.perf_counter() - self._step_ended

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Batch, *_: Any
    ) -> None:
        """Count the images of all processes."""
        self._images += len(batch) * trainer.world_size
        self._step_ended = time.perf_counter()

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Store the time at which a validation starts."""
        self._validation_started = time.perf_counter()

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Exclude the validation, which may come within an epoch, from all times."""
        validated = time.perf_counter() - self._validation_started
        self._started += validated
        self._step_ended += validated

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log images per second and the share of waiting over the epoch."""
        elapsed = max(self._step_ended - self._started, 1e-9)
        speed, waiting = self._images / elapsed, self._waited / elapsed
        pl_module.log("throughput/images_per_s", speed, rank_zero_only=False)
        pl_module.log("throughput/loader_wait", waiting, rank_zero_only=False)
        if trainer.is_global_zero:
            hint = "; data.cache=memory or disk renders each image once"
            text = "epoch %d: %.0f images/s, %.0f %% of the time waiting for the loader%s"
            values = (trainer.current_epoch, speed, 100 * waiting)
            _log.info(text, *values, hint if waiting > 0.2 and not self._is_cached else "")


class RunProgress(TQDMProgressBar):
    """Progress bar that also shows ``left``, the estimated time until the last step of the run."""

    def __init__(self) -> None:
        super().__init__(refresh_rate=5)  # drawing the bar takes longer than a small network's step
        self._start, self._first_step = 0.0, 0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Store the time and the step at which training starts."""
        super().on_train_start(trainer, pl_module)
        self._start, self._first_step = time.monotonic(), trainer.global_step

    def get_metrics(
        self, trainer: Trainer, pl_module: LightningModule
    ) -> dict[str, int | str | float | dict[str, float]]:
        """Return the values shown next to the bar, with ``left`` (h:mm:ss) after the first step."""
        metrics = super().get_metrics(trainer, pl_module)
        done = trainer.global_step - self._first_step
        if done <= 0:
            return metrics
        missing = max(0.0, trainer.estimated_stepping_batches - trainer.global_step)
        seconds = (time.monotonic() - self._start) * missing / done
        return {"left": str(timedelta(seconds=round(seconds))), **metrics}


def make_profiler(kind: Literal["simple", "pytorch"] | None, run_dir: Path) -> Profiler | None:
    """Build a profiler of the loop's hooks (``simple``) or of torch operators (``pytorch``)."""
    if kind is None:
        return None
    profiler = SimpleProfiler if kind == "simple" else PyTorchProfiler
    return profiler(dirpath=run_dir / FOLDER, filename="report")


def profile_rows(profiler: object, limit: int = 12) -> list[dict[str, str]]:
    """Return the slowest hooks or operators, with calls, total seconds and ms per call as text."""
    totals: list[tuple[str, int, float]] = []
    if isinstance(profiler, SimpleProfiler):  # includes the time of nested hooks
        for name, durations in profiler.recorded_durations.items():
            totals.append((name, len(durations), sum(durations)))
    else:
        events: Any = getattr(profiler, "function_events", None)  # of torch's operators
        for event in events.key_averages() if events else ():
            seconds = 1e-6 * (event.self_cpu_time_total + event.self_device_time_total)
            totals.append((event.key, event.count, seconds))
    slowest = sorted(totals, key=lambda total: total[2], reverse=True)[:limit]
    return [
        {
            "what": name,
            "calls": f"{calls:,}",
            "s": f"{seconds:.3f}",
            "ms/call": f"{1000 * seconds / max(1, calls):.2f}",
        }
        for name, calls, seconds in slowest
    ]
