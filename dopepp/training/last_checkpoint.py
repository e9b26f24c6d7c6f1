"""The last checkpoint of a run, from which the run can be resumed exactly.

A resumed run ends with the weights, best checkpoint and metrics of an uninterrupted run, if its
arithmetic is deterministic (as on CPUs). See ``docs/explanation/reliability.md``. Ctrl-C and
SIGTERM take effect between two steps.

Lightning's ``ModelCheckpoint`` keeps the best checkpoint only. It saves inside a batch or a
validation, or at the end of an epoch, where Lightning's counters cause replayed or skipped batches.
This module sets the counters of every checkpoint to a moment between two batches, before a
validation or between two epochs.
"""

from __future__ import annotations

import logging
import os
import random
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, Final

import numpy as np
import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint, ModelCheckpoint

from dopepp.core.errors import Interruption
from dopepp.core.validation import Range, check
from dopepp.data.batch import Batch
from dopepp.data.datamodule import PoseLoader
from dopepp.training import run_checkpoints as files

_log = logging.getLogger(__name__)

_ANSWERS: Final = {
    int(signal.SIGINT): b"\nsaving after this step; Ctrl-C again ends at once\n",
    int(signal.SIGTERM): b"\nasked to stop: saving after this step\n",
}

Cut = Callable[[dict[str, Any]], None]
"""Sets the counters in the fit loop's state to a moment from which a run can be resumed."""


