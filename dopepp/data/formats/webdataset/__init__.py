"""Index BOP-WebDataset shards: tar files with members ``KEY.rgb.jpg``, ``KEY.gt.json`` etc.

Indexing reads headers only, and gives random access to the images. Shards are untrusted: paths out
of the archive, links, holes, truncated or too large members, and repeated names are rejected.
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
from dopepp.data.formats.problems import STRICT, Node, Problems

FIELDS: Final = {
    "image": re.compile(r"(rgb|gray)\.(png|jpe?g|tiff?)"),
    "depth": re.compile(r"depth\.(png|tiff?)"),
    **{name: re.compile(rf"{name}\.json") for name in ("camera", "gt", "gt_info", "mask_visib")},
}
"""Extensions of the members that the reader reads, by field; image and camera are required."""

MAX_MEMBER_BYTES: Final = 256_000_000
MAX_MEMBERS: Final = 1_000_000
"""Largest number of members in a shard; BOP's shards have 1,000 images of seven members."""

KEY_FILE: Final = "key_to_shard.json"
"""File in the folder of the shards that lists the shard of every key."""

_MAX_READ_BYTES: Final = 1 << 20
_ALLOWED: Final = (
    f"a complete uncompressed tar of plain files KEY.EXTENSION, each once and of at most "
    f"{MAX_MEMBER_BYTES / 1e6:.0f} MB, with rgb (or gray) and camera.json for every key"
)


class TarMember(NamedTuple):
    """A file ``KEY.EXTENSION`` in a shard, with the offset of its first byte and its size."""

    key: str
    extension: str
    offset: int
    size: int


@dataclass(frozen=True)
class ShardIndex:
    """The images of a shard, in the order of the shard.

    ``spans`` holds each image's offset and size, in bytes, of the members in :data:`FIELDS`; −1 for
    a missing member.
    """

    path: Path
    keys: list[str]
    spans: Int64[np.ndarray, "images 6 2"]

    def read(self, image: int, field: str) -> bytes | None:
        """Return the content of an image's ``field`` (in :data:`FIELDS`), or None if missing."""
        offset, size = self.spans[image, [*FIELDS].index(field)].tolist()
        return None if offset < 0 else read_span(self.path, offset, size)


def read_span(path: Path, offset: int, size: int) -> bytes:
    """Read ``size`` bytes of a shard from byte ``offset``.

    Raises:
        UserError: The file is missing or truncated.
    """
    problem = f"cut short within the member at byte {offset}"
    try:
        with path.open("rb") as file:
            file.seek(offset)
            content = file.read(size)
        if len(content) == size:
            return content
    except OSError as error:
        problem = str(error.strerror)
    raise UserError(f"shard {path}: {problem}", _ALLOWED, "copy, unzip or download the shard again")


def index_shard(path: Path) -> ShardIndex:
    """Index a shard's images.

    Raises:
        UserError: :func:`members` reports a problem, an image lacks its image or camera, or a
            member is repeated.
    """
    node = Node(STRICT, path, "archive")
    spans: dict[str, dict[str, tuple[int, int]]] = {}  # by key and field
    for member in members(path):
        field = field_of(member.extension)
        if field is not None:
            fields = spans.setdefault(member.key, {})
            if field in fields:
                node.report(f"{member.key} with two members for its {field}", _ALLOWED)
            fields[field] = member.offset, member.size
    for name, noun in (("image", "rgb or gray"), ("camera", "camera")):
        for key, fields in spans.items():
            if name not in fields:
                node.report(f"{key} without {noun}", _ALLOWED)
    rows = [[fields.get(name, (-1, -1)) for name in FIELDS] for fields in spans.values()]
    return ShardIndex(path, list(spans), np.array(rows, np.int64).reshape(-1, len(FIELDS), 2))


def members(path: Path, problems: Problems = STRICT) -> Iterator[TarMember]:
    """Yield the files of a shard, without folders and WebDataset's ``__meta__``.

    A compressed, truncated or damaged archive is reported to ``problems``. A member that is not a
    plain file, leads out of the archive, has no extension, is repeated or is too large is reported
    and skipped.

    Raises:
        UserError: There is a problem, and ``problems`` is :data:`STRICT`.
    """
    node = Node(problems, path, "archive")
    try:
        with _ShardFile(path) as file:
            if file.read(2) == b"\x1f\x8b":
                node.report("a compressed archive", _ALLOWED)
                return
            file.seek(0)
            yield from _walk(node, file, path.stat().st_size)
    except UserError:
        raise
    except OSError as error:
        node.report(str(error.strerror or error), _ALLOWED)
    except (tarfile.TarError, ValueError, OverflowError) as error:
        node.report(f"damaged: {error}", _ALLOWED)


class _ShardFile(io.FileIO):
    """A file that rejects large reads: a tar header can claim a name of any length."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is None or not 0 <= size <= _MAX_READ_BYTES:
            raise ValueError(f"a header of {size} bytes")
        return super().read(size)


def _walk(node: Node, file: _ShardFile, size: int) -> Iterator[TarMember]:
    """Yield the members of a shard; report members that are repeated, unsafe or too large."""
    names: set[str] = set()
    with tarfile.open(fileobj=file, mode="r:") as archive:
        while (info := archive.next()) is not None:
            archive.members = []  # type: ignore[attr-defined]  # which collects all headers
            name = PurePosixPath(info.name)
            is_meta = name.name.startswith("__") and name.name.endswith("__")
            if (info.isdir() or is_meta) and not _leads_out(info):
                continue
            if len(names) == MAX_MEMBERS:
                node.report(f"over {MAX_MEMBERS:,} members", _ALLOWED)
                return
            if problem := "twice" if info.name in names else _problem(info, size):
                node.report(f"member {info.name!r:.80} {problem}", _ALLOWED)
                continue
            names.add(info.name)
            stem, _, extension = name.name.partition(".")
            key = str(name.with_name(stem))
            yield TarMember(key, extension.lower(), info.offset_data, info.size)
        end = archive.offset
    # tarfile stops without an error at a damaged header and at the end of a truncated file.
    file.seek(end)
    if file.read(tarfile.BLOCKSIZE) != bytes(tarfile.BLOCKSIZE):
        node.report(f"cut short or damaged at byte {end}", _ALLOWED)


def _leads_out(info: tarfile.TarInfo) -> bool:
    """Return whether a member's name could leave the folder or is not a plain path."""
    name = PurePosixPath(info.name)
    odd = "\\" in info.name or not info.name.isprintable()
    return name.is_absolute() or ".." in name.parts or odd


def _problem(info: tarfile.TarInfo, archive_size: int) -> str:
    key, dot, _ = PurePosixPath(info.name).name.partition(".")
    if _leads_out(info):
        return "which leads out of the archive"
    if not info.isreg() or info.issparse():
        return "which is a link, a device or has holes"
    if not 0 <= info.size <= MAX_MEMBER_BYTES:
        return f"of {info.size / 1e6:,.0f} MB"
    if info.offset_data + info.size > archive_size:
        return "which is truncated"
    return "" if key and dot else "which is not KEY.EXTENSION"


def field_of(extension: str) -> str | None:
    """Return the entry of :data:`FIELDS` for a member's extension, or None."""
    return next((name for name, pattern in FIELDS.items() if pattern.fullmatch(extension)), None)
