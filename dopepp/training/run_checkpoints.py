"""The checkpoints of a run's folder: whole or absent, however a run ends.

:class:`AtomicCheckpointIO` writes them, and keeps in memory what cannot be written at once;
:func:`newest_checkpoint` finds the one to go on from.
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
_NUM_FILES: Final = 4  # last, previous, best, and one that is being written
_WEIGHTS_PER_FILE: Final = 3  # the weights and an optimiser's two moments
_ADVICE: Final = {
    errno.ENOSPC: "free some space there",
    errno.EDQUOT: "free some of your share of it",
    errno.EROFS: "make it writable",
    errno.EACCES: "make it writable",
}
_PATHS: Final = ("best_model_path", "kth_best_model_path", "last_model_path")


class SavingFailedError(RunError):
    """A checkpoint of a finished run could not be written."""


class AtomicCheckpointIO(TorchCheckpointIO):
    """Lightning's checkpoint files, saved atomically and loaded without running code.

    A checkpoint that cannot be written (disk full, server away) is kept in memory and written
    before the next one, so files on disk never refer to a missing one; a newer version of the same
    file takes its place. ``prepare`` is called before each writing; if it raises ``OSError``,
    nothing is written. Outside of the run's ``folder`` nothing is removed.
    """

    def __init__(
        self, prepare: Callable[[], None] | None = None, folder: Path | None = None
    ) -> None:
        super().__init__()
        self._prepare, self._folder = prepare, folder
        self._waiting: dict[Path, tuple[dict[str, Any], Path | None]] = {}

    @property
    def waiting(self) -> list[Path]:
        """The files that could not be written so far, oldest first."""
        return list(self._waiting)

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        """Write the file, or keep it in memory; a crash leaves either the old or the new one.

        ``storage_options`` are None, or ``{"previous": PATH}`` to keep the old file there.
        """
        target = Path(os.fspath(path))
        self._waiting.pop(target, None)
        self._waiting[target] = (checkpoint, (storage_options or {}).get("previous"))
        error = self._write_waiting()
        if error is not None:
            _log.warning("%s; trying again at the next saving", _failure(self.waiting[0], error))

    def finish(self) -> None:
        """Write what is still waiting, or raise :class:`SavingFailedError`."""
        error = self._write_waiting()
        if error is not None:
            raise SavingFailedError(_failure(self.waiting[0], error)) from error

    def _write_waiting(self) -> OSError | None:
        """Write in order; stop at the first file that cannot be written and keep the rest."""
        for path, (checkpoint, previous) in list(self._waiting.items()):
            try:
                if self._prepare is not None:
                    self._prepare()
                write_atomic(checkpoint, path, previous)
            except OSError as error:
                # Training goes on to change the tensors that the newest one refers to.
                self._waiting = {
                    p: (_copy(content), old) for p, (content, old) in self._waiting.items()
                }
                return error
            del self._waiting[path]
        return None

    def remove_checkpoint(self, path: str | Path) -> None:
        """Remove a file of the run; a checkpoint names the file, so it may be anybody's."""
        target = Path(os.fspath(path))
        folder = target.parent.resolve()
        if self._folder is not None and not folder.is_relative_to(self._folder.resolve()):
            _log.warning("%s is not of this run and stays", target)
            return
        if target.is_file():
            target.unlink()

    def load_checkpoint(
        self, path: Any, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Load a file as plain data; a pickled object in it is refused, whoever asks.

        A run's folder may have been moved: its callbacks' files are looked for beside the file
        itself.
        """
        loaded: Mapping[str, Any] = super().load_checkpoint(path, map_location, weights_only=True)
        if self._folder is None:
            return dict(loaded)
        states = loaded.get("callbacks", {})
        callbacks = {name: _moved(state, self._folder / FOLDER) for name, state in states.items()}
        return {**loaded, "callbacks": callbacks}


def newest_checkpoint(run_dir: Path) -> tuple[Path, Checkpoint] | None:
    """Return the newest whole checkpoint of a run; None if it has not saved any yet.

    Raises:
        UserError: All are damaged; each damaged file is reported in a line.
    """
    damaged = []
    paths = [run_dir / FOLDER / name for name in (LAST, PREVIOUS, BEST)]
    for path in filter(Path.exists, paths):
        try:
            checkpoint, step = _read_whole(path)
        except UserError as error:
            damaged.append(path.name)
            _log.warning("left out: %s", error.got)
            continue
        if damaged:
            _log.warning("going on from %s, step %d", path.name, step)
        return path, checkpoint
    if damaged:
        got = f"{run_dir}, whose checkpoints are all damaged ({', '.join(damaged)})"
        allowed = f"a run with at least one whole file among {LAST}, {PREVIOUS} and {BEST}"
        fix = "restore one of them from a backup, or start anew without resume"
        raise UserError(got, allowed, fix)
    return None


def saved_step(path: Path) -> int | None:
    """Return after how many steps a checkpoint was taken; None if it cannot be told."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
        return int(content["global_step"])
    except Exception:  # a damaged file raises whatever its bytes lead to
        return None


def check_room(run_dir: Path, weight_bytes: int) -> None:
    """Check, as far as possible in advance, that a run can write its checkpoints.

    Raises:
        UserError: The folder cannot be written, or has no room for weights of so many bytes.
    """
    folder = run_dir / FOLDER
    probe = folder / ".probe"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"\0")
        probe.unlink()
        free = shutil.disk_usage(folder).free
    except OSError as error:
        got = f"{folder}, which cannot be written: {error.strerror or error}"
        fix = "set output_dir=…, or make it writable"
        raise UserError(got, "a folder that can be written, for checkpoints", fix) from error
    needed = _NUM_FILES * _WEIGHTS_PER_FILE * weight_bytes
    needed -= sum(path.stat().st_size for path in folder.glob("*.ckpt"))
    if free < needed:
        allowed = f"at least {needed / 1e6:,.1f} MB, for {_NUM_FILES} checkpoints"
        fix = "free some space, or set output_dir=…"
        raise UserError(f"{free / 1e6:,.1f} MB free in {folder}", allowed, fix)


