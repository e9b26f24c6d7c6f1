"""Unpack archives from anywhere into a folder that is there completely or not at all.

Tar (plain, gzip, bzip2, xz) and zip alike: all members' names, kinds and sizes are checked before
the first byte is written, the bytes are counted while they are written, and the folder appears
under its name when it is complete. Only plain files and folders are unpacked, with permissions of
their own. ``tarfile``'s ``filter="data"`` is no guard for this: it takes links within the folder,
makes absolute paths relative, knows no backslash or drive, no name twice and no file below a file,
no size, and no zip (``tests/security/test_hostile_files.py`` has each as a case of ``ARCHIVES``).

To add a format, write a function that yields an archive's members, as ``_tar_members`` does.
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
from pathlib import Path, PurePosixPath
from typing import IO, Any, Final

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
    """Unpack an archive into a new folder.

    The content of ``archive`` tells its format; ``folder`` must not exist, or be empty.

    Raises:
        UserError: The archive is missing, damaged, or of another format; a member's path leads out
            of the folder, or is the same as another's; a member is no plain file or folder; a limit
            is exceeded; or the folder is in use or cannot be written. Nothing is left of it then.
    """
    archive, folder = Path(archive), Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"{folder}, which is in use", "a new or empty folder", "choose another")
    if not archive.is_file():
        raise UserError(f"archive {archive}, no such file", "a tar or zip file", "check the path")
    partial = partial_path(folder.absolute())
    limits = limits or Limits()
    try:
        longest = limits.most_bytes(archive.stat().st_size) + limits.num_members * _HEADER_BYTES
        with archive_members(archive, longest) as members:
            checked = _checked(archive, members, limits)
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir(parents=True)
            needed, free = sum(m.size for _, m in checked), shutil.disk_usage(partial).free
            if needed > free:
                raise OSError(errno.ENOSPC, f"{needed} bytes to unpack, {free} free")
            for path, member in checked:
                _unpack(archive, member, partial / path)
        if folder.exists():
            folder.rmdir()
        partial.rename(folder)
    except OSError as error:
        raise UserError(
            f"{archive}, which cannot be unpacked into {folder}: {error}",
            "an archive to read and a folder with room to write",
            "check both, and the space on the disk",
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return folder


def _checked(
    archive: Path, members: Iterator[Member], limits: Limits
) -> list[tuple[PurePosixPath, Member]]:
    """Return the members with the paths they get, or refuse the archive."""
    most = limits.most_bytes(archive.stat().st_size)
    checked: list[tuple[PurePosixPath, Member]] = []
    kinds: dict[str, bool] = {}
    total = 0
    for member in members:
        path = _path(archive, member)
        total += member.size
        if len(checked) == limits.num_members:
            raise refused(archive, f"more than {limits.num_members} members")
        if total > most:
            raise refused(archive, f"more than {most} bytes to unpack from {archive.name}")
        # Folders come and go twice; a file may not, nor have another one inside. Compared without
        # case, as some file systems do.
        for parent in (*path.parents, path) if member.is_folder else path.parents:
            if kinds.setdefault(str(parent).casefold(), True) is False:
                raise refused(archive, f"member {member.name[:100]!r} below or instead of a file")
        if not member.is_folder:
            if str(path).casefold() in kinds:
                raise refused(archive, f"two members {member.name[:100]!r}")
            kinds[str(path).casefold()] = False
        checked.append((path, member))
    return checked


def _path(archive: Path, member: Member) -> PurePosixPath:
    """Return a member's path inside of the folder."""
    name = member.name
    path = PurePosixPath(name)
    if member.kind:
        raise refused(archive, f"member {name[:100]!r}, a {member.kind}")
    if path.is_absolute() or ".." in path.parts:
        raise refused(archive, f"member {name[:100]!r}, which leads out of the folder")
    odd = [c for c in name if c in _RESERVED or not c.isprintable()]
    long = len(name) > _MAX_NAME or any(len(part) > _MAX_PART for part in path.parts)
    if odd or long or (path == PurePosixPath() and not member.is_folder):
        raise refused(archive, f"member {name[:100]!r}, no name that every system can write")
    return path


