"""Throughput, remaining time and profiles of a training run.

To add a profiler, write a subclass of Lightning's ``Profiler`` and add a line to
:func:`make_profiler` and to :func:`profile_rows`.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable
from datetime import timedelta
from pathlib import Path
from typing import Any, Final, Literal

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import TQDMProgressBar
from lightning.pytorch.profilers import Profiler, PyTorchProfiler, SimpleProfiler
from torch.profiler import profile

from dopepp.data.batch import Batch

_log = logging.getLogger(__name__)

FOLDER: Final = "profile"  # Folder of the run with the report and traces

_STARVED: Final = 0.2  # Share of waiting above which a hint is logged
_FILE: Final = "report"

Total = tuple[str, int, float]  # name of a hook or operator, number of calls, and total seconds


class Throughput(Callback):
    """Logs images per second of training, and the share of time spent waiting for the loader.

    The values are ``throughput/images_per_s`` and ``throughput/loader_wait``.
    """

    def __init__(self) -> None:
        self._images, self._waited = 0, 0.0
        self._started = self._step_ended = 0.0

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
            _log.info(text, *values, hint if waiting > _STARVED else "")


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


class Operators(PyTorchProfiler):
    """Profiles torch operators over all recorded steps (Lightning reports the last step only)."""

    def __init__(self, folder: Path) -> None:
        super().__init__(dirpath=folder, filename=_FILE, on_trace_ready=self._collect)
        self._folder, self._num_traces = folder, 0
        self._totals: dict[str, tuple[int, float]] = {}

    def _collect(self, recorded: profile) -> None:
        """Export a recording as a Chrome trace, and add its times and calls to the totals."""
        self._folder.mkdir(parents=True, exist_ok=True)
        recorded.export_chrome_trace(str(self._folder / f"trace_{self._num_traces}.json"))
        self._num_traces += 1
        operators: Any = recorded.key_averages()
        for operator in operators:
            if operator.is_user_annotation or operator.key.startswith("[pl]"):
                continue  # Lightning's hooks
            calls, seconds = self._totals.get(operator.key, (0, 0.0))
            # For GPU operators, the time of launch and execution.
            seconds += 1e-6 * (operator.self_cpu_time_total + operator.self_device_time_total)
            self._totals[operator.key] = (calls + operator.count, seconds)

    def totals(self) -> list[Total]:
        """Return each operator's total time and number of calls, slowest first."""
        return _slowest_first((name, *total) for name, total in self._totals.items())

    def summary(self) -> str:
        """Return a report with a line per operator, slowest first: seconds, calls and name."""
        self._delete_profilers()
        return "".join(
            f"{seconds:12.6f} s {calls:8d} calls  {name}\n"
            for name, calls, seconds in self.totals()
        )


def make_profiler(kind: Literal["simple", "pytorch"] | None, run_dir: Path) -> Profiler | None:
    """Build a profiler of the loop's hooks (``simple``) or of torch operators (``pytorch``)."""
    if kind == "simple":
        return SimpleProfiler(dirpath=run_dir / FOLDER, filename=_FILE)
    return None if kind is None else Operators(run_dir / FOLDER)


def profile_rows(profiler: object, limit: int = 12) -> list[dict[str, str]]:
    """Return the slowest hooks or operators, with calls, total seconds and ms per call as text."""
    totals: list[Total] = []
    if isinstance(profiler, Operators):
        totals = profiler.totals()
    elif isinstance(profiler, SimpleProfiler):  # includes the time of nested hooks
        recorded = profiler.recorded_durations.items()
        totals = _slowest_first((name, len(seconds), sum(seconds)) for name, seconds in recorded)
    return [
        {"what": name, "calls": f"{calls:,}", "s": f"{seconds:.3f}", "ms/call": f"{ms:.2f}"}
        for name, calls, seconds in totals[:limit]
        for ms in (1000 * seconds / max(1, calls),)
    ]


def _slowest_first(totals: Iterable[Total]) -> list[Total]:
    return sorted(totals, key=lambda total: total[2], reverse=True)
