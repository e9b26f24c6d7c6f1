"""Files of pictures, one after the other, and video files, read by OpenCV's FFmpeg."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import UInt8

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import MAX_PIXELS, Picture, read_photo
from dopepp.drawing.video import USUAL_RATE
from dopepp.inference.sources.bag import BAGS, is_bag_folder
from dopepp.inference.sources.source import Frame

SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
"""Of a folder's pictures; a file that is named alone may have any."""

VIDEOS: Final = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".ts")

HIGHEST_RATE: Final = 1000.0

_MARKS: Final = (
    (4, b"ftyp"), (4, b"moov"), (4, b"mdat"), (4, b"wide"), (4, b"free"), (0, b"RIFF"),
    (0, b"\x1aE\xdf\xa3"), (0, b"\x00\x00\x01\xba"), (0, b"\x00\x00\x01\xb3"), (0, b"G"),
)  # fmt: skip
"""What a video begins with, and where: FFmpeg would open playlists, which name other files."""

logger = logging.getLogger(__name__)


class Pictures:
    """Picture files, in the order given."""

    rate = None
    camera = None

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = paths
        self.name, self.stem = str(paths[0]), paths[0].stem
        self.count = len(paths)
        numbers = [int(one.stem) if one.stem.isdecimal() else -1 for one in paths]
        own = min(numbers) >= 0 and len(set(numbers)) == len(numbers)
        self._numbers = numbers if own else range(len(paths))

    def frames(self, stride: int = 1) -> Iterator[Frame]:
        """Yield every so manieth picture; a UserError names the one that is damaged."""
        for number, path in list(zip(self._numbers, self._paths, strict=True))[::stride]:
            yield Frame(read_photo(path), str(path), number)


def pictures_of(path: Path) -> list[Path] | None:
    """Return a folder's pictures or the path itself; None where it is a video or a bag.

    A :class:`UserError`: a folder has no pictures.
    """
    if not path.is_dir():
        return None if path.suffix.lower() in (*VIDEOS, *BAGS) else [path]
    if is_bag_folder(path):
        return None
    found = in_order(one for one in path.iterdir() if one.suffix.lower() in SUFFIXES)
    if not found:
        allowed = f"a folder with pictures ({', '.join(SUFFIXES)})"
        raise UserError(f"{path} without a picture", allowed, "pass the folder they are in")
    return found


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Sort paths as a person would: frame 10 behind frame 9."""
    return sorted(paths, key=lambda path: [_word(one) for one in re.split(r"(\d+)", str(path))])


def _word(text: str) -> tuple[int, str]:
    return (int(text), "") if text.isdecimal() else (-1, text)


class Video:
    """A video file.

    Raises:
        UserError: It is missing, empty, no video, or its frames are too large.
    """

    camera = None

    def __init__(self, path: Path) -> None:
        self._path, self.name, self.stem = path, str(path), path.stem
        _check_container(path)
        with self._opened() as capture:
            width, height, count, rate = (
                capture.get(one)
                for one in (
                    cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT,
                    cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS,
                )
            )  # fmt: skip
        if width * height > MAX_PIXELS:
            raise _unreadable(path, f"{width:.0f}×{height:.0f} pixels")
        self.count = int(count) if 0 < count < math.inf else None
        self.rate = checked_rate(rate)

    def frames(self, stride: int = 1) -> Iterator[Frame]:
        """Yield every so manieth frame; a UserError where there is none to read.

        Where a file has fewer than its header says, a warning tells so.
        """
        number = 0
        with self._opened() as capture:
            while capture.grab():
                time = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
                if number % stride == 0:
                    decoded, image = capture.retrieve()
                    if not decoded:
                        break
                    yield Frame(as_rgb(image), self.name, number, time)
                number += 1
        if not number:
            raise _unreadable(self._path, "no frame")
        if self.count is not None and number < self.count:
            logger.warning("%s: %d of %d frames could be read", self.name, number, self.count)

    @contextmanager
    def _opened(self) -> Iterator[cv2.VideoCapture]:
        capture = open_capture(self.name, cv2.CAP_FFMPEG)
        try:
            if not capture.isOpened():
                raise _unreadable(self._path, "damaged or cut short")
            yield capture
        finally:
            capture.release()


def open_capture(source: Any, *options: Any) -> cv2.VideoCapture:
    """Open what OpenCV can, which keeps to itself what it thinks of it."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return cv2.VideoCapture(source, *options)
    finally:
        cv2.utils.logging.setLogLevel(level)


def as_rgb(image: UInt8[np.ndarray, "height width *channels"]) -> Picture:
    """Return a frame of OpenCV's, grey or BGR, as RGB."""
    code = cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(image, code))


def checked_rate(rate: float) -> float:
    """Return frames a second, those usual where a header says what cannot be."""
    return rate if 0 < rate <= HIGHEST_RATE else USUAL_RATE


def _check_container(path: Path) -> None:
    """Refuse what does not begin like a video."""
    try:
        with path.open("rb") as file:
            begin = file.read(16)
    except OSError as error:
        raise _unreadable(path, error.strerror or str(error)) from error
    if not begin:
        raise _unreadable(path, "an empty file")
    if not any(begin[at:].startswith(mark) for at, mark in _MARKS):
        raise _unreadable(path, "it does not begin like a video")


def _unreadable(path: Path, reason: str) -> UserError:
    allowed = f"a video that FFmpeg can read, up to {MAX_PIXELS / 1e6:.0f} megapixels a frame"
    fix = f"copy it again, or convert it: ffmpeg -i {path.name} video.mp4"
    return UserError(f"video {path}: {reason}", allowed, fix)
