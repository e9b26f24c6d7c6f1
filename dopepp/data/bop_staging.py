"""One sealer at a time, and a hidden folder for the items that are not sealed yet."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from dopepp.drawing.png import write_whole

STAGING: Final = ".items"
"""Folder of staged items; readers pass over hidden names."""

_LOCK: Final = "lock"
_ATTEMPTS: Final = 100


def stage(path: Path, content: bytes) -> None:
    """Write a staged item, also if a sealer removes the empty folder in the same moment."""
    for _ in range(_ATTEMPTS - 1):
        try:
            write_whole(path, content)
        except FileNotFoundError:
            continue
        return
    write_whole(path, content)


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
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT)
        except FileNotFoundError:  # the folder went after it was made
            continue
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            # Whoever held it before may have removed the file: then the next one makes another.
            if _is_same(descriptor, path):
                yield
                return
        finally:
            os.close(descriptor)


def _is_same(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
