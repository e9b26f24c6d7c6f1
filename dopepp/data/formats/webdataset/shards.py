"""Tar shards: from what a user writes (a folder, a file, a URL) to where each member lies.

So any image can be read without what is before it. Only headers are read. A shard is somebody
else's archive: names that lead out of it, links, holes, members too large or cut off, and names
that come twice are refused.
"""

from __future__ import annotations

import hashlib
import io
import logging
import re
import tarfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Final, NamedTuple
from urllib.parse import urlsplit
from urllib.request import url2pathname

import numpy as np
from jaxtyping import Int64

from dopepp.core.errors import UserError
from dopepp.core.files import partial_path
from dopepp.data.archive import Bounded
from dopepp.data.formats.problems import STRICT, Place, Problems

_log = logging.getLogger(__name__)

MAX_SHARDS: Final = 100_000
_MAX_TEXT: Final = 4000
"""Characters of a path; Python reads no number with more digits."""

MAX_SHARD_BYTES: Final = 20_000_000_000
"""Of a shard that is downloaded; BOP's have about 1 GB."""

_MAX_BRACES: Final = 10

_RANGE: Final = re.compile(r"\{(-?\d+)\.\.(-?\d+)(?:\.\.-?\d+)?\}")
_SCHEME: Final = re.compile(r"([a-z][a-z0-9+.-]+):", re.IGNORECASE)
_PIECE_BYTES: Final = 1 << 20


def find_shards(
    root: Path,
    shards: str | Sequence[str],
    download_dir: Path | None = None,
    allow_commands: bool = False,
) -> list[Path]:
    """Return the shards as local files, in the order in which they are named.

    Args:
        root: Folder that relative paths start from.
        shards: A folder (its ``*.tar`` by name), a file, a URL, or several of them; braces as in
            ``shard-{000000..000009}.tar`` are expanded.
        download_dir: Where shards from URLs are kept; one that is there is not fetched again.
        allow_commands: Whether ``pipe:COMMAND`` may be run: a path that somebody else wrote into a
            config would run it with the user's rights.
    """
    paths = []
    for text in _expanded([shards] if isinstance(shards, str) else shards):
        scheme = _SCHEME.match(text)
        if scheme is None:
            paths += _local(root / text)
        elif scheme[1].lower() == "file":
            paths += _local(Path(url2pathname(urlsplit(text).path)))
        else:
            paths.append(_fetched(text, scheme[1].lower(), download_dir, allow_commands))
    if len(set(paths)) < len(paths):
        twice = next(path for path in paths if paths.count(path) > 1)
        raise UserError(f"shard {twice} twice", "each shard once", "correct data.image_sets")
    return paths


def _expanded(texts: Sequence[str]) -> list[str]:
    from braceexpand import braceexpand  # comes with the webdataset library

    expanded: list[str] = []
    for text in texts:
        if _longest_range(text) >= MAX_SHARDS:
            raise _too_many(text)
        try:
            # Of a command, braces belong to the command.
            lazily = [text] if text.startswith("pipe:") else braceexpand(text)
            expanded += islice(lazily, MAX_SHARDS + 1)
        except ValueError as error:
            raise UserError(
                f"shards {text!r:.100}: {error}", "braces as in shard-{000000..000009}.tar",
                "close the brace",
            ) from error  # fmt: skip
        if len(expanded) > MAX_SHARDS:
            raise _too_many(text)
    return expanded


def _longest_range(text: str) -> int:
    """Return the length of the longest ``{1..9}``, all of which the library lists at once."""
    # Texts too long, or with more braces than a path needs, count as too long a range.
    if len(text) > _MAX_TEXT or text.count("{") > _MAX_BRACES:
        return MAX_SHARDS
    return max((abs(int(m[2]) - int(m[1])) for m in _RANGE.finditer(text)), default=0)


def _too_many(text: str) -> UserError:
    return UserError(f"shards {text!r:.100}", f"at most {MAX_SHARDS:,} shards", "correct the range")


def _local(path: Path) -> list[Path]:
    if path.is_dir():
        shards = sorted(file for file in path.glob("*.tar") if not file.name.startswith("."))
        if shards:
            return shards
    elif path.is_file():
        return [path]
    raise UserError(
        f"shards {path}, {'a folder without *.tar' if path.is_dir() else 'no such file or folder'}",
        "a folder of shard-000000.tar, …, a shard, or a URL", "correct data.root or image_sets",
    )  # fmt: skip


