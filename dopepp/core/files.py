"""Atomic writing of files, images and CSV, and the user's cache folder.

A file is written under the name of :func:`partial_path` and then renamed. A killed process leaves
such a partial file, which :func:`is_abandoned` detects. Files are not synced: they survive the
death of their process, but not a power cut within seconds.
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
from typing import Any, Final

import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from dopepp.core.errors import UserError

_SHIPPED: Final = Path(__file__).parents[1] / "conf"
CONF: Final = _SHIPPED if _SHIPPED.is_dir() else Path(__file__).parents[2] / "conf"
"""Folder of the config files: inside the package in a wheel, next to the package in a checkout."""

IMAGES: Final = (".png", ".jpg", ".jpeg")  # suffixes for write_image


def write_png(path: Path | str, image: UInt8[np.ndarray, "height width 3"]) -> None:
    """Write an RGB image atomically as PNG, whatever the path's suffix."""
    write_file(path, encode_image(image, ".png"))


def write_image(path: Path, image: UInt8[np.ndarray, "height width 3"]) -> None:
    """Write an RGB image atomically in the format of the path's suffix, one of :data:`IMAGES`."""
    write_file(path, encode_image(image, path.suffix.lower()))


def encode_image(pixels: NDArray[Any], suffix: str = ".png") -> bytes:
    """Encode an RGB (uint8) or one-channel (uint8, uint16) image in the format of a suffix.

    Raises:
        ValueError: The image is empty, or of another type or shape.
    """
    import cv2  # takes a tenth of a second, and not every command writes images

    is_image = pixels.ndim == 2 or pixels.shape[2:] == (3,)
    if pixels.dtype.kind != "u" or pixels.size == 0 or not is_image:
        allowed = "unsigned integers of shape (H, W, 3) or (H, W)"
        raise ValueError(f"an image must be {allowed}, got {pixels.dtype} {pixels.shape}")
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(suffix, pixels)[1].tobytes())


def check_target(path: Path, suffixes: Sequence[str] = ()) -> None:
    """Check that a file can be written and has an allowed suffix (default: any); make its folder.

    Raises:
        UserError: The suffix is not allowed, or the file cannot be written.
    """
    if suffixes and path.suffix.lower() not in suffixes:
        problem = f"{path}, which is a folder" if path.is_dir() else f"{path} to write"
        allowed = f"a file with one of the suffixes {', '.join(suffixes)}"
        raise UserError(
            problem, allowed, f"pass e.g. {path.stem.strip('.') or 'file'}{suffixes[0]}"
        )
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        path.parent.mkdir(parents=True, exist_ok=True)
        partial_path(path).touch()
        partial_path(path).unlink()
    except OSError as error:
        problem, fix = f"{path}: {error.strerror}", "pass another path, or make it writable"
        raise UserError(problem, "a writable file", fix) from error


def write_csv(
    path: Path | str, rows: Sequence[Mapping[str, object]], header: Sequence[str] = ()
) -> None:
    """Write rows as CSV, missing values as empty; the default header is that of the longest row."""
    text = io.StringIO(newline="")
    longest: Mapping[str, object] = max(rows, key=len)
    writer = csv.DictWriter(text, header or list(longest), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_file(path, text.getvalue().encode())


def read_csv(path: Path) -> list[dict[str, str]]:
    """Read the rows of a CSV file, which may be truncated; a missing file has no rows."""
    if not path.is_file():
        return []
    with path.open(newline="", errors="replace") as stream:
        return list(csv.DictReader(stream))


def write_file(path: Path | str, content: bytes) -> None:
    """Write a file under a temporary name and rename it to ``path``; make its folder."""
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
    """Yield a temporary path, whose file or folder replaces ``path`` unless the block raises."""
    folder = partial_path(path)
    folder.mkdir(parents=True)
    try:
        temporary = folder / path.name
        yield temporary
        if path.is_dir():
            shutil.rmtree(path)
        temporary.replace(path)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


PARTIAL_SUFFIX: Final = ".partial"
_PARTIAL: Final = re.compile(r"\..+\.([0-9a-f]{8})-([0-9]+)\.partial")
_ABANDONED_S: Final = 600.0  # age of an abandoned partial file of another machine, seconds


def read_limited(path: Path, max_bytes: int) -> bytes:
    """Read an untrusted file, which may grow while it is read, or be endless.

    Raises:
        OSError: The file cannot be read.
        ValueError: The file is larger than ``max_bytes``.
    """
    with path.open("rb") as file:
        is_large = os.fstat(file.fileno()).st_size > max_bytes
        content = b"" if is_large else file.read(max_bytes + 1)
    if is_large or len(content) > max_bytes:
        raise ValueError(f"more than {max_bytes / 1e6:g} MB")
    return content


def partial_path(path: Path) -> Path:
    """Return a temporary path next to a file, which no other process on any machine uses."""
    return path.with_name(f".{path.name}.{_machine()}-{os.getpid()}{PARTIAL_SUFFIX}")


def is_abandoned(path: Path, now: float) -> bool:
    """Return whether a partial file's process has ended, or its age at ``now`` exceeds 600 s."""
    match = _PARTIAL.fullmatch(path.name)
    if match and match[1] == _machine() and not _is_running(int(match[2])):
        return True
    try:
        # The process id may have been reused, so the age is checked as well.
        return now - path.stat().st_mtime > _ABANDONED_S
    except FileNotFoundError:  # its process has just completed it
        return False


def _is_running(process: int) -> bool:
    """Return whether a process of this machine exists, True if unknown."""
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # another user's process
        return True
    return True


@cache
def _machine() -> str:
    """Return eight hex digits for this machine or container, the scope of unique process ids."""
    # Host names are not unique (containers, ``localhost``), so on Linux the boot and the process
    # namespace are included.
    facts = [socket.gethostname()]
    boot, namespace = Path("/proc/sys/kernel/random/boot_id"), Path("/proc/self/ns/pid")
    if boot.is_file() and namespace.is_symlink():
        facts += [boot.read_text(), str(namespace.readlink())]
    return hashlib.sha256(" ".join(facts).encode()).hexdigest()[:8]


def cache_folder() -> Path:
    """Return dopepp's cache folder (in ``XDG_CACHE_HOME``), which may not exist."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "dopepp")
