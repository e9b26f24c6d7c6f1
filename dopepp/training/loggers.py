"""Loggers whose failures do not end a run: a CSV table and a guard around other loggers.

To add a logger, add a line to ``dopepp/experiment/assembly/build_system.py`` and a file to
``conf/logger``.
"""

from __future__ import annotations

import logging
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger
from lightning.pytorch.utilities import rank_zero_only

from dopepp.core.files import read_csv, write_csv
from dopepp.drawing.pictures import RGBImage

_log = logging.getLogger(__name__)
T = TypeVar("T")


class MetricsTable(Logger):
    """Writes logged values to a CSV file with a row per step and a column per metric.

    Unlike Lightning's ``CSVLogger``, this logger continues an existing file and replaces it
    atomically. Rows stay in memory while the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self._rows: dict[int, dict[str, Any]] = {}
        self._failing = False
        for row in read_csv(path):
            cells = {name: cell for name, cell in row.items() if cell != ""}
            self._rows[int(cells.pop("step"))] = cells

    @property
    def name(self) -> str:
        """Empty, so that Lightning puts checkpoints directly into the run folder."""
        return ""

    version = name

    def forget_after(self, step: int) -> None:
        """Drop the rows of all later steps, which a resumed run repeats."""
        self._rows = {key: row for key, row in self._rows.items() if key <= step}

    def log_hyperparams(self, params: dict[str, Any] | Namespace, *_: Any, **__: Any) -> None:
        """Do nothing, because the run folder contains the config as a file."""

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Add the metrics to the row of ``step`` in memory; :meth:`save` writes the rows."""
        self._rows.setdefault(step or 0, {}).update(metrics)

    @rank_zero_only
    def save(self) -> None:
        """Write all rows to the CSV file; warn at the first of successive failures."""
        try:
            self.write()
        except OSError as error:
            if not self._failing:
                reason = error.strerror or error
                _log.warning("cannot write %s: %s; keeping the rows in memory", self.path, reason)
            self._failing = True
        else:
            self._failing = False

    @rank_zero_only
    def write(self) -> None:
        """Write all rows to the CSV file, unless there are none; an ``OSError`` if that fails."""
        if not self._rows:
            return
        columns = sorted({name for row in self._rows.values() for name in row})
        rows = [{"step": step, **row} for step, row in sorted(self._rows.items())]
        write_csv(self.path, rows, ["step", *columns])

    def finalize(self, status: str) -> None:
        """Write all rows to the CSV file, whatever the status."""
        self.save()


class GuardedLogger(Logger):
    """Wraps the logger that ``make`` builds; its first exception disables it with a warning."""

    def __init__(self, make: Callable[[], Logger]) -> None:
        super().__init__()
        self.inner: Logger | None = None
        self._failed = False
        self.inner = self.guard(make)

    def guard(self, call: Callable[[], T]) -> T | None:
        """Return ``call()``, or None if it raises an exception or the logger is disabled."""
        if self._failed:
            return None
        try:
            return call()
        except Exception as error:  # networks, disks and services can raise any exception
            self._failed = True
            _log.warning("a logger failed and is disabled for the rest of the run: %r", error)
            return None

    def _forward(self, call: Callable[[Logger], T]) -> T | None:
        """Return ``call(inner)``; None if the logger could not be built, is disabled or fails."""
        inner = self.inner
        return None if inner is None else self.guard(lambda: call(inner))

    @property
    def name(self) -> str | None:
        """Name of the wrapped logger; None if the logger is disabled."""
        return self._forward(lambda inner: inner.name)

    @property
    def version(self) -> str | int | None:
        """Version of the wrapped logger; None if the logger is disabled."""
        return self._forward(lambda inner: inner.version)

    def log_hyperparams(self, params: dict[str, Any] | Namespace, *args: Any, **kw: Any) -> None:
        """Log the hyperparameters with the wrapped logger."""
        self._forward(lambda inner: inner.log_hyperparams(params, *args, **kw))

    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """Log the metrics with the wrapped logger."""
        self._forward(lambda inner: inner.log_metrics(metrics, step))

    def save(self) -> None:
        """Save the values of the wrapped logger."""
        self._forward(lambda inner: inner.save())

    def finalize(self, status: str) -> None:
        """Finalise the wrapped logger with the status of the run."""
        self._forward(lambda inner: inner.finalize(status))

    def log_image(self, name: str, image: RGBImage, step: int | None = None) -> None:
        """Log an RGB image with TensorBoard or Weights & Biases; other loggers ignore the image."""
        inner = self.inner
        if isinstance(inner, TensorBoardLogger):
            self.guard(lambda: inner.experiment.add_image(name, image, step, dataformats="HWC"))
        elif isinstance(inner, WandbLogger):
            self.guard(lambda: inner.log_image(name, [image], step=step))

    def log_table(self, name: str, rows: Sequence[Mapping[str, str]], text: str) -> None:
        """Log ``rows`` to W&B (columns of the first row) or ``text`` (Markdown) to TensorBoard."""
        inner = self.inner
        if isinstance(inner, TensorBoardLogger):
            self.guard(lambda: inner.experiment.add_text(name, text))
        elif isinstance(inner, WandbLogger):
            columns = list(rows[0])
            cells = [[row.get(heading, "") for heading in columns] for row in rows]
            self.guard(lambda: inner.log_table(name, columns, cells))

    def log_summary(self, figures: Mapping[str, float]) -> None:
        """Log the final metrics, in Weights & Biases as the summary of the run."""
        inner = self.inner
        if isinstance(inner, WandbLogger):
            self.guard(lambda: inner.experiment.summary.update(dict(figures)))
        else:
            self.log_metrics(dict(figures))

    def close(self, failed: bool) -> None:
        """Close the logged run as failed or successful; later values belong to another run."""
        if isinstance(self.inner, WandbLogger):
            self._failed = False  # a failed logger's run must end, too
            self.guard(lambda: _finish_wandb(failed))
        else:
            self.finalize("failed" if failed else "success")


def _finish_wandb(failed: bool) -> None:
    """End the open run of Weights & Biases; on an ``OSError``, stop its service and raise."""
    import wandb  # Weights & Biases is slow to import

    try:
        wandb.finish(exit_code=int(failed))
    except OSError:
        with suppress(OSError):
            wandb.teardown(exit_code=1)
        wandb.run = None
        raise
