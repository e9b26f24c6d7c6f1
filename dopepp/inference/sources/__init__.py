"""Where pictures come from: files, folders, videos, cameras, streams, recordings of robots.

To add a kind, write a class with what :class:`~dopepp.inference.sources.source.Source` has in a
module of its own, and a line in :func:`_source`.
"""

from __future__ import annotations

import glob
from collections.abc import Iterable
from pathlib import Path

from dopepp.core.errors import UserError
from dopepp.inference.sources.bag import BAGS, Bag
from dopepp.inference.sources.files import VIDEOS, Pictures, Video, in_order, pictures_of
from dopepp.inference.sources.live import Live, is_url
from dopepp.inference.sources.source import Frame, Source

__all__ = ["Frame", "Source", "SourceLike", "open_sources"]

SourceLike = str | Path | int | Source
"""The path of a picture, folder, video or bag, a glob pattern, a camera's number or device, a URL,
or a source that is open."""


def open_sources(given: Iterable[SourceLike], topic: str | None = None) -> list[Source]:
    """Return the sources that are meant, in their order; pictures in a row are one sequence.

    ``topic`` is that of a bag's pictures, where it has several.

    Raises:
        UserError: There is no such file, camera or topic, a folder has no pictures, a video or bag
            is unreadable, or a bag's extra is missing.
    """
    sources: list[Source] = []
    pictures: list[Path] = []
    for one in _expanded(given):
        if isinstance(one, Path) and (found := pictures_of(one)) is not None:
            pictures += found
            continue
        if pictures:
            sources.append(Pictures(pictures))
            pictures = []
        sources.append(_source(one, topic))
    return [*sources, Pictures(pictures)] if pictures else sources


def _source(one: Path | str | int | Source, topic: str | None) -> Source:
    if isinstance(one, int | str):
        return Live(one)
    if not isinstance(one, Path):
        return one
    return Video(one) if one.suffix.lower() in VIDEOS else Bag(one, topic)


def _expanded(given: Iterable[SourceLike]) -> list[Path | str | int | Source]:
    """Tell paths from cameras (numbers), devices and URLs (text), and look up patterns."""
    found: list[Path | str | int | Source] = []
    for one in given:
        if not isinstance(one, str | Path):
            found.append(one)
        elif is_url(str(one)) or Path(one).is_char_device():  # as /dev/v4l/by-id/…
            found.append(str(one))
        elif Path(one).exists():
            found.append(Path(one))
        elif str(one).isdecimal() and len(str(one)) < 4:
            found.append(int(str(one)))
        else:
            found += _matches(str(one))
    return found


def _matches(pattern: str) -> list[Path]:
    """Return the paths that match a glob pattern."""
    paths = [Path(one) for one in glob.glob(pattern, recursive=True)]  # noqa: PTH207
    if paths:
        return in_order(paths)
    suffixes = ", ".join((*VIDEOS, *BAGS))
    raise UserError(
        f"{pattern}, which matches no file" if glob.has_magic(pattern) else f"{pattern}, no such",
        f"a picture, a folder of pictures, a pattern like 'frames/*.png', a video or a bag "
        f"({suffixes}), a camera's number, or an rtsp:// or http:// address",
        "check the path",
    )
