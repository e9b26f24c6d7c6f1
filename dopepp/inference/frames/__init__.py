"""Sources of camera frames: image files, folders, videos, cameras, streams and ROS recordings.

To add a kind of source, derive a class from
:class:`~dopepp.inference.frames.source.FrameSource` and return it from :func:`open_sources`.
"""

from __future__ import annotations

import glob
from collections.abc import Iterable, Iterator
from pathlib import Path

from dopepp.core.errors import UserError
from dopepp.inference.frames.media import (
    VIDEOS,
    Images,
    Live,
    Video,
    is_url,
    list_images,
    sort_paths,
)
from dopepp.inference.frames.ros import BAGS, Bag
from dopepp.inference.frames.source import CameraFrame, FrameSource

__all__ = ["CameraFrame", "FrameSource", "SourceLike", "open_sources"]

SourceLike = str | Path | int | FrameSource
"""Path of an image, folder, video or ROS recording; glob pattern; camera number, device or URL; or
an opened frame source."""


def open_sources(
    sources: Iterable[SourceLike], topic: str | None = None, by_folder: bool = False
) -> list[FrameSource]:
    """Open frame sources in the given order. Consecutive image files form one sequence.

    ``topic`` is the image topic of a ROS recording that has several. With ``by_folder``, images of
    different folders do not form one sequence.

    Raises:
        UserError: A file, camera or topic does not exist, a folder has no images, a video or
            recording is unreadable, or the extra ``bags`` is not installed.
    """
    opened: list[FrameSource] = []
    image_paths: list[Path] = []
    for source in _resolve(sources):
        images = list_images(source) if isinstance(source, Path) else None
        is_next = images is not None and not (
            by_folder and image_paths and images[0].parent != image_paths[0].parent
        )
        if image_paths and not is_next:
            opened.append(Images(image_paths))
            image_paths = []
        if images is not None:
            image_paths += images
            continue
        if isinstance(source, FrameSource):
            opened.append(source)
        elif isinstance(source, Path):
            is_video = source.suffix.lower() in VIDEOS
            opened.append(Video(source) if is_video else Bag(source, topic))
        else:
            opened.append(Live(source))
    return [*opened, Images(image_paths)] if image_paths else opened


def _resolve(sources: Iterable[SourceLike]) -> Iterator[SourceLike]:
    """Yield paths as Path, cameras as int, devices and URLs as str; expand glob patterns."""
    for source in sources:
        if not isinstance(source, str | Path):
            yield source
        elif is_url(str(source)) or Path(source).is_char_device():  # e.g. /dev/v4l/by-id/…
            yield str(source)
        elif Path(source).exists():
            yield Path(source)
        elif str(source).isdecimal() and len(str(source)) < 4:
            yield int(str(source))
        elif paths := glob.glob(str(source), recursive=True):  # noqa: PTH207
            yield from sort_paths(map(Path, paths))
        else:
            problem = "which matches no file" if glob.has_magic(str(source)) else "no such file"
            raise UserError(
                f"{source}, {problem}",
                "an image, a folder of images, a pattern like 'frames/*.png', a video or a "
                f"recording ({', '.join((*VIDEOS, *BAGS))}), a camera number, or an rtsp:// or "
                "http:// address",
                "pass the path of an existing file, in quotes if it is a pattern",
            )
