"""Where every member of a tar shard lies, so that any image can be read without what is before it.

Only headers are read. A shard is somebody else's archive: names that lead out of it, links, holes,
members too large or cut off, and names that come twice are refused.
"""

from __future__ import annotations

import io
import re
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Int64

from dopepp.core.errors import UserError

FIELDS: Final = ("image", "depth", "camera", "gt", "gt_info", "mask_visib")
"""What is read of an image."""

MAX_MEMBER_BYTES: Final = 256_000_000
MAX_MEMBERS: Final = 1_000_000
"""Of a shard; one of BOP's has 1,000 images of seven members each."""

_IMAGE: Final = re.compile(r"(rgb|gray)\.(png|jpe?g|tiff?)")
_DEPTH: Final = re.compile(r"depth\.(png|tiff?)")
_HEADER_BYTES: Final = 1_000_000
"""No header is longer; long names and their like are read whole by ``tarfile``."""

_BLOCK: Final = tarfile.BLOCKSIZE


class TarMember(NamedTuple):
    """A file in a shard: ``KEY.EXTENSION``, its first byte and its size."""

    key: str
    extension: str
    offset: int
    size: int


@dataclass(frozen=True)
class ShardIndex:
    """The images of a shard, in its order.

    Attributes:
        path: The shard.
        keys: Key of every image.
        spans: First byte and size of every image's :data:`FIELDS`; −1 where it has none.
    """

    path: Path
    keys: list[str]
    spans: Int64[np.ndarray, "images 6 2"]

    def read(self, image: int, field: str) -> bytes | None:
        """Return a member's content; None where the image has none.

        Raises:
            UserError: The shard has become shorter or has gone.
        """
        offset, size = self.spans[image, FIELDS.index(field)].tolist()
        return None if offset < 0 else read_span(self.path, offset, size)


def read_span(path: Path, offset: int, size: int) -> bytes:
    """Return a part of a file.

    Raises:
        UserError: The file has become shorter or has gone.
    """
    try:
        with path.open("rb") as file:
            file.seek(offset)
            content = file.read(size)
    except OSError as error:
        raise _bad(path, str(error.strerror)) from error
    if len(content) < size:
        raise _bad(path, f"cut short within the member at byte {offset}")
    return content


def index_shard(path: Path) -> ShardIndex:
    """Find a shard's images.

    Raises:
        UserError: The archive is refused (see :func:`members`), or an image lacks its picture or
            its camera or has one of them twice.
    """
    rows: dict[str, int] = {}
    found: list[tuple[int, int, int, int]] = []
    for member in members(path):
        field = _field(member.extension)
        if field is not None:
            row = rows.setdefault(member.key, len(rows))
            found.append((row, FIELDS.index(field), member.offset, member.size))
    spans = np.full((len(rows), len(FIELDS), 2), -1, np.int64)
    table = np.array(found, np.int64).reshape(-1, 4)
    spans[table[:, 0], table[:, 1]] = table[:, 2:]
    keys = list(rows)
    filled = np.bincount(table[:, 0] * len(FIELDS) + table[:, 1], minlength=spans[..., 0].size)
    for place in np.flatnonzero(filled > 1).tolist():
        key, field = keys[place // len(FIELDS)], FIELDS[place % len(FIELDS)]
        raise _bad(path, f"{key} with two members for its {field}")
    for name in ("image", "camera"):
        for row in np.flatnonzero(spans[:, FIELDS.index(name), 0] < 0).tolist():
            raise _bad(path, f"{keys[row]} without {'rgb or gray' if name == 'image' else name}")
    return ShardIndex(path, keys, spans)


def members(path: Path) -> Iterator[TarMember]:
    """Yield the files of a shard; folders and WebDataset's own ``__meta__`` are passed over.

    Raises:
        UserError: The file is no uncompressed tar archive or is cut short, or a member is no plain
            file, leads out of the archive, has no extension, comes twice or is too large.
    """
    try:
        with path.open("rb") as file:
            if file.read(2) == b"\x1f\x8b":
                raise _bad(path, "a compressed archive, in which no member can be found")
            size = file.seek(0, io.SEEK_END)
            file.seek(0)
            yield from _walk(path, file, size)
    except UserError:
        raise
    except OSError as error:
        raise _bad(path, str(error.strerror or error)) from error
    except (tarfile.TarError, ValueError, OverflowError) as error:
        raise _bad(path, f"damaged: {error}") from error


def _walk(path: Path, file: io.BufferedReader, size: int) -> Iterator[TarMember]:
    names: set[str] = set()
    with tarfile.open(fileobj=_Bounded(file), mode="r:") as archive:  # type: ignore[call-overload]
        while (info := archive.next()) is not None:
            archive.members = []  # it keeps every header it has read
            member = _member(path, info, size)
            if member is None:
                continue
            if info.name in names or len(names) == MAX_MEMBERS:
                raise _bad(path, f"member {info.name!r:.80} twice, or over {MAX_MEMBERS:,} members")
            names.add(info.name)
            yield member
        end = archive.offset
    # tarfile takes a damaged header after the first, and the end of the file, for the archive's.
    file.seek(end)
    if file.read(_BLOCK) != bytes(_BLOCK):
        raise _bad(path, f"cut short or damaged at byte {end}")


def _member(path: Path, info: tarfile.TarInfo, archive_size: int) -> TarMember | None:
    name = PurePosixPath(info.name)
    if name.is_absolute() or ".." in name.parts or "\\" in info.name or not info.name.isprintable():
        raise _bad(path, f"member {info.name!r:.80}, which leads out of the archive")
    if info.isdir() or (name.name.startswith("__") and name.name.endswith("__")):
        return None
    if not info.isreg() or info.issparse():
        raise _bad(path, f"member {info.name!r:.80}, which is a link, a device or has holes")
    if not 0 <= info.size <= MAX_MEMBER_BYTES:
        raise _bad(path, f"member {info.name!r:.80} of {info.size / 1e6:,.0f} MB")
    if info.offset_data + info.size > archive_size:
        raise _bad(path, f"cut short within member {info.name!r:.80}")
    key, dot, extension = name.name.partition(".")
    if not key or not dot:
        raise _bad(path, f"member {info.name!r:.80}, which is no KEY.EXTENSION")
    return TarMember(str(name.with_name(key)), extension.lower(), info.offset_data, info.size)


def _field(extension: str) -> str | None:
    if _IMAGE.fullmatch(extension):
        return "image"
    if _DEPTH.fullmatch(extension):
        return "depth"
    field = extension.removesuffix(".json")
    return field if field in FIELDS and field != extension else None


class _Bounded:
    """A file of which only headers are read: a longer one would fill the memory."""

    def __init__(self, file: io.BufferedReader) -> None:
        self._file = file
        self.seek, self.tell = file.seek, file.tell

    def read(self, size: int = -1) -> bytes:
        if not 0 <= size <= _HEADER_BYTES:
            raise ValueError(f"a header of {size} bytes")
        return self._file.read(size)


def _bad(path: Path, got: str) -> UserError:
    return UserError(
        f"shard {path}: {got}",
        f"a whole uncompressed tar of plain files KEY.EXTENSION, each once and of at most "
        f"{MAX_MEMBER_BYTES / 1e6:.0f} MB, with rgb (or gray) and camera.json for every key",
        "copy, unzip or download the shard again",
    )
