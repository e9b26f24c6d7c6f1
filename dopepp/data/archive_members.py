"""Members of a tar (plain, gzip, bzip2, xz) or zip archive, read without trust in either format.

To add a format, write a function that yields an archive's members, as ``_tar_members`` does.
"""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final

from dopepp.errors import UserError

CHUNK_BYTES: Final = 1 << 20
"""Largest piece that is read at once."""

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
        name: Its path as written.
        is_folder: Whether it is a folder.
        kind: What else it is, such as a link; empty for a file or folder.
        size: Bytes it claims to have.
        open: Returns its content.
    """

    name: str
    is_folder: bool
    kind: str
    size: int
    open: Callable[[], IO[bytes]]


class _Bounded(io.RawIOBase):
    """A seekable stream that ends where its limit is, and refuses to be read in one huge piece.

    The tar format lets a header claim a name of any length, which :mod:`tarfile` reads at once.
    """

    def __init__(self, stream: IO[bytes], most: int) -> None:
        self._stream, self._most = stream, most

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._stream.tell()

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        if offset > self._most:
            raise ValueError(f"more than {self._most} bytes to unpack")
        return self._stream.seek(offset, whence)

    def read(self, size: int = -1) -> bytes:
        if not 0 <= size <= CHUNK_BYTES or self._stream.tell() + size > self._most:
            raise ValueError(f"a header of {size} bytes, or more than {self._most} bytes to unpack")
        return self._stream.read(size)


@contextmanager
def archive_members(archive: Path, most_bytes: int) -> Iterator[Iterator[Member]]:
    """Open an archive, and turn every way in which it can be damaged into one error.

    Args:
        archive: The file.
        most_bytes: Where a tar file ends at the latest when it is unpacked.

    Raises:
        UserError: The archive is damaged, of another format, or longer.
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
                tarfile.open(fileobj=_Bounded(stream, most_bytes), mode="r:") as tar,
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

        kind = "" if info.isreg() or info.isdir() else _tar_kind(info)
        yield Member(info.name, info.isdir(), kind, info.size, content)


def _tar_kind(info: tarfile.TarInfo) -> str:
    if info.issym() or info.islnk():
        return f"link to {info.linkname[:100]!r}"
    return "device or other special file"


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