def _fetched(url: str, scheme: str, folder: Path | None, allow_commands: bool) -> Path:
    if scheme == "pipe" and not allow_commands:
        raise UserError(
            f"shards {url!r:.100}, a command to run", "files, folders and URLs of shards",
            "download the shards, or allow commands in so many words (allow_commands=True)",
        )  # fmt: skip
    if folder is None:
        raise UserError(
            f"shards {url!r:.100}, which are not on this machine",
            "local shards, or a folder to download them into",
            "set data.download_dir",
        )
    name = PurePosixPath(urlsplit(url).path).name
    if scheme == "pipe" or not name.endswith(".tar"):
        name = hashlib.sha256(url.encode()).hexdigest()[:16] + ".tar"
    path = folder / name
    if not path.exists():
        _log.info("downloading %s to %s", url, path)
        _download(url, scheme, path)
    return path


def _download(url: str, scheme: str, path: Path) -> None:
    """Copy a shard through the library's own opener, within bounds; all of it or nothing."""
    # Imports torch where it is installed, so only those who download pay for it.
    from webdataset.gopen import gopen, gopen_schemes

    if scheme not in gopen_schemes:
        known = sorted(gopen_schemes.keys() - {"__default__", "pipe"})
        raise UserError(f"shards {url!r:.100}", f"URLs of {', '.join(known)}", "correct the URL")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial, size = partial_path(path), 0
    try:
        with gopen(url) as stream, partial.open("wb") as file:
            while piece := stream.read(_PIECE_BYTES):
                size += len(piece)
                if size > MAX_SHARD_BYTES:
                    raise UserError(
                        f"{url} of over {size / 1e9:.0f} GB",
                        f"shards of at most {MAX_SHARD_BYTES / 1e9:.0f} GB", "download it by hand",
                    )  # fmt: skip
                file.write(piece)
        partial.replace(path)
    except OSError as error:  # the library's for a command that failed, and a full disk
        raise UserError(
            f"shard {url}, which cannot be fetched into {path.parent}: {error!s:.200}",
            "a URL that can be read and enough space", "check the URL and the connection",
        ) from error  # fmt: skip
    finally:
        partial.unlink(missing_ok=True)


FIELDS: Final = ("image", "depth", "camera", "gt", "gt_info", "mask_visib")
"""What is read of an image."""

MAX_MEMBER_BYTES: Final = 256_000_000
MAX_MEMBERS: Final = 1_000_000
"""Of a shard; one of BOP's has 1,000 images of seven members each."""

KEY_FILE: Final = "key_to_shard.json"
"""Beside the shards: in which of them a key is."""

_IMAGE: Final = re.compile(r"(rgb|gray)\.(png|jpe?g|tiff?)")
_DEPTH: Final = re.compile(r"depth\.(png|tiff?)")
_ALLOWED: Final = (
    f"a whole uncompressed tar of plain files KEY.EXTENSION, each once and of at most "
    f"{MAX_MEMBER_BYTES / 1e6:.0f} MB, with rgb (or gray) and camera.json for every key"
)


class TarMember(NamedTuple):
    """A file in a shard: ``KEY.EXTENSION``, its first byte and its size."""

    key: str
    extension: str
    offset: int
    size: int


@dataclass(frozen=True)
class ShardIndex:
    """The images of a shard, in its order.

    ``spans`` has first byte and size of every image's :data:`FIELDS`, −1 where it has none.
    """

    path: Path
    keys: list[str]
    spans: Int64[np.ndarray, "images 6 2"]

    def read(self, image: int, field: str) -> bytes | None:
        """Return a member's content; None where the image has none."""
        offset, size = self.spans[image, FIELDS.index(field)].tolist()
        return None if offset < 0 else read_span(self.path, offset, size)


def read_span(path: Path, offset: int, size: int) -> bytes:
    """Return a part of a file; a UserError where it has become shorter or has gone."""
    try:
        with path.open("rb") as file:
            file.seek(offset)
            content = file.read(size)
    except OSError as error:
        raise _gone(path, str(error.strerror)) from error
    if len(content) < size:
        raise _gone(path, f"cut short within the member at byte {offset}")
    return content


def _gone(path: Path, got: str) -> UserError:
    return UserError(f"shard {path}: {got}", _ALLOWED, "copy, unzip or download the shard again")


