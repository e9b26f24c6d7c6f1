"""Checkpoint files of a run, each complete or absent after any end of the run.

:class:`AtomicCheckpointIO` writes the files and keeps checkpoints in memory that cannot be written;
:func:`newest_checkpoint` returns the checkpoint to resume from.
"""

from __future__ import annotations

import errno
import logging
import os
import shutil
import time
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO
from torch import Tensor

from dopepp.core.errors import RunError, UserError
from dopepp.core.files import PARTIAL_SUFFIX, is_abandoned
from dopepp.models.checkpoint import Checkpoint, read
from dopepp.models.storage import write_atomic

_log = logging.getLogger(__name__)

FOLDER: Final = "checkpoints"
LAST: Final = "last.ckpt"
PREVIOUS: Final = "previous.ckpt"
BEST: Final = "best.ckpt"

_NEEDED: Final = frozenset({"global_step", "loops", "optimizer_states", "callbacks"})
_NUM_FILES: Final = 4  # last, previous, best, and a file being written
_WEIGHTS_PER_FILE: Final = 3  # tensors per weight: its value and the optimiser's two moments
_ADVICE: Final = {
    errno.ENOSPC: "free some space there",
    errno.EDQUOT: "free some of your quota",
    errno.EROFS: "make it writable",
    errno.EACCES: "make it writable",
}
_PATHS: Final = ("best_model_path", "kth_best_model_path", "last_model_path")


class SavingFailedError(RunError):
    """A checkpoint of a finished run could not be written."""


class AtomicCheckpointIO(TorchCheckpointIO):
    """Saves Lightning's checkpoints atomically and loads them without running code.

    A checkpoint that cannot be written (disk full, server unavailable) is kept in memory until the
    next save, which writes it first, so that no file refers to a missing file. ``prepare`` is
    called before each file is written. No file outside ``folder``, the run's, is removed.
    """

    def __init__(
        self, prepare: Callable[[], None] | None = None, folder: Path | None = None
    ) -> None:
        super().__init__()
        self._prepare, self._folder = prepare, folder
        self._waiting: dict[Path, tuple[dict[str, Any], Path | None]] = {}

    @property
    def waiting(self) -> list[Path]:
        """Files that could not be written yet, oldest first."""
        return list(self._waiting)

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        """Write the file, after moving the old file to ``storage_options["previous"]``, if set.

        If that fails, keep the checkpoint in memory and warn.
        """
        target = Path(os.fspath(path))
        self._waiting.pop(target, None)
        self._waiting[target] = (checkpoint, (storage_options or {}).get("previous"))
        error = self._write_waiting()
        if error is not None:
            _log.warning("%s; retrying at the next save", _failure(self.waiting[0], error))

    def finish(self) -> None:
        """Write the waiting checkpoints, or raise a SavingFailedError."""
        error = self._write_waiting()
        if error is not None:
            raise SavingFailedError(_failure(self.waiting[0], error)) from error

    def _write_waiting(self) -> OSError | None:
        """Write the waiting files, oldest first; stop at the first error and return it."""
        for path, (checkpoint, previous) in list(self._waiting.items()):
            try:
                if self._prepare is not None:
                    self._prepare()
                write_atomic(checkpoint, path, previous)
            except OSError as error:
                # Training will change the tensors of the newest checkpoint.
                self._waiting = {
                    p: (_copy(content), old) for p, (content, old) in self._waiting.items()
                }
                return error
            del self._waiting[path]
        return None

    def remove_checkpoint(self, path: str | Path) -> None:
        """Remove a file of the run folder; keep other files, which a forged checkpoint may name."""
        target = Path(os.fspath(path))
        folder = target.parent.resolve()
        if self._folder is not None and not folder.is_relative_to(self._folder.resolve()):
            _log.warning("%s does not belong to this run and is kept", target)
            return
        if target.is_file():
            target.unlink()

    def load_checkpoint(
        self, path: Any, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Load a checkpoint without running code, and update its paths if the run was moved."""
        loaded: Mapping[str, Any] = super().load_checkpoint(path, map_location, weights_only=True)
        if self._folder is None:
            return dict(loaded)
        states, folder = loaded.get("callbacks", {}), self._folder / FOLDER
        callbacks = {name: _move_paths(state, folder) for name, state in states.items()}
        return {**loaded, "callbacks": callbacks}


def newest_checkpoint(run_dir: Path) -> tuple[Path, Checkpoint] | None:
    """Return the newest complete checkpoint of a run; None if the run has not saved any.

    Damaged files are logged; a UserError if all are damaged.
    """
    damaged = []
    paths = [run_dir / FOLDER / name for name in (LAST, PREVIOUS, BEST)]
    for path in filter(Path.exists, paths):
        try:
            checkpoint, step = _read_intact(path)
        except UserError as error:
            damaged.append(path.name)
            _log.warning("ignoring %s", error.got)
            continue
        if damaged:
            _log.warning("continuing from %s, step %d", path.name, step)
        return path, checkpoint
    if damaged:
        problem = f"{run_dir}, whose checkpoints are all damaged ({', '.join(damaged)})"
        allowed = f"a run with at least one complete file {LAST}, {PREVIOUS} or {BEST}"
        fix = "restore one of these files from a backup, or start a new run without resume"
        raise UserError(problem, allowed, fix)
    return None


def saved_step(path: Path) -> int | None:
    """Return the step of a checkpoint file; None if it cannot be read."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
        return int(content["global_step"])
    except Exception:  # a damaged file may raise any exception
        return None


def check_free_space(run_dir: Path, weight_bytes: int) -> None:
    """Check that a run can write its checkpoints, each with ``weight_bytes`` of weights."""
    folder = run_dir / FOLDER
    probe = folder / ".probe"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"\0")
        probe.unlink()
        free = shutil.disk_usage(folder).free
    except OSError as error:
        problem = f"{folder}, which cannot be written: {error.strerror or error}"
        fix = "set output_dir=FOLDER, or make the folder writable"
        raise UserError(problem, "a writable folder for checkpoints", fix) from error
    needed = _NUM_FILES * _WEIGHTS_PER_FILE * weight_bytes
    needed -= sum(path.stat().st_size for path in folder.glob("*.ckpt"))
    if free < needed:
        allowed = f"at least {needed / 1e6:,.1f} MB, for {_NUM_FILES} checkpoints"
        fix = "free space, or set output_dir=FOLDER on another disk"
        raise UserError(f"{free / 1e6:,.1f} MB free in {folder}", allowed, fix)


