"""The checkpoints of a run's folder: which there are, which is the newest that is whole."""

from __future__ import annotations

import logging
import shutil
import time
import zipfile
from pathlib import Path
from typing import Any, Final

import torch

from dopepp.drawing.png import PARTIAL_SUFFIX, is_abandoned
from dopepp.errors import UserError
from dopepp.models.checkpoint import Checkpoint, read

_log = logging.getLogger(__name__)

FOLDER: Final = "checkpoints"
LAST: Final = "last.ckpt"
PREVIOUS: Final = "previous.ckpt"
BEST: Final = "best.ckpt"

_NEEDED: Final = frozenset({"global_step", "loops", "optimizer_states", "callbacks"})
_NUM_FILES: Final = 4
"""Last, previous, best, and one that is being written."""
_WEIGHTS_PER_FILE: Final = 3
"""The weights and an optimiser's two moments."""


def newest_checkpoint(run_dir: Path) -> tuple[Path, Checkpoint] | None:
    """Return the newest whole checkpoint of a run; None if it has not saved any yet.

    Every damaged file is reported in a line.

    Raises:
        UserError: There are checkpoints, and none is whole.
    """
    damaged = []
    for name in (LAST, PREVIOUS, BEST):
        path = run_dir / FOLDER / name
        if not path.exists():
            continue
        try:
            checkpoint, step = _read_whole(path)
        except UserError as error:
            damaged.append(path)
            _log.warning("left out: %s", error.got)
            continue
        if damaged:
            _log.warning("going on from %s, step %d", path.name, step)
        return path, checkpoint
    if damaged:
        raise UserError(
            f"{run_dir}, whose checkpoints are all damaged ({', '.join(p.name for p in damaged)})",
            f"a run with at least one whole file among {LAST}, {PREVIOUS} and {BEST}",
            "restore one of them from a backup, or start anew without resume",
        )
    return None


def saved_step(path: Path) -> int | None:
    """Return after how many steps a checkpoint was taken; None if it cannot be told."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
        return int(content["global_step"])
    except Exception:  # a damaged file raises whatever its bytes lead to
        return None


def check_room(run_dir: Path, weight_bytes: int) -> None:
    """Check that a run can write its checkpoints, as far as that can be known in advance.

    Args:
        run_dir: The run's folder.
        weight_bytes: Size of the network's weights.

    Raises:
        UserError: The folder cannot be written, or its disk has too little space.
    """
    folder = run_dir / FOLDER
    probe = folder / ".probe"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"\0")
        probe.unlink()
        free = shutil.disk_usage(folder).free
    except OSError as error:
        raise UserError(
            f"{folder}, which cannot be written: {error.strerror or error}",
            "a folder that can be written, for checkpoints",
            "set output_dir=…, or make it writable",
        ) from error
    there = sum(path.stat().st_size for path in folder.glob("*.ckpt"))
    needed = _NUM_FILES * _WEIGHTS_PER_FILE * weight_bytes
    if free + there < needed:
        raise UserError(
            f"{free / 1e6:,.1f} MB free in {folder}",
            f"at least {(needed - there) / 1e6:,.1f} MB, for {_NUM_FILES} checkpoints",
            "free some space, or set output_dir=…",
        )


def sweep(run_dir: Path) -> None:
    """Remove the half-written files of processes that are gone."""
    for folder in (run_dir, run_dir / FOLDER):
        for path in folder.glob(f".*{PARTIAL_SUFFIX}"):
            if is_abandoned(path, time.time()):
                path.unlink(missing_ok=True)


def _read_whole(path: Path) -> tuple[Checkpoint, int]:
    """Read a checkpoint after comparing its checksums, which torch does not do.

    Raises:
        UserError: It is damaged, or holds no training to go on with.
    """
    checkpoint = read(path)
    with zipfile.ZipFile(path) as archive:
        try:
            bad = archive.testzip()
        except (zipfile.BadZipFile, OSError, ValueError) as error:
            bad = str(error)
    content: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    missing = sorted(_NEEDED - content.keys())
    if bad is not None or missing:
        raise UserError(
            f"{path}, damaged in {bad}" if bad else f"{path}, without {', '.join(missing)}",
            "a checkpoint as training wrote it",
            "take another one",
        )
    return checkpoint, int(content["global_step"])