class LastCheckpoint(Checkpoint):
    """Saves ``last.ckpt``, also during an epoch; the old file becomes ``previous.ckpt``.

    Files are saved between two batches or before a validation: every ``every_s`` seconds, after a
    new best checkpoint, at the end of training, and when a signal requests a stop. Periodic saving
    takes at most ``max_share`` of the time.
    """

    def __init__(self, every_s: float = 60.0, max_share: float = 0.01) -> None:
        self.every_s = check("every_s", every_s, float, Range(0, 1e9, "seconds"))
        self.max_share = check("max_share", max_share, float, Range(1e-9, 1))
        self._stop = StopRequest()
        self._cut: Cut | None = None
        self._random: dict[str, Any] | None = None
        self._saved_at = self._duration_s = 0.0
        self._saved: tuple[int, float | None] = (0, None)

    def state_dict(self) -> dict[str, Any]:
        """Return the states of the random generators; in a validation, the states at its start."""
        return {"random": self._random or _capture()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Store the random states, which :meth:`on_train_start` restores."""
        self._random = state_dict["random"]

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Set the counters of a checkpoint to a moment from which the run can be resumed."""
        fit_loop = checkpoint["loops"]["fit_loop"]
        epochs = fit_loop["epoch_progress"]["total"]
        if self._cut is not None:
            self._cut(fit_loop)
        elif epochs["processed"] == epochs["ready"]:  # the best checkpoint, saved after an epoch
            _between_epochs(fit_loop)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Restore random states, catch signals and remove partial files of an interrupted run."""
        if self._random is not None:
            _restore(self._random)
            self._random = None
        _restore_position(trainer)
        if trainer.is_global_zero:
            run_dir, resumed = Path(trainer.default_root_dir), trainer.ckpt_path
            files.sweep(run_dir)
            # A damaged file must not replace the complete file from which the run resumes.
            last = run_dir / files.FOLDER / files.LAST
            if resumed is not None and Path(resumed).name != files.LAST and last.exists():
                last.replace(last.with_name(f"{files.LAST}.damaged"))
        _forget_later_best(trainer)
        self._saved, self._saved_at = _progress(trainer), time.monotonic()
        self._stop = StopRequest()
        self._stop.listen()

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Batch, batch_idx: int
    ) -> None:
        """Save periodically, after a new best score or on a signal; resume with this batch."""
        # Checkpoints have no accumulated gradients.
        if batch_idx % trainer.accumulate_grad_batches == 0:
            self._save_if_due(trainer, _before_batch)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Store the random states with which a repeated validation must start."""
        self._random = _capture()

    def on_validation_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Batch, batch_idx: int, *_: Any
    ) -> None:
        """Save like :meth:`on_train_batch_start`; a resumed run repeats the whole validation."""
        loader = trainer.val_dataloaders
        # Processes decide together, but some have a batch more than others.
        if not isinstance(loader, PoseLoader) or batch_idx < loader.num_common_batches:
            self._save_if_due(trainer, _before_validation)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Discard the random states of the start of the validation."""
        self._random = None

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save the last checkpoint, and write those that could not be written before."""
        self._stop.end()
        self._save(trainer, _between_epochs)
        if trainer.is_global_zero:
            writer = trainer.strategy.checkpoint_io
            assert isinstance(writer, files.AtomicCheckpointIO)
            writer.finish()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Restore the signal handlers of the process."""
        self._stop.end()

    def _save_if_due(self, trainer: Trainer, cut: Cut) -> None:
        """Save periodically, after a new best score or on a stop signal, which ends the run."""
        stop = self._stop.number
        wait_s = max(self.every_s, self._duration_s / self.max_share)
        progress = _progress(trainer)
        is_late = time.monotonic() - self._saved_at >= wait_s
        is_due = trainer.is_global_zero and (is_late or progress[1] != self._saved[1])
        # Rank 0 decides when to save, but any process may receive a signal.
        agree = trainer.strategy.reduce_boolean_decision
        if not agree(is_due or stop is not None, all=False):
            return
        if progress != self._saved:
            self._save(trainer, cut)
        if agree(stop is not None, all=False):
            raise Interruption(stop or signal.SIGTERM)

    def _save(self, trainer: Trainer, cut: Cut) -> None:
        """Save the checkpoint with the counters of ``cut``, and measure the duration of saving."""
        folder = Path(trainer.default_root_dir) / files.FOLDER
        self._cut, start = cut, time.monotonic()
        options = {"previous": folder / files.PREVIOUS}
        try:
            trainer.save_checkpoint(folder / files.LAST, storage_options=options)
        finally:
            self._cut = None
        self._saved_at = time.monotonic()
        self._duration_s = self._saved_at - start
        self._saved = _progress(trainer)


class StopRequest:
    """Catches signals that stop a run, so that the run can save first.

    ``number`` is the caught signal, SIGTERM for SIGUSR1. A second Ctrl-C ends the run at once.
    SIGTERM may be repeated, as schedulers do. Under SLURM, SIGUSR1 (``--signal=USR1@90``) acts like
    SIGTERM.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self._process = os.getpid()
        self._previous: dict[int, Any] = {}

    def listen(self) -> None:
        """Install the signal handlers, in the main thread only."""
        if threading.current_thread() is not threading.main_thread():
            return
        requeued = [signal.SIGUSR1] if "SLURM_JOB_ID" in os.environ else []
        for number in (signal.SIGINT, signal.SIGTERM, *requeued):
            self._previous[number] = signal.signal(number, self._handle)

    def end(self) -> None:
        """Restore the previous signal handlers."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous = {}

    def _handle(self, number: int, _: FrameType | None) -> None:
        if os.getpid() != self._process:  # a forked worker of the data loader
            return
        if number == signal.SIGINT and self.number is not None:
            raise Interruption(number)
        is_first = self.number is None
        self.number = signal.SIGINT if number == signal.SIGINT else signal.SIGTERM
        if is_first:
            # Not through a stream or logger, which the signal may have interrupted.
            os.write(2, _ANSWERS[self.number])


def _restore_position(trainer: Trainer) -> None:
    """Set Lightning's loop and the training loader to the next batch of a resumed epoch."""
    epoch_loop, epochs = trainer.fit_loop.epoch_loop, trainer.fit_loop.epoch_progress.total
    batches = epoch_loop.batch_progress
    num_done = 0 if batches.is_last_batch else batches.current.ready
    if epochs.ready == epochs.completed or batches.current.ready == 0:
        epoch_loop.restarting = False  # no batch of this epoch is processed
        num_done = 0
    # Lightning omits this step if the schedule has requested the number of steps.
    loader = trainer.train_dataloader
    if isinstance(loader, PoseLoader):
        loader.load_state_dict({"num_batches": num_done})


