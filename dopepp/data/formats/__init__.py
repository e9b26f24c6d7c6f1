"""What the layouts share: shares of a data set's items, and writers that can be stopped any moment.

Items are written one by one and finalized chunk by chunk. An item's last file is its marker, so
what is there is complete; files that a chunk's items share (``scene_gt.json``, a tar shard) are
assembled when all of them are there, from items that are staged in a hidden folder until then.

To add a format, write a folder beside these with a source (:mod:`dopepp.data.sample`) that reports
to a :class:`~dopepp.data.formats.problems.Problems`, a check (:mod:`dopepp.data.check`), and, if it
is to be rendered, a :class:`Writer` and one line in ``WRITERS`` of :mod:`dopepp.data.jobs.job`.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

from dopepp.core.errors import UserError
from dopepp.core.files import write_whole
from dopepp.core.json import MAX_BYTES, read_json
from dopepp.data.sample import Sample

T = TypeVar("T")

STAGING: Final = ".items"
"""Folder of staged items; readers pass over hidden names."""

RECORD_FILE: Final = "_dopepp_render.json"
"""A render job's record in its folder. The underscore is NDDS's mark of a settings file: without
it, readers of that layout would take the record for an image's annotation."""

_LOCK: Final = "lock"
_ATTEMPTS: Final = 100


class Writer(Protocol):
    """Writes samples into a folder; made anew in every process from (folder, parts).

    Everything goes through :func:`dopepp.core.files.write_whole` or the like: a file is there
    completely or not at all. The bytes of an item depend on nothing but (index, sample).
    """

    name: str
    """Name of the layout: ``bop``, ``ndds`` or ``webdataset``."""

    chunk_size: int
    """Items ``chunk·chunk_size … (chunk + 1)·chunk_size − 1`` are finalized together."""

    def prepare(self) -> None:
        """Write what all of a data set shares, idempotently; a UserError in another's folder."""

    def write(self, index: int, sample: Sample) -> None:
        """Write one item completely; on return it survives a crash."""

    def written(self, chunk: int) -> set[int]:
        """Return the indices of the chunk's complete items, finalized or not."""

    def finalize(self, chunk: int, indices: Sequence[int]) -> None:
        """Assemble what the chunk's items share from the items themselves.

        Idempotent and atomic; two processes may do it at once, and a finalized chunk may be
        finalized again when later items have been added to it.
        """


def share(num_items: int, part_of: tuple[float, float], name: str) -> slice:
    """Return which of ``num_items`` items a share given in fractions is.

    Both bounds are rounded alike, so shares that meet in a fraction neither overlap nor leave out.
    A UserError: no item falls into the share.
    """
    first, last = part_of
    if not 0 <= first < last <= 1:
        raise ValueError(f"part_of must be ascending in [0, 1], got {part_of}")
    chosen = slice(round(first * num_items), round(last * num_items))
    if chosen.start == chosen.stop:
        raise UserError(
            f"{name}: no image in the share {first:.3g} – {last:.3g} of {num_items} images",
            "a folder with more images", "give every split a folder of its own",
        )  # fmt: skip
    return chosen


def read_object(path: Path, max_bytes: int = MAX_BYTES) -> dict[str, Any]:
    """Read a JSON file that a writer adds to; empty where there is none yet."""
    content = read_json(path, max_bytes) if path.exists() else {}
    if not isinstance(content, dict):
        raise UserError(f"{path}, no JSON object", "what this writer wrote", "restore or remove it")
    return content


def by_line(content: Mapping[str, object]) -> bytes:
    """Return a JSON object with a line for each key."""
    lines = [f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in content.items()]
    return ("{\n" + ",\n".join(lines) + "\n}\n").encode()


def stage(path: Path, content: bytes) -> None:
    """Write a staged item, also if a finalizer removes the empty folder in the same moment."""
    retry(lambda: write_whole(path, content))


def staged_items(staging: Path, suffix: str) -> list[Path]:
    """Return the staged items in order, none if a finalizer removes the folder meanwhile."""
    try:
        return sorted(staging.glob(f"[0-9]*{suffix}"))
    except FileNotFoundError:
        return []


@contextmanager
def finalizing(staging: Path) -> Iterator[None]:
    """Hold a folder of staged items; it goes in the end if nothing is left in it.

    A killed process holds nothing: the system releases its lock. Two that both merge and then
    remove staged items would otherwise lose what one of them had not seen.
    """
    path = staging / _LOCK
    while True:
        descriptor = retry(lambda: _open(path))
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            # Whoever held it before may have removed the file: then the next one makes another.
            if not _is_same(descriptor, path):
                continue
            yield
            if not any(entry.name != _LOCK for entry in staging.iterdir()):
                path.unlink()
                with suppress(OSError):  # another process has staged an item in this moment
                    staging.rmdir()
            return
        finally:
            os.close(descriptor)


def _open(path: Path) -> int:
    path.parent.mkdir(parents=True, exist_ok=True)
    return os.open(path, os.O_RDWR | os.O_CREAT)


def retry(act: Callable[[], T]) -> T:
    """Return what ``act`` does in a folder that it makes and a finalizer may remove at any moment.

    Removed before it is used, the folder is not found; removed between ``mkdir`` and its look at
    what is in the way, it "exists". What stays in the way is raised in the end.
    """
    for _ in range(_ATTEMPTS - 1):
        try:
            return act()
        except (FileNotFoundError, FileExistsError):
            continue
    return act()


def _is_same(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
