"""Where shards are: from a folder, file or URL that a user writes to local files."""

from __future__ import annotations

import hashlib
import logging
import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Final
from urllib.parse import urlsplit
from urllib.request import url2pathname

from dopepp.core.errors import UserError
from dopepp.core.files import partial_path

_log = logging.getLogger(__name__)

MAX_SHARDS: Final = 100_000
MAX_SHARD_BYTES: Final = 20_000_000_000
"""Largest shard to download; BOP's have about 1 GB."""

_MAX_TEXT: Final = 4000
"""Characters of a path; Python reads no number with more digits."""

_MAX_BRACES: Final = 10
_PIECE_BYTES: Final = 1 << 20

_RANGE: Final = re.compile(r"\{(-?\d+)\.\.(-?\d+)(?:\.\.-?\d+)?\}")
_SCHEME: Final = re.compile(r"([a-z][a-z0-9+.-]+):", re.IGNORECASE)


def find_shards(
    root: Path, shards: str | Sequence[str], download_dir: Path | None = None
) -> list[Path]:
    """Return the shards as local files, in the order in which they are named.

    Args:
        root: Folder that relative paths start from.
        shards: A folder (its ``*.tar`` by name), a file, a URL, or several of them; braces as in
            ``shard-{000000..000009}.tar`` are expanded.
        download_dir: Folder for shards from URLs; a shard in it is not downloaded again.
    """
    paths = []
    for text in _expanded([shards] if isinstance(shards, str) else shards):
        scheme = _SCHEME.match(text)
        if scheme is None:
            paths += _local(root / text)
        elif scheme[1].lower() == "file":
            paths += _local(Path(url2pathname(urlsplit(text).path)))
        else:
            paths.append(_fetched(text, scheme[1].lower(), download_dir))
    if len(set(paths)) < len(paths):
        twice = next(path for path in paths if paths.count(path) > 1)
        raise UserError(f"shard {twice} twice", "each shard once", "correct data.image_sets")
    return paths


def _expanded(texts: Sequence[str]) -> list[str]:
    from braceexpand import braceexpand  # comes with the webdataset library

    expanded: list[str] = []
    for text in texts:
        # The library lists a whole range at once, and nothing bounds the product of many braces.
        lengths = (abs(int(m[2]) - int(m[1])) for m in _RANGE.finditer(text[:_MAX_TEXT]))
        too_long = len(text) > _MAX_TEXT or text.count("{") > _MAX_BRACES
        if not too_long and max(lengths, default=0) < MAX_SHARDS:
            try:
                expanded += islice(braceexpand(text), MAX_SHARDS + 1)
            except ValueError as error:
                got, allowed = f"shards {text!r:.100}: {error}", "braces as in shard-{00..09}.tar"
                raise UserError(got, allowed, "close the brace") from error
            if len(expanded) <= MAX_SHARDS:
                continue
        allowed = f"at most {MAX_SHARDS:,} shards"
        raise UserError(f"shards {text!r:.100}", allowed, "correct the range")
    return expanded


def _local(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    shards = sorted(file for file in path.glob("*.tar") if not file.name.startswith("."))
    if shards:
        return shards
    lack = "a folder without *.tar" if path.is_dir() else "no such file or folder"
    allowed = "a folder of shard-000000.tar, …, a shard, or a URL"
    raise UserError(f"shards {path}, {lack}", allowed, "correct data.root or image_sets")


def _fetched(url: str, scheme: str, folder: Path | None) -> Path:
    got = f"shards {url!r:.100}"
    if scheme == "pipe":  # a path in a stranger's config would run with the user's rights
        allowed = "files, folders and URLs of shards"
        raise UserError(f"{got}, a command to run", allowed, "download the shards")
    if folder is None:
        allowed = "local shards, or a folder to download them into"
        raise UserError(f"{got}, which are not on this machine", allowed, "set data.download_dir")
    name = PurePosixPath(urlsplit(url).path).name
    if not name.endswith(".tar"):
        name = hashlib.sha256(url.encode()).hexdigest()[:16] + ".tar"
    path = folder / name
    if not path.exists():
        _log.info("downloading %s to %s", url, path)
        _download(url, scheme, path)
    return path


def _download(url: str, scheme: str, path: Path) -> None:
    """Download a whole shard, within bounds, through the library's own opener."""
    from webdataset.gopen import gopen, gopen_schemes  # imports torch where it is installed

    if scheme not in gopen_schemes:
        known = ", ".join(sorted(gopen_schemes.keys() - {"__default__", "pipe"}))
        raise UserError(f"shards {url!r:.100}", f"URLs of {known}", "correct the URL")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial, size = partial_path(path), 0
    try:
        with gopen(url) as stream, partial.open("wb") as file:
            while piece := stream.read(_PIECE_BYTES):
                size += len(piece)
                if size > MAX_SHARD_BYTES:
                    allowed = f"shards of at most {MAX_SHARD_BYTES / 1e9:.0f} GB"
                    got = f"{url} of over {size / 1e9:.0f} GB"
                    raise UserError(got, allowed, "download it by hand")
                file.write(piece)
        partial.replace(path)
    except OSError as error:
        got = f"shard {url}, which cannot be fetched into {path.parent}: {error!s:.200}"
        allowed = "a URL that can be read and enough space"
        raise UserError(got, allowed, "check the URL and the connection") from error
    finally:
        partial.unlink(missing_ok=True)
