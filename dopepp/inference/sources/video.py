"""Video files, read by OpenCV's FFmpeg: every frame, or every so manieth."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import UInt8

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import MAX_PIXELS, Picture
from dopepp.drawing.video import USUAL_RATE
from dopepp.inference.sources.frame import Frame

VIDEOS: Final = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".ts")

HIGHEST_RATE: Final = 1000.0

_MARKS: Final = (
    (4, b"ftyp"), (4, b"moov"), (4, b"mdat"), (4, b"wide"), (4, b"free"), (0, b"RIFF"),
    (0, b"\x1aE\xdf\xa3"), (0, b"\x00\x00\x01\xba"), (0, b"\x00\x00\x01\xb3"), (0, b"G"),
)  # fmt: skip
"""What a video begins with, and where: FFmpeg would open playlists, which name other files."""

logger = logging.getLogger(__name__)


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
