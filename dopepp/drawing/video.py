"""VideoFile: a video that is written picture by picture, and playable however its writing ends."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from types import TracebackType
from typing import Final

import cv2
import numpy as np

from dopepp.core.errors import RunError
from dopepp.core.files import partial_path
from dopepp.drawing.pictures import Picture

# OpenCV asks once, before its first video, whether FFmpeg may write to the terminal.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

LEAST_FREE: Final = 16_000_000
"""Bytes left on the disk below which no picture is added: what ends a file must still fit."""

USUAL_RATE: Final = 25.0
"""Frames a second where a file or a camera does not say."""

LONGEST_GAP_S: Final = 2.0
"""Seconds for which a picture stands still where the next is late."""


class VideoFile:
    """An MP4 file (MPEG-4 part 2), written beside its place and renamed when it is closed.

    Pictures are repeated, or left out, so that they stand where their times say. All have the size
    of the first; of an odd side the last row or column is repeated once, as the format needs.

    Args:
        path: Where it will be, with the suffix ``.mp4``.
        rate: Frames a second.
    """

    def __init__(self, path: Path, rate: float) -> None:
        self.path, self._rate = path, rate
        partial = partial_path(path)
        self._partial = partial.with_name(partial.name + path.suffix)
        self._writer: cv2.VideoWriter | None = None
        self._size = (0, 0)
        self._start = 0.0
        self._written = 0

    def write(self, picture: Picture, time: float) -> None:
        """Add a picture taken at a time, seconds; a RunError: the disk is full."""
        even = np.pad(
            picture, ((0, picture.shape[0] % 2), (0, picture.shape[1] % 2), (0, 0)), "edge"
        )
        if self._writer is None:
            self._size, self._start = (even.shape[1], even.shape[0]), time
            code = cv2.VideoWriter.fourcc(*"mp4v")
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = cv2.VideoWriter(
                str(self._partial), cv2.CAP_FFMPEG, code, self._rate, self._size
            )
            if not self._writer.isOpened():
                raise RunError(f"{self.path}: this OpenCV cannot write MP4 videos")
        if (even.shape[1], even.shape[0]) != self._size:
            even = np.asarray(cv2.resize(even, self._size, interpolation=cv2.INTER_AREA))
        until = round((time - self._start) * self._rate) + 1
        until = min(until, self._written + max(1, round(LONGEST_GAP_S * self._rate)))
        if self._written < until and shutil.disk_usage(self.path.parent).free < LEAST_FREE:
            raise RunError(f"no space left for {self.path}: free some")
        frame = cv2.cvtColor(even, cv2.COLOR_RGB2BGR)
        while self._written < until:
            self._writer.write(frame)
            self._written += 1

    def close(self) -> None:
        """Complete the file; a RunError where not all that was written is there."""
        if self._writer is None:
            return
        self._writer.release()
        self._writer = None
        there = 0
        if self._written:
            reader = cv2.VideoCapture(str(self._partial), cv2.CAP_FFMPEG)
            there = int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
            reader.release()
        if there:
            self._partial.replace(self.path)
        self._partial.unlink(missing_ok=True)
        if there < self._written:
            raise RunError(f"{self.path}: {there} of {self._written} frames are there: disk full?")

    def __enter__(self) -> VideoFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self.close()