def _unpack(archive: Path, member: Member, path: Path) -> None:
    """Write one member; its content may not be longer or shorter than it claims."""
    if member.is_folder:
        path.mkdir(parents=True, exist_ok=True)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    written = 0
    # "x": where a name passed the checks twice after all, nothing is overwritten.
    with member.open() as source, path.open("xb") as target:
        while chunk := source.read(CHUNK_BYTES):
            written += len(chunk)
            if written > member.size:
                break
            target.write(chunk)
    if written != member.size:
        raise refused(archive, f"member {member.name!r} of another size than it claims")


_COMPRESSED: Final[dict[bytes, Callable[..., Any]]] = {
    b"\x1f\x8b": gzip.open,
    b"BZh": bz2.open,
    b"\xfd7zXZ\0": lzma.open,
}
"""What opens a tar file that begins with these bytes."""


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
    """A seekable stream that ends where its limit is, and refuses to be read in one huge piece.

    The tar format lets a header claim a name of any length, which :mod:`tarfile` reads at once.
    """

    def __init__(self, stream: IO[bytes], most: int = sys.maxsize) -> None:
        self._stream, self._most = stream, most

    def seekable(self) -> bool:
        """Say yes."""
        return True

    def tell(self) -> int:
        """Return where the stream is."""
        return self._stream.tell()

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place within the limit."""
        if offset > self._most:
            raise ValueError(f"more than {self._most} bytes to unpack")
        return self._stream.seek(offset, whence)

    def read(self, size: int = -1) -> bytes:
        """Return the next ``size`` bytes, a megabyte at most."""
        if not 0 <= size <= CHUNK_BYTES or self._stream.tell() + size > self._most:
            raise ValueError(f"a header of {size} bytes, or more than {self._most} bytes to unpack")
        return self._stream.read(size)


@contextmanager
def archive_members(archive: Path, most_bytes: int) -> Iterator[Iterator[Member]]:
    """Open an archive, and turn every way in which it can be damaged into one error.

    A tar file that is longer than ``most_bytes`` when it is unpacked counts as damaged.
    """
    try:
        with archive.open("rb") as stream:
            magic = stream.read(6)
        opener = next((o for m, o in _COMPRESSED.items() if magic.startswith(m)), None)
        if magic.startswith(b"PK"):
            with zipfile.ZipFile(archive) as pack:
                yield _zip_members(pack)
        else:
            with (
                (opener or open)(archive, "rb") as stream,
                tarfile.open(fileobj=Bounded(stream, most_bytes), mode="r:") as tar,
            ):
                yield _tar_members(tar)
    except UserError:
        raise
    except OSError as error:
        if error.errno is not None:
            raise
        # gzip reports damage as an OSError without a number.
        raise refused(archive, f"damaged: {error}") from error
    except Exception as error:  # every decompressor raises its own
        raise refused(archive, f"damaged: {error or type(error).__name__}") from error


def _tar_members(tar: tarfile.TarFile) -> Iterator[Member]:
    for info in tar:

        def content(info: tarfile.TarInfo = info) -> IO[bytes]:
            stream = tar.extractfile(info)
            assert stream is not None  # only plain files are opened
            return stream

        kind = "" if info.isreg() or info.isdir() else "device or other special file"
        if info.issym() or info.islnk():
            kind = f"link to {info.linkname[:100]!r}"
        yield Member(info.name, info.isdir(), kind, info.size, content)


def _zip_members(pack: zipfile.ZipFile) -> Iterator[Member]:
    for info in pack.infolist():
        # Unix writes the file's mode into the upper half; 0 where another system wrote the file.
        mode = info.external_attr >> 16 & 0o170000
        kind = "" if mode in (0, 0o100000, 0o040000) else "link or special file"
        kind = "encrypted file" if info.flag_bits & 1 else kind

        def content(info: zipfile.ZipInfo = info) -> IO[bytes]:
            return pack.open(info)

        yield Member(info.filename, info.is_dir(), kind, info.file_size, content)


def refused(archive: Path, reason: str) -> UserError:
    """Make the error for an archive that must not be unpacked."""
    return UserError(
        f"archive {archive}: {reason}",
        "a whole tar or zip file of plain files and folders that stay inside of its own folder",
        "do not trust it; get it again from its source",
    )
