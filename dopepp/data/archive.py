"""Unpack archives from anywhere into a folder that is there completely or not at all.

Tar (plain, gzip, bzip2, xz) and zip alike: all members' names, kinds and sizes are checked before
the first byte is written, the bytes are counted while they are written, and the folder gets its
name in the end. Only plain files and folders are unpacked, with permissions of their own.
``tarfile``'s ``filter="data"`` is no guard for this: it accepts links within the folder, makes
absolute paths relative, and knows no backslash or drive, no name twice, no file below a file, no
size, and no zip (``tests/security/test_hostile_files.py`` has a case for each).
"""

from __future__ import annotations

import bz2
import errno
import gzip
import io
import lzma
import shutil
import sys
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, Any, Final, cast

from dopepp.core.errors import UserError
from dopepp.core.files import partial_path

CHUNK_BYTES: Final = 1 << 20
"""Largest piece that is read at once."""

_SMALL_BYTES: Final = 10_000_000
"""However well it compresses, so little is no bomb."""

_HEADER_BYTES: Final = 4096
"""A tar file has at most so many bytes around a member: its header, a long name, the padding."""

_MAX_NAME: Final = 1000
_MAX_PART: Final = 200
"""Characters of a member's path and of each of its parts; file systems end at 255 bytes."""

_RESERVED: Final = frozenset('<>:"|?*\\')
"""Characters that mean something else, or nothing, in a path of another system."""


@dataclass(frozen=True)
class Limits:
    """What an archive may unpack to.

    Attributes:
        total_bytes: Bytes of all files together.
        ratio: Bytes unpacked per byte of the archive, where they are over ten megabytes: text
            compresses by 50 at most, pictures by far less, a bomb by a thousand.
    """

    num_members: int = 200_000
    total_bytes: int = 20_000_000_000
    ratio: float = 100.0

    def most_bytes(self, archive_bytes: int) -> int:
        """Return how many bytes the files in an archive of this size may have."""
        return min(self.total_bytes, max(_SMALL_BYTES, int(self.ratio * archive_bytes)))


def safe_extract(archive: Path | str, folder: Path | str, limits: Limits | None = None) -> Path:
    """Unpack an archive of any format into ``folder``, which must not exist, or be empty.

    Raises:
        UserError: The archive is missing, damaged, or of another format; a member's path leads out
            of the folder, or is the same as another's; a member is no plain file or folder; a limit
            is exceeded; or the folder is in use or cannot be written. Nothing is left of it then.
    """
    archive, folder, limits = Path(archive), Path(folder), limits or Limits()
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"{folder}, which is in use", "a new or empty folder", "choose another")
    if not archive.is_file():
        raise UserError(f"archive {archive}, no such file", "a tar or zip file", "check the path")
    draft = partial_path(folder.absolute())
    try:
        most = limits.most_bytes(archive.stat().st_size)
        with _open_archive(archive, most + limits.num_members * _HEADER_BYTES) as members:
            checked = _checked(archive, members, limits.num_members, most)
            shutil.rmtree(draft, ignore_errors=True)
            draft.mkdir(parents=True)
            needed, free = sum(m.size for m in checked.values()), shutil.disk_usage(draft).free
            if needed > free:
                raise OSError(errno.ENOSPC, f"{needed} bytes to unpack, {free} free")
            for path, member in checked.items():
                _unpack(archive, member, draft / path)
        if folder.exists():
            folder.rmdir()
        draft.rename(folder)
    except OSError as error:
        raise UserError(
            f"{archive}, which cannot be unpacked into {folder}: {error}",
            "an archive to read and a folder with room to write",
            "check both, and the space on the disk",
        ) from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    return folder


def _checked(
    archive: Path, members: Iterator[Member], most_members: int, most_bytes: int
) -> dict[PurePosixPath, Member]:
    """Return the members by their paths, or refuse the archive."""
    checked: dict[PurePosixPath, Member] = {}
    is_folder: dict[str, bool] = {}
    total = 0
    for member in members:
        path, name = _path(archive, member), f"{member.name[:100]!r}"
        total += member.size
        if len(checked) == most_members:
            raise _refused(archive, f"more than {most_members} members")
        if total > most_bytes:
            raise _refused(archive, f"more than {most_bytes} bytes to unpack from {archive.name}")
        # Folders may come twice; a file may not, nor have another one inside. Compared without
        # case, as some file systems do.
        for parent in (*path.parents, path) if member.is_folder else path.parents:
            if is_folder.setdefault(str(parent).casefold(), True) is False:
                raise _refused(archive, f"member {name} below or instead of a file")
        if not member.is_folder:
            if str(path).casefold() in is_folder:
                raise _refused(archive, f"two members {name}")
            is_folder[str(path).casefold()] = False
        checked[path] = member
    return checked


