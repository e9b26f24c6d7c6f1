"""Frames read by OpenCV: image files, video files, cameras and network streams.

OpenCV and camera drivers buffer frames, so a slow reader falls behind the camera. :class:`Live`
therefore reads in a thread and keeps the newest frame only. A frame's age at the start of its
processing is at most the camera's frame interval.
"""

from __future__ import annotations

import contextlib
import logging
import math
import re
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import UInt8

from dopepp.core.errors import RunError, UserError
from dopepp.drawing.pictures import MAX_PIXELS, USUAL_RATE, RGBImage, read_photo
from dopepp.inference.frames.ros import BAGS, is_bag_folder
from dopepp.inference.frames.source import CameraFrame, FrameSource

# Suffixes of image files in a folder; a file whose path is given may have any suffix.
SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
VIDEOS: Final = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".ts")
HIGHEST_RATE: Final = 1000.0  # frames per second

# FFmpeg also opens playlists, which refer to other files, so the container is checked first.
_VIDEO_HEADER: Final = re.compile(
    rb".{4}(ftyp|moov|mdat|wide|free)|RIFF|\x1aE\xdf\xa3|\x00\x00\x01[\xba\xb3]|G", re.DOTALL
)

SCHEMES: Final = ("rtsp", "rtsps", "http", "https")
FIRST_S: Final = 15.0  # timeout of the first frame: a stream starts at the next key frame
STALLED_S: Final = 5.0  # seconds without a frame after which a camera counts as disconnected
_RETRY_S: Final = 0.02  # seconds between two reads of a camera that has no frame

logger = logging.getLogger(__name__)


