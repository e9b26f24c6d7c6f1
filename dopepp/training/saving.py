"""Checkpoints that are whole or absent, and what becomes of one that could not be written."""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO
from torch import Tensor

from dopepp.errors import RunError
from dopepp.models.storage import write_atomic
from dopepp.training.checkpoints import FOLDER

_log = logging.getLogger(__name__)

_ADVICE: Final = {
    errno.ENOSPC: "free some space there",
    errno.EDQUOT: "free some of your share of it",
    errno.EROFS: "make it writable",
    errno.EACCES: "make it writable",
}


_PATHS: Final = ("best_model_path", "kth_best_model_path", "last_model_path")


class SavingFailedError(RunError):
    """What a run must leave could not be written, said in one line."""


class AtomicCheckpointIO(TorchCheckpointIO):
    """Lightning's checkpoint files, saved atomically and loaded without running code.

    A checkpoint that cannot be written (disk full, server away) is kept in memory and written
    before the next one, so files on disk never refer to one that is not there; a newer version of
    the same file takes its place. Training goes on meanwhile; :meth:`finish` fails if something is
    still not written.

    Args:
        prepare: Called before each writing; if it raises ``OSError``, nothing is written.
        folder: The run's folder, outside of which nothing is removed; None for no limit.
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
        """Write the file so that a crash leaves either the old or the new one.

        Args:
            checkpoint: What to write.
            path: The file.
            storage_options: None, or ``{"previous": PATH}`` to keep the old file there.
        """
        target = Path(os.fspath(path))
        self._waiting.pop(target, None)
        self._waiting[target] = (checkpoint, (storage_options or {}).get("previous"))
        error = self._write_waiting()
        if error is not None:
            _log.warning("%s; trying again at the next saving", _failure(self.waiting[0], error))

    def finish(self) -> None:
        """Write what is still waiting.

        Raises:
            SavingFailedError: It still cannot be written.
        """
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
                    name: (_copy(one), old) for name, (one, old) in self._waiting.items()
                }
                return error
            del self._waiting[path]
        return None

    def remove_checkpoint(self, path: str | Path) -> None:
        """Remove a file of the run.

        Which one is named by the state of a callback, so by a checkpoint: it may be anybody's.
        """
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

        A run's folder may have been moved since: what its callbacks call their files is looked for
        beside the file itself.
        """
        loaded: Mapping[str, Any] = super().load_checkpoint(
            path, map_location=map_location, weights_only=True
        )
        if self._folder is None:
            return dict(loaded)
        folder = self._folder / FOLDER
        callbacks = {
            name: _moved(state, folder) if isinstance(state, dict) and "dirpath" in state else state
            for name, state in loaded.get("callbacks", {}).items()
        }
        return {**loaded, "callbacks": callbacks}


def _copy(value: Any) -> Any:
    """Return a checkpoint whose tensors are its own, on the CPU."""
    if isinstance(value, Tensor):
        return value.detach().to("cpu", copy=True)
    if isinstance(value, Mapping):
        return {key: _copy(item) for key, item in value.items()}
    return [_copy(item) for item in value] if isinstance(value, list) else value


def _moved(state: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return a ``ModelCheckpoint``'s state with all of its files in a folder."""

    def place(path: str) -> str:
        return str(folder / Path(path).name) if path else path

    moved = {key: place(state[key]) for key in _PATHS if key in state}
    best = {place(path): score for path, score in state.get("best_k_models", {}).items()}
    return {**state, **moved, "dirpath": str(folder), "best_k_models": best}


def _failure(path: Path, error: OSError) -> str:
    advice = _ADVICE.get(error.errno or 0, "see to it")
    return f"cannot save {path.name} in {path.parent}: {error.strerror or error}; {advice}"