def index_shard(path: Path) -> ShardIndex:
    """Find a shard's images.

    A UserError: the archive is refused (see :func:`members`), or an image lacks its picture or its
    camera, or has one of them twice.
    """
    place = Place(STRICT, path, "archive")
    rows: dict[str, int] = {}
    found: list[tuple[int, int, int, int]] = []
    for member in members(path):
        field = field_of(member.extension)
        if field is not None:
            row = rows.setdefault(member.key, len(rows))
            found.append((row, FIELDS.index(field), member.offset, member.size))
    spans = np.full((len(rows), len(FIELDS), 2), -1, np.int64)
    table = np.array(found, np.int64).reshape(-1, 4)
    spans[table[:, 0], table[:, 1]] = table[:, 2:]
    keys = list(rows)
    filled = np.bincount(table[:, 0] * len(FIELDS) + table[:, 1], minlength=spans[..., 0].size)
    for slot in np.flatnonzero(filled > 1).tolist():
        key, field = keys[slot // len(FIELDS)], FIELDS[slot % len(FIELDS)]
        place.report(f"{key} with two members for its {field}", _ALLOWED)
    for name in ("image", "camera"):
        for row in np.flatnonzero(spans[:, FIELDS.index(name), 0] < 0).tolist():
            got = f"{keys[row]} without {'rgb or gray' if name == 'image' else name}"
            place.report(got, _ALLOWED)
    return ShardIndex(path, keys, spans)


def members(path: Path, problems: Problems = STRICT) -> Iterator[TarMember]:
    """Yield the files of a shard; folders and WebDataset's own ``__meta__`` are passed over.

    What cannot be taken is a problem and passed over: an archive that is compressed, cut short or
    damaged, and a member that is no plain file, leads out of the archive, has no extension, comes
    twice or is too large.
    """
    place = Place(problems, path, "archive")
    try:
        with path.open("rb") as file:
            if file.read(2) == b"\x1f\x8b":
                place.report("a compressed archive, in which no member can be found", _ALLOWED)
                return
            size = file.seek(0, io.SEEK_END)
            file.seek(0)
            yield from _walk(place, file, size)
    except UserError:
        raise
    except OSError as error:
        place.report(str(error.strerror or error), _ALLOWED)
    except (tarfile.TarError, ValueError, OverflowError) as error:
        place.report(f"damaged: {error}", _ALLOWED)


def _walk(place: Place, file: io.BufferedReader, size: int) -> Iterator[TarMember]:
    names: set[str] = set()
    with tarfile.open(fileobj=Bounded(file), mode="r:") as archive:
        while (info := archive.next()) is not None:
            archive.members = []  # type: ignore[attr-defined]  # it keeps every header it has read
            if _is_passed_over(info):
                continue
            if len(names) == MAX_MEMBERS:
                place.report(f"over {MAX_MEMBERS:,} members", _ALLOWED)
                return
            got = "twice" if info.name in names else _refusal(info, size)
            if got:
                place.report(f"member {info.name!r:.80} {got}", _ALLOWED)
                continue
            names.add(info.name)
            name = PurePosixPath(info.name)
            key, _, extension = name.name.partition(".")
            start = str(name.with_name(key))
            yield TarMember(start, extension.lower(), info.offset_data, info.size)
        end = archive.offset
    # tarfile takes a damaged header after the first, and the end of the file, for the archive's.
    file.seek(end)
    if file.read(tarfile.BLOCKSIZE) != bytes(tarfile.BLOCKSIZE):
        place.report(f"cut short or damaged at byte {end}", _ALLOWED)


def _is_passed_over(info: tarfile.TarInfo) -> bool:
    name = PurePosixPath(info.name).name
    is_meta = name.startswith("__") and name.endswith("__")
    return (info.isdir() or is_meta) and not _leads_out(info)


def _leads_out(info: tarfile.TarInfo) -> bool:
    name = PurePosixPath(info.name)
    odd = "\\" in info.name or not info.name.isprintable()
    return name.is_absolute() or ".." in name.parts or odd


def _refusal(info: tarfile.TarInfo, archive_size: int) -> str:
    """Say why a member is not taken; nothing where it is."""
    key, dot, _ = PurePosixPath(info.name).name.partition(".")
    if _leads_out(info):
        return "which leads out of the archive"
    if not info.isreg() or info.issparse():
        return "which is a link, a device or has holes"
    if not 0 <= info.size <= MAX_MEMBER_BYTES:
        return f"of {info.size / 1e6:,.0f} MB"
    if info.offset_data + info.size > archive_size:
        return "within which the archive is cut short"
    return "" if key and dot else "which is no KEY.EXTENSION"


def field_of(extension: str) -> str | None:
    """Return which of :data:`FIELDS` a member's extension stands for, None for another."""
    if _IMAGE.fullmatch(extension):
        return "image"
    if _DEPTH.fullmatch(extension):
        return "depth"
    field = extension.removesuffix(".json")
    return field if field in FIELDS and field != extension else None
