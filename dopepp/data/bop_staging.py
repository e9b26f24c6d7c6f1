"""One sealer at a time, and a hidden folder for the items that are not sealed yet."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, TypeVar

from dopepp.drawing.png import write_whole

STAGING: Final = ".items"
"""Folder of staged items; readers pass over hidden names."""

T = TypeVar("T")

_LOCK: Final = "lock"
_ATTEMPTS: Final = 100


def stage(path: Path, content: bytes) -> None:
    """Write a staged item, also if a sealer removes the empty folder in the same moment."""
    _persistently(lambda: write_whole(path, content))


def staged_items(staging: Path, suffix: str) -> list[Path]:
    """Return the staged items in order, none if a sealer removes the folder in the same moment."""
    try:
        return sorted(staging.glob(f"[0-9]*{suffix}"))
    except FileNotFoundError:
        return []


@contextmanager
def sealing(staging: Path) -> Iterator[None]:
    """Hold a folder of staged items; it goes in the end if nothing is left in it.

    A killed process holds nothing: the system releases its lock. Two that both merge and then
    remove staged items would otherwise lose what one of them had not seen.
    """
    path = staging / _LOCK
    with _locked(path):
        yield
        if not any(entry.name != _LOCK for entry in staging.iterdir()):
            path.unlink()
            try:
                staging.rmdir()
            except OSError:  # another process has staged an item in this moment
                return


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    while True:
        descriptor = _persistently(lambda: _open(path))
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            # Whoever held it before may have removed the file: then the next one makes another.
            if _is_same(descriptor, path):
                yield
                return
        finally:
            os.close(descriptor)


def _open(path: Path) -> int:
    path.parent.mkdir(parents=True, exist_ok=True)
    return os.open(path, os.O_RDWR | os.O_CREAT)


def _persistently(act: Callable[[], T]) -> T:
    """Return what ``act`` does in a folder that it makes and a sealer may remove at any moment.

    Removed before it is used, the folder is not found; removed between ``mkdir`` and its look at
    what is in the way, it "exists". What stays in the way is raised in the end.
    """
    for _ in range(_ATTEMPTS - 1):
        try:
            return act()
        except (FileNotFoundError, FileExistsError):
            continue
    return act()


def _is_same(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
