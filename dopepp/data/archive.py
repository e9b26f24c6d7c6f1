"""Unpack an untrusted tar file, completely or not at all.

The names, types and sizes of all members are checked before the first byte is written. The folder
is renamed to its final name last. Only plain files and folders are unpacked, with default
permissions.
``tarfile``'s ``filter="data"`` is not enough: it accepts links within the folder, makes absolute
paths relative, and ignores backslashes, drives, repeated names, files below files and sizes
(``tests/security/test_hostile_files.py`` has a case for each).
"""

from __future__ import annotations

import errno
import io
import shutil
import tarfile
from pathlib import Path, PurePosixPath
from typing import IO, Final

from dopepp.core.errors import UserError
from dopepp.core.files import partial_path

CHUNK_BYTES: Final = 1 << 20
"""Largest number of bytes to read at once."""

MAX_MEMBERS: Final = 200_000

_MAX_NAME: Final = 1000
_MAX_PART: Final = 200
"""Characters of a member's path and of each part; file systems allow 255 bytes."""

_RESERVED: Final = frozenset('<>:"|?*\\')
"""Characters that are special or forbidden in paths of some systems."""


class BoundedStream(io.RawIOBase):
    """A seekable stream that rejects reads of more than ``CHUNK_BYTES``.

    A tar header can claim a name of any length, and :mod:`tarfile` would read it at once.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream

    def seekable(self) -> bool:
        """Return True."""
        return True

    def tell(self) -> int:
        """Return the stream's position."""
        return self._stream.tell()

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Set and return the stream's position."""
        return self._stream.seek(offset, whence)

    def read(self, size: int = -1) -> bytes:
        """Return the next ``size`` bytes, or fewer at the end of the stream.

        Raises:
            ValueError: The size is negative (read everything) or above ``CHUNK_BYTES``.
        """
        if not 0 <= size <= CHUNK_BYTES:
            raise ValueError(f"a header of {size} bytes")
        return self._stream.read(size)


def safe_extract(archive: Path | str, folder: Path | str) -> Path:
    """Unpack a tar file into ``folder``, which must be new or empty, completely or not at all.

    Raises:
        UserError: The archive is missing, damaged, or of another format; a member's path leads out
            of the folder or repeats another path; a member is neither a plain file nor a folder;
            the archive has more than ``MAX_MEMBERS``; or the folder is not empty or not writable.
    """
    archive, folder = Path(archive), Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        fix = "pass the path of a new folder"
        raise UserError(
            f"{folder}, which is not empty or not a folder", "a new or empty folder", fix
        )
    if not archive.is_file():
        fix = "pass the path of an existing file"
        raise UserError(f"archive {archive}, no such file", "a tar file", fix)
    draft = partial_path(folder.absolute())
    try:
        with (
            archive.open("rb") as file,
            tarfile.open(fileobj=BoundedStream(file), mode="r:") as tar,
        ):
            members = _check_members(archive, tar)
            shutil.rmtree(draft, ignore_errors=True)
            draft.mkdir(parents=True)
            needed, free = sum(m.size for m in members.values()), shutil.disk_usage(draft).free
            if needed > free:
                raise OSError(errno.ENOSPC, f"{needed} bytes to unpack, {free} free")
            for path, member in members.items():
                _unpack(tar, member, draft / path)
        if folder.exists():
            folder.rmdir()
        draft.rename(folder)
    except UserError:
        raise
    except OSError as error:
        problem = f"{archive}, which cannot be unpacked into {folder}: {error}"
        allowed = "a readable archive and a writable folder with enough space"
        fix = "check the permissions of archive and folder, and free space on the disk"
        raise UserError(problem, allowed, fix) from error
    except Exception as error:  # a damaged header makes tarfile raise any type
        raise _rejection(archive, f"damaged: {error or type(error).__name__}") from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    return folder


def _check_members(archive: Path, tar: tarfile.TarFile) -> dict[PurePosixPath, tarfile.TarInfo]:
    """Return the members by their paths in the folder; raise a UserError for an unsafe member."""
    members: dict[PurePosixPath, tarfile.TarInfo] = {}
    is_folder: dict[str, bool] = {}
    for number, member in enumerate(tar):
        path, quoted = PurePosixPath(member.name), f"member {member.name[:100]!r}"
        if number == MAX_MEMBERS:
            raise _rejection(archive, f"more than {MAX_MEMBERS} members")
        if problem := _problem(member, path):
            raise _rejection(archive, f"{quoted}{problem}")
        # A folder may be repeated. A file may neither be repeated nor contain a file. The case of
        # letters is ignored, because some file systems ignore it.
        for parent in (*path.parents, path) if member.isdir() else path.parents:
            if is_folder.setdefault(str(parent).casefold(), True) is False:
                raise _rejection(archive, f"{quoted}, whose path or parent is also a file")
        if not member.isdir():
            if str(path).casefold() in is_folder:
                raise _rejection(archive, f"more than one {quoted}")
            is_folder[str(path).casefold()] = False
        members[path] = member
    return members


def _problem(member: tarfile.TarInfo, path: PurePosixPath) -> str:
    """Return why a member is rejected, or an empty string."""
    if member.issym() or member.islnk():
        return f", a link to {member.linkname[:100]!r}"
    if not (member.isreg() or member.isdir()) or member.issparse():
        return ", a device or other special file"
    if path.is_absolute() or ".." in path.parts:
        return ", which leads out of the folder"
    odd = any(c in _RESERVED or not c.isprintable() for c in member.name)
    long = len(member.name) > _MAX_NAME or any(len(part) > _MAX_PART for part in path.parts)
    if odd or long or (path == PurePosixPath() and not member.isdir()):
        return ", a name that some systems cannot write"
    return ""


def _unpack(tar: tarfile.TarFile, member: tarfile.TarInfo, path: Path) -> None:
    if member.isdir():
        path.mkdir(parents=True, exist_ok=True)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    source = tar.extractfile(member)
    assert source is not None  # _problem rejects members other than files and folders
    # Mode "x" overwrites nothing, even if a repeated name passes the checks.
    with source, path.open("xb") as target:
        shutil.copyfileobj(source, target, CHUNK_BYTES)
    if path.stat().st_size != member.size:
        raise tarfile.ReadError(f"member {member.name!r} is shorter than stated in its header")


def _rejection(archive: Path, reason: str) -> UserError:
    allowed = "a complete tar file of plain files and folders that stay inside its own folder"
    fix = "do not trust the file; download it again from its source"
    return UserError(f"archive {archive}: {reason}", allowed, fix)
