"""Torch files: written whole or not at all, read as the untrusted input they are."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, Final

import torch

from dopepp.core.errors import UserError
from dopepp.core.files import partial_path
from dopepp.models.checkpoint import pickled
from dopepp.models.checkpoint.pickled import claimed_storages

_ZIP: Final = b"PK\x03\x04"
_LEGACY: Final = b"\x80\x02"
"""What a file begins with: a zip archive, or, up to torch 1.5, a pickle of protocol 2."""

MAX_BYTES: Final = 4 * 2**30
"""The largest checkpoint that is read: over six times the full DOPE with Adam's two moments."""


def write_atomic(payload: Mapping[str, Any], path: Path, previous: Path | None = None) -> None:
    """Write a torch file so that ``path`` holds the old content or the new, never a part of it.

    Args:
        payload: What to write.
        path: The file.
        previous: Where the file that was there is kept; it is gone if None.

    Raises:
        OSError: The folder cannot be written; the old file is intact and nothing else is left.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = partial_path(path)
    try:
        with partial.open("wb") as stream:
            _serialise(payload, stream)
            stream.flush()
            os.fsync(stream.fileno())
        if previous is not None and path.is_file():
            path.replace(previous)
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    if os.name == "posix":  # the rename is durable once its folder is; Windows cannot open folders
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _serialise(payload: Mapping[str, Any], stream: IO[bytes]) -> None:
    try:
        torch.save(dict(payload), stream)
    except RuntimeError as error:
        # What ends the writing (no space, Ctrl-C) is hidden by torch's complaint about the file
        # that was not completed.
        if isinstance(error.__context__, (OSError, KeyboardInterrupt)):
            raise error.__context__ from None
        raise


def read_mapping(path: Path, what: str) -> dict[Any, Any]:
    """Load a torch file that holds a mapping; no code in it runs, tensors come to the CPU.

    What the file's pickle asks for is looked at first (:mod:`~dopepp.models.checkpoint.pickled`),
    so that loading takes no more memory than the file has bytes.

    Args:
        path: The file, also one of torch before 1.6.
        what: What it should be, for messages.

    Raises:
        UserError: The file is missing, damaged, holds something else or more than tensors and
            plain values, or unpacks to too much.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path}, which is no file", what, "correct the path")
    try:
        with path.open("rb") as file:
            begin = file.read(len(_LEGACY))
        if begin == _LEGACY:
            _check_legacy(path)
        elif _ZIP.startswith(begin):
            check_container(path, what)
            _check_pickle(path)
        else:
            raise ValueError("neither a zip archive nor a pickle")
        content = torch.load(path, map_location="cpu", weights_only=True)
    except UserError:
        raise
    except Exception as error:  # a damaged or hostile file raises whatever its bytes lead to
        reason = " ".join(str(error).split("\n")[0].split()) or type(error).__name__
        raise UserError(
            f"{path}, which torch refuses to load ({reason[:200]})",
            what,
            "get the file again; load none that you do not trust",
        ) from error
    if not isinstance(content, dict):
        raise UserError(f"{path} with a {type(content).__name__} in it", what, "pass another file")
    return content


def check_container(path: Path, what: str) -> int:
    """Return a file's unpacked size after checking that loading it cannot take more memory.

    ``torch.save`` stores without compression, so a file that promises more than it has is a bomb.

    Args:
        path: The file.
        what: What it should be, for messages.

    Raises:
        UserError: The file is missing, is not a torch file, is cut short or unpacks to too much.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path}, which is no file", what, "correct the path")
    try:
        with path.open("rb") as file:
            # Where a zip archive comes second, torch would read what comes first.
            if file.read(len(_ZIP)) != _ZIP:
                raise zipfile.BadZipFile("something else before the archive")
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise UserError(
            f"{path}, which is not a torch file or was cut short", what, "copy or write it again"
        ) from error
    size = sum(member.file_size for member in members)
    limit = min(MAX_BYTES, path.stat().st_size)
    if size > limit:
        raise UserError(
            f"{path}, which unpacks to {size} bytes",
            f"{what} of at most {limit} bytes",
            "load no file that you do not trust",
        )
    return size


def _check_pickle(path: Path) -> None:
    """Hold a zip archive of torch's to what it may contain.

    Raises:
        ValueError: It holds something else.
    """
    with zipfile.ZipFile(path) as archive:
        sizes = {member.filename.casefold(): member.file_size for member in archive.infolist()}
        if len(sizes) < len(archive.infolist()):
            raise ValueError("two members of one name")  # and torch may take the other one
        pickles = [name for name in archive.namelist() if name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise ValueError(f"{len(pickles)} members FOLDER/data.pkl")
        with archive.open(pickles[0]) as member:
            claimed = claimed_storages(member.read(pickled.MAX_BYTES + 1))
    folder = pickles[0].removesuffix("data.pkl")
    for key, size in claimed.items():
        stored = sizes.get(f"{folder}data/{key}".casefold())
        if stored != size:
            raise ValueError(f"a storage of {size} bytes, of which {stored} are in the file")


def _check_legacy(path: Path) -> None:
    """Hold a file of torch before 1.6 to what it may contain.

    Raises:
        ValueError: It holds something else, or fewer numbers than it says.
    """
    with path.open("rb") as file:
        claimed = claimed_storages(file.read(pickled.MAX_BYTES + 1), pickled.NUM_LEGACY)
    if sum(claimed.values()) > path.stat().st_size:
        raise ValueError(f"{sum(claimed.values())} bytes of numbers in {path.stat().st_size}")