def sweep(run_dir: Path) -> None:
    """Remove the half-written files of processes that are gone."""
    for folder in (run_dir, run_dir / FOLDER):
        for path in folder.glob(f".*{PARTIAL_SUFFIX}"):
            if is_abandoned(path, time.time()):
                path.unlink(missing_ok=True)


def _read_whole(path: Path) -> tuple[Checkpoint, int]:
    """Read a checkpoint after comparing its checksums, which torch does not do."""
    checkpoint = read(path)
    with zipfile.ZipFile(path) as archive:
        try:
            bad = archive.testzip()
        except (zipfile.BadZipFile, OSError, ValueError) as error:
            bad = str(error)
    content: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    missing = sorted(_NEEDED - content.keys())
    if bad is not None or missing:
        got = f"{path}, damaged in {bad}" if bad else f"{path}, without {', '.join(missing)}"
        raise UserError(got, "a checkpoint as training wrote it", "take another one")
    return checkpoint, int(content["global_step"])


def _copy(value: Any) -> Any:
    """Return a checkpoint with copies of its tensors, on the CPU."""
    if isinstance(value, Tensor):
        return value.detach().to("cpu", copy=True)
    if isinstance(value, Mapping):
        return {key: _copy(item) for key, item in value.items()}
    return [_copy(item) for item in value] if isinstance(value, list) else value


def _moved(state: Any, folder: Path) -> Any:
    """Return a callback's state, a ``ModelCheckpoint``'s with all of its files in a folder."""
    if not isinstance(state, dict) or "dirpath" not in state:
        return state

    def place(path: str) -> str:
        return str(folder / Path(path).name) if path else path

    moved = {key: place(state[key]) for key in _PATHS if key in state}
    best = {place(path): score for path, score in state.get("best_k_models", {}).items()}
    return {**state, **moved, "dirpath": str(folder), "best_k_models": best}


def _failure(path: Path, error: OSError) -> str:
    advice = _ADVICE.get(error.errno or 0, "see to it")
    return f"cannot save {path.name} in {path.parent}: {error.strerror or error}; {advice}"