def sweep(run_dir: Path) -> None:
    """Remove from the run folder all unfinished files whose process has ended."""
    for folder in (run_dir, run_dir / FOLDER):
        for path in folder.glob(f".*{PARTIAL_SUFFIX}"):
            if is_abandoned(path, time.time()):
                path.unlink(missing_ok=True)


def _read_intact(path: Path) -> tuple[Checkpoint, int]:
    """Return a checkpoint and its step; verify the checksums of the file, which torch ignores."""
    checkpoint = read(path)
    with zipfile.ZipFile(path) as archive:
        try:
            bad = archive.testzip()
        except (zipfile.BadZipFile, OSError, ValueError) as error:
            bad = str(error)
    content: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    missing = sorted(_NEEDED - content.keys())
    if bad is not None or missing:
        problem = f"{path}, damaged in {bad}" if bad else f"{path}, without {', '.join(missing)}"
        raise UserError(problem, "an intact training checkpoint", "use another checkpoint")
    return checkpoint, int(content["global_step"])


def _copy(value: Any) -> Any:
    """Copy a checkpoint with its tensors to the CPU."""
    if isinstance(value, Tensor):
        return value.detach().to("cpu", copy=True)
    if isinstance(value, Mapping):
        return {key: _copy(item) for key, item in value.items()}
    return [_copy(item) for item in value] if isinstance(value, list) else value


def _move_paths(state: Any, folder: Path) -> Any:
    """Return a callback's state, with the file paths of a ``ModelCheckpoint`` set to a folder."""
    if not isinstance(state, dict) or "dirpath" not in state:
        return state

    def move(path: str) -> str:
        return str(folder / Path(path).name) if path else path

    moved = {key: move(state[key]) for key in _PATHS if key in state}
    best = {move(path): score for path, score in state.get("best_k_models", {}).items()}
    return {**state, **moved, "dirpath": str(folder), "best_k_models": best}


def _failure(path: Path, error: OSError) -> str:
    advice = _ADVICE.get(error.errno or 0, "repair it")
    return f"cannot save {path.name} in {path.parent}: {error.strerror or error}; {advice}"