class Images(FrameSource):
    """Frame source of image files, in the order of ``paths``."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = paths
        self.name, self.stem, self.count = str(paths[0]), paths[0].stem, len(paths)
        numbers = [int(path.stem) if path.stem.isdecimal() else -1 for path in paths]
        are_unique = min(numbers) >= 0 and len(set(numbers)) == len(numbers)
        self._numbers = numbers if are_unique else range(len(paths))

    def frames(self, stride: int = 1) -> Iterator[CameraFrame]:
        """Yield every ``stride``-th image.

        Raises:
            UserError: An image is damaged.
        """
        for number, path in list(zip(self._numbers, self.paths, strict=True))[::stride]:
            yield CameraFrame(read_photo(path), str(path), number)


def list_images(path: Path) -> list[Path] | None:
    """Return the images of a folder, or the path of an image; None for a video or recording.

    Raises:
        UserError: A folder contains no images.
    """
    if not path.is_dir():
        return None if path.suffix.lower() in (*VIDEOS, *BAGS) else [path]
    if is_bag_folder(path):
        return None
    images = sort_paths(child for child in path.iterdir() if child.suffix.lower() in SUFFIXES)
    if not images:
        allowed = f"a folder with images ({', '.join(SUFFIXES)})"
        fix = "pass the folder that holds the images"
        raise UserError(f"{path} without an image", allowed, fix)
    return images


def sort_paths(paths: Iterable[Path]) -> list[Path]:
    """Sort paths in natural order: frame 10 after frame 9."""

    def natural_key(path: Path) -> list[tuple[int, str]]:
        words = re.split(r"(\d+)", str(path))
        return [(int(word), "") if word.isdecimal() else (-1, word) for word in words]

    return sorted(paths, key=natural_key)


class Video(FrameSource):
    """Frame source of a video file.

    Raises:
        UserError: The file is missing, empty or no video, or its frames are too large.
    """

    def __init__(self, path: Path) -> None:
        self._path, self.name, self.stem = path, str(path), path.stem
        self.paths = (path,)
        try:
            with path.open("rb") as file:
                header = file.read(16)
        except OSError as error:
            raise _unreadable(path, error.strerror or str(error)) from error
        if not _VIDEO_HEADER.match(header):
            reason = "it does not begin like a video" if header else "an empty file"
            raise _unreadable(path, reason)
        with self._opened() as capture:
            width = capture.get(cv2.CAP_PROP_FRAME_WIDTH)
            height = capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
            count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
            self.rate = _plausible_rate(capture.get(cv2.CAP_PROP_FPS))
        if width * height > MAX_PIXELS:
            raise _unreadable(path, f"{width:.0f}×{height:.0f} pixels")
        self.count = int(count) if 0 < count < math.inf else None

    def frames(self, stride: int = 1) -> Iterator[CameraFrame]:
        """Yield every ``stride``-th frame; warn about frames missing at the end.

        Raises:
            UserError: No frame can be read.
        """
        number = 0
        with self._opened() as capture:
            while capture.grab():
                seconds = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
                if number % stride == 0:
                    decoded, image = capture.retrieve()
                    if not decoded:
                        break
                    yield CameraFrame(_as_rgb(image), self.name, number, seconds)
                number += 1
        if not number:
            raise _unreadable(self._path, "no frame")
        if self.count is not None and number < self.count:
            logger.warning("%s: %d of %d frames could be read", self.name, number, self.count)

    @contextlib.contextmanager
    def _opened(self) -> Iterator[cv2.VideoCapture]:
        capture = _open_capture(self.name, cv2.CAP_FFMPEG)
        try:
            if not capture.isOpened():
                raise _unreadable(self._path, "damaged or cut short")
            yield capture
        finally:
            capture.release()


def _unreadable(path: Path, reason: str) -> UserError:
    allowed = f"a video that FFmpeg can read, up to {MAX_PIXELS / 1e6:.0f} megapixels a frame"
    fix = f"copy it again, or convert it: ffmpeg -i {path.name} video.mp4"
    return UserError(f"video {path}: {reason}", allowed, fix)


class Live(FrameSource):
    """Frame source of a camera (number or device path) or a network stream (URL)."""

    is_live = True

    def __init__(self, address: int | str) -> None:
        self._address = address
        self.name = f"camera {address}" if isinstance(address, int) else _without_login(address)
        self.stem = re.sub(r"[^\w.]+", "_", self.name).strip("_")
        self.rate = _plausible_rate(0.0)

    def frames(self, stride: int = 1) -> Iterator[CameraFrame]:
        """Yield the newest frame at every ``stride``-th request, without end.

        Raises:
            UserError: The camera or stream cannot be opened.
            RunError: The camera has stopped delivering frames.
        """
        capture = _open_live(self._address)
        if not capture.isOpened():
            allowed = "the address of a stream"
            fix = "test the address with another player, e.g. ffplay"
            if isinstance(self._address, int):
                allowed = "the number of a connected camera"
                fix = "close other programs that use it, or try camera 0 or 1"
            raise UserError(f"{self.name}, which cannot be opened", allowed, fix)
        self.rate = _plausible_rate(capture.get(cv2.CAP_PROP_FPS))
        reader = _NewestFrame(capture, self.name)
        timeout, num_requests = FIRST_S, 0
        try:
            while True:
                frame = reader.wait(timeout)
                if frame is None:
                    since = "" if num_requests else " since it was opened"
                    reason = f"{self.name}: no image for {timeout:g} s{since}"
                    raise RunError(f"{reason}; check its cable or network")
                if num_requests % stride == 0:
                    yield frame
                timeout, num_requests = STALLED_S, num_requests + 1
        finally:
            reader.stop()


class _NewestFrame:
    """Reads a ``cv2.VideoCapture`` in a thread and keeps the newest frame."""

    def __init__(self, capture: Any, name: str) -> None:
        self._capture, self._name = capture, name
        self._newest: tuple[Any, int, float] | None = None
        self._fresh, self._stopped = threading.Condition(), threading.Event()
        # A thread that hangs in a driver must not keep the process alive.
        threading.Thread(target=self._read, daemon=True).start()

    def wait(self, timeout_s: float) -> CameraFrame | None:
        """Return the newest frame that was not returned before; None after the timeout."""
        with self._fresh:
            self._fresh.wait_for(lambda: self._newest is not None, timeout_s)
            newest, self._newest = self._newest, None
        if newest is None:
            return None
        image, number, seconds = newest
        return CameraFrame(_as_rgb(image), self._name, number, seconds)

    def stop(self) -> None:
        """End the thread, which also closes the camera: only the reading thread may do so."""
        self._stopped.set()

    def _read(self) -> None:
        """Read images until :meth:`stop`, and keep the newest; runs in the thread."""
        number = 0
        while not self._stopped.is_set():
            delivered, image = False, None
            with contextlib.suppress(cv2.error):
                delivered, image = self._capture.read()
            if not delivered:
                self._stopped.wait(_RETRY_S)
                continue
            with self._fresh:
                self._newest = (image, number, time.time())
                self._fresh.notify()
            number += 1
        self._capture.release()


def is_url(text: str) -> bool:
    """Return whether a text is the URL of a stream.

    Raises:
        UserError: The URL has another scheme than :data:`SCHEMES`.
    """
    scheme = re.match(r"([A-Za-z][A-Za-z0-9+.-]*)://", text)
    if scheme is None:
        return False
    if scheme[1].lower() not in SCHEMES:
        allowed = ", ".join(f"{name}://" for name in SCHEMES)
        fix = "write an address that begins with one of these, or pass a file"
        raise UserError(f"address {_without_login(text)}", allowed, fix)
    return True


def _open_live(address: int | str) -> cv2.VideoCapture:
    """Open a camera or a stream, with timeouts for a stream."""
    if isinstance(address, int) or not is_url(address):
        return _open_capture(address)
    timeouts = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, int(1000 * FIRST_S)]
    timeouts += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, int(1000 * STALLED_S)]
    return _open_capture(address, cv2.CAP_FFMPEG, timeouts)


def _open_capture(source: Any, *options: Any) -> cv2.VideoCapture:
    """Open a capture without OpenCV's own log lines."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return cv2.VideoCapture(source, *options)
    finally:
        cv2.utils.logging.setLogLevel(level)


def _as_rgb(image: UInt8[np.ndarray, "height width *channels"]) -> RGBImage:
    """Convert a grey or BGR frame of OpenCV to RGB."""
    code = cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(image, code))


def _plausible_rate(rate: float) -> float:
    """Return a header's frames per second, or ``USUAL_RATE`` outside (0, ``HIGHEST_RATE``]."""
    return rate if 0 < rate <= HIGHEST_RATE else USUAL_RATE


def _without_login(url: str) -> str:
    """Return a URL without user name, password, query and fragment, which may hold a token."""
    return re.split(r"[?#]", re.sub(r"//[^/]*@", "//", url))[0]
