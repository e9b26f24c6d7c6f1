"""Files that are there completely or not at all, also pictures and CSV; the user's cache.

A file is written beside its place under a name of :func:`partial_path` and renamed when it is
whole. What a killed process leaves is such a partial file, which :func:`is_abandoned` recognises.
Nothing is synced: a file survives the death of its process, but not a power cut in the seconds
after.
"""

from __future__ import annotations

import csv
import errno
import hashlib
import io
import os
import re
import shutil
import socket
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import UInt8

from dopepp.core.errors import UserError

_SHIPPED: Final = Path(__file__).parents[1] / "conf"
CONF: Final = _SHIPPED if _SHIPPED.is_dir() else Path(__file__).parents[2] / "conf"
"""The files that users choose from: inside the package of a wheel, beside that of a checkout."""

PICTURES: Final = (".png", ".jpg", ".jpeg")
"""Suffixes of the pictures that :func:`write_picture` writes."""


def write_png(path: Path | str, image: UInt8[np.ndarray, "height width 3"]) -> None:
    """Write an RGB image; a ValueError, where it is not uint8 (H, W, 3), or empty."""
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise ValueError(f"an image must be uint8 (H, W, 3), got {image.dtype} {image.shape}")
    import cv2  # a tenth of a second, which a command that answers at once does not need

    encoded = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1]
    write_whole(path, encoded.tobytes())


def write_picture(path: Path, image: UInt8[np.ndarray, "height width 3"]) -> None:
    """Write an RGB image as its suffix says, one of :data:`PICTURES`."""
    import cv2

    encoded = cv2.imencode(path.suffix.lower(), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1]
    write_whole(path, encoded.tobytes())


def check_target(path: Path, suffixes: Sequence[str] = ()) -> None:
    """Check that a file can be written, and make its folder; else a :class:`UserError`."""
    if suffixes and path.suffix.lower() not in suffixes:
        got = f"{path}, which is a folder" if path.is_dir() else f"{path} to write"
        raise UserError(got, f"a file with one of the suffixes {', '.join(suffixes)}", "name it so")
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        path.parent.mkdir(parents=True, exist_ok=True)
        partial_path(path).touch()
        partial_path(path).unlink()
    except OSError as error:
        allowed = "a file that can be written"
        raise UserError(f"{path}: {error.strerror}", allowed, "choose another place") from error


def write_csv(
    path: Path | str, rows: Sequence[Mapping[str, object]], header: Sequence[str] = ()
) -> None:
    """Write a CSV under headings, by default the fullest row's; what a row lacks is empty."""
    text = io.StringIO(newline="")
    fullest: Mapping[str, object] = max(rows, key=len)
    writer = csv.DictWriter(text, header or list(fullest), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_whole(path, text.getvalue().encode())


def read_csv(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV by heading, as far as it goes; none where there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="", errors="replace") as stream:
        return list(csv.DictReader(stream))


def write_whole(path: Path | str, content: bytes) -> None:
    """Write a file beside its place and rename it, so that a crash leaves no half of one."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = partial_path(path)
    try:
        partial.write_bytes(content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def draft(path: Path) -> Iterator[Path]:
    """Yield a place for a file or folder that replaces a path, unless the block fails."""
    folder = partial_path(path)
    folder.mkdir(parents=True)
    try:
        place = folder / path.name
        yield place
        if path.is_dir():
            shutil.rmtree(path)
        place.replace(path)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


PARTIAL_SUFFIX: Final = ".partial"

_PARTIAL: Final = re.compile(r"\..+\.([0-9a-f]{8})-([0-9]+)\.partial")

_ABANDONED_S: Final = 600.0
"""Seconds after which a partial file of another machine is nobody's: no file takes that long."""


def partial_path(path: Path) -> Path:
    """Return a name beside a file that no other process uses, on whichever machine it runs."""
    return path.with_name(f".{path.name}.{_machine()}-{os.getpid()}{PARTIAL_SUFFIX}")


def is_abandoned(path: Path, now: float) -> bool:
    """Return whether a partial file's process is gone; ``now`` is by the file system's clock, s."""
    match = _PARTIAL.fullmatch(path.name)
    if match and match[1] == _machine() and not _is_running(int(match[2])):
        return True
    try:
        # A number may have passed on to another process, so age decides as well.
        return now - path.stat().st_mtime > _ABANDONED_S
    except FileNotFoundError:  # completed by its process in this moment
        return False


def _is_running(process: int) -> bool:
    """Tell whether a process of this machine exists; where that cannot be asked, that it does."""
    if os.name != "posix":  # elsewhere, signal 0 is not a question
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # somebody else's
        return True
    return True


@cache
def _machine() -> str:
    """Return eight hex digits for the set of processes among which a process id is unique."""
    # Containers may share a host's name and hosts may all be called ``localhost``, so on Linux the
    # boot and the process namespace count as well.
    facts = [socket.gethostname()]
    boot, namespace = Path("/proc/sys/kernel/random/boot_id"), Path("/proc/self/ns/pid")
    if boot.is_file() and namespace.is_symlink():
        facts += [boot.read_text(), str(namespace.readlink())]
    return hashlib.sha256(" ".join(facts).encode()).hexdigest()[:8]


def cache_folder() -> Path:
    """Return where dopepp keeps what it can make again (``XDG_CACHE_HOME``); it may be missing."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "dopepp")