def _progress(trainer: Trainer) -> tuple[int, float | None]:
    """Return step and best score; without a change of either, no checkpoint is saved."""
    score = getattr(_best(trainer), "best_model_score", None)
    return trainer.global_step, None if score is None else float(score)


def _best(trainer: Trainer) -> ModelCheckpoint | None:
    """Return the callback that keeps the best checkpoint, or None."""
    kept = (item for item in trainer.checkpoint_callbacks if isinstance(item, ModelCheckpoint))
    return next((item for item in kept if item.monitor is not None), None)


def _forget_later_best(trainer: Trainer) -> None:
    """Reset the best checkpoint if its file is newer than the resumed step.

    Without deterministic arithmetic, the resumed run would not reproduce this checkpoint.
    """
    best = _best(trainer)
    if best is None or not best.best_model_path:
        return
    step = files.saved_step(Path(best.best_model_path))
    if step is None or step > trainer.global_step:
        _log.info(
            "%s is newer than step %d: selecting the best checkpoint again",
            best.best_model_path,
            trainer.global_step,
        )
        best.best_k_models, best.best_model_score = {}, None
        best.kth_value = ModelCheckpoint(monitor=best.monitor, mode=best.mode).kth_value
        best.best_model_path = best.kth_best_model_path = ""


def _before_batch(fit_loop: dict[str, Any]) -> None:
    """Undo the count of the batch that was loaded but not trained on."""
    batches = fit_loop["epoch_loop.batch_progress"]
    for counter in (batches["total"], batches["current"]):
        counter["ready"] -= 1
    batches["is_last_batch"] = False


def _before_validation(fit_loop: dict[str, Any]) -> None:
    """Reset the validation: all batches of the epoch are trained, none is validated."""
    validation = fit_loop["epoch_loop.val_loop.batch_progress"]
    # Lightning recognises an interrupted validation by a started batch and no processed batch.
    validation["total"].update(ready=1, started=1, processed=0, completed=0)
    validation["current"].update(ready=0, started=0, processed=0, completed=0)
    validation["is_last_batch"] = False


def _between_epochs(fit_loop: dict[str, Any]) -> None:
    """Mark the epoch as completed, so that the next epoch starts with its first batch."""
    for counter in fit_loop["epoch_progress"].values():
        counter["completed"] = counter["processed"]


def _capture() -> dict[str, Any]:
    """Return the states of the generators of Python, NumPy and torch as tensors and numbers."""
    version, numbers, gauss = random.getstate()
    _, keys, position, has_gauss, cached = np.random.get_state(legacy=True)  # noqa: NPY002
    return {
        "python": [version, list(numbers), gauss],
        "numpy": [torch.tensor(np.asarray(keys, np.int64)), int(position), int(has_gauss)],
        "numpy_gauss": float(cached),
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
    }


def _restore(state: dict[str, Any]) -> None:
    """Restore captured random states; GPU states only if the number of GPUs is unchanged."""
    version, numbers, gauss = state["python"]
    random.setstate((version, tuple(numbers), gauss))
    keys, position, has_gauss = state["numpy"]
    generator = ("MT19937", keys.numpy().astype(np.uint32), position, has_gauss)
    np.random.set_state((*generator, state["numpy_gauss"]))  # noqa: NPY002
    torch.set_rng_state(state["torch"].cpu())
    if torch.cuda.is_available() and len(state["cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all([generator.cpu() for generator in state["cuda"]])