def _path(archive: Path, member: Member) -> PurePosixPath:
    """Return a member's path inside of the folder."""
    path, shown = PurePosixPath(member.name), f"member {member.name[:100]!r}"
    if member.kind:
        raise _refused(archive, f"{shown}, a {member.kind}")
    if path.is_absolute() or ".." in path.parts:
        raise _refused(archive, f"{shown}, which leads out of the folder")
    odd = any(c in _RESERVED or not c.isprintable() for c in member.name)
    long = len(member.name) > _MAX_NAME or any(len(part) > _MAX_PART for part in path.parts)
    if odd or long or (path == PurePosixPath() and not member.is_folder):
        raise _refused(archive, f"{shown}, no name that every system can write")
    return path


def _unpack(archive: Path, member: Member, path: Path) -> None:
    """Write one member; its content may not be longer or shorter than it claims."""
    if member.is_folder:
        path.mkdir(parents=True, exist_ok=True)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    written = 0
    # "x": a name that passes the checks twice after all overwrites nothing.
    with member.open() as source, path.open("xb") as target:
        while chunk := source.read(CHUNK_BYTES):
            written += len(chunk)
            if written > member.size:
                break
            target.write(chunk)
    if written != member.size:
        raise _refused(archive, f"member {member.name!r} of another size than it claims")


_COMPRESSED: Final[dict[bytes, Callable[..., Any]]] = {
    b"\x1f\x8b": gzip.open,
    b"BZh": bz2.open,
    b"\xfd7zXZ\0": lzma.open,
}
"""Openers of a compressed tar file by its first bytes."""


@dataclass(frozen=True)
class Member:
    """A file or folder in an archive.

    Attributes:
        kind: What else it is, such as a link; empty for a file or folder.
        size: Bytes it claims to have.
    """

    name: str
    is_folder: bool
    kind: str
    size: int
    open: Callable[[], IO[bytes]]


class Bounded(io.RawIOBase):
    """A seekable stream with a limit that refuses to be read in one huge piece.

    The tar format lets a header claim a name of any length, which :mod:`tarfile` reads at once.
    """

    def __init__(self, stream: IO[bytes], most: int = sys.maxsize) -> None:
        self._stream, self._most = stream, most

    def seekable(self) -> bool:
        """Return True."""
        return True

    def tell(self) -> int:
        """Return the stream's position."""
        return self._stream.tell()

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a position within the limit."""
        if offset > self._most:
            raise ValueError(f"more than {self._most} bytes to unpack")
        return self._stream.seek(offset, whence)

    def read(self, size: int = -1) -> bytes:
        """Return the next ``size`` bytes, a megabyte at most."""
        if not 0 <= size <= CHUNK_BYTES or self._stream.tell() + size > self._most:
            raise ValueError(f"a header of {size} bytes, or more than {self._most} bytes to unpack")
        return self._stream.read(size)


@contextmanager
def _open_archive(archive: Path, most_bytes: int) -> Iterator[Iterator[Member]]:
    """Open an archive, and turn every kind of damage into one error.

    A tar file that is longer than ``most_bytes`` when it is unpacked counts as damaged.
    """
    try:
        with archive.open("rb") as stream:
            magic = stream.read(6)
        opener = next((o for m, o in _COMPRESSED.items() if magic.startswith(m)), open)
        if magic.startswith(b"PK"):
            with zipfile.ZipFile(archive) as pack:
                yield _zip_members(pack)
        else:
            with (
                opener(archive, "rb") as stream,
                tarfile.open(fileobj=Bounded(stream, most_bytes), mode="r:") as tar,
            ):
                yield _tar_members(tar)
    except UserError:
        raise
    except Exception as error:  # every decompressor raises its own
        # gzip reports damage as an OSError without a number.
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise _refused(archive, f"damaged: {error or type(error).__name__}") from error


def _tar_members(tar: tarfile.TarFile) -> Iterator[Member]:
    for info in tar:
        kind = "" if info.isreg() or info.isdir() else "device or other special file"
        if info.issym() or info.islnk():
            kind = f"link to {info.linkname[:100]!r}"
        content = cast("Callable[[], IO[bytes]]", partial(tar.extractfile, info))
        yield Member(info.name, info.isdir(), kind, info.size, content)


def _zip_members(pack: zipfile.ZipFile) -> Iterator[Member]:
    for info in pack.infolist():
        # Unix writes the file's mode into the upper half; 0 where another system wrote the file.
        mode = info.external_attr >> 16 & 0o170000
        kind = "" if mode in (0, 0o100000, 0o040000) else "link or special file"
        kind = "encrypted file" if info.flag_bits & 1 else kind
        yield Member(info.filename, info.is_dir(), kind, info.file_size, partial(pack.open, info))


def _refused(archive: Path, reason: str) -> UserError:
    return UserError(
        f"archive {archive}: {reason}",
        "a whole tar or zip file of plain files and folders that stay inside of its own folder",
        "do not trust it; get it again from its source",
    )
