"""Cameras and streams, of which the newest picture alone counts.

OpenCV and the camera's driver keep pictures that nobody has fetched, so whoever reads slower than
the camera delivers looks ever further back. Here a thread of its own reads all the time and keeps
the newest, so a picture is never older than the camera's interval when its turn comes.
"""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple, Protocol
from urllib.parse import urlsplit

import cv2

from dopepp.core.errors import RunError, UserError
from dopepp.inference.sources.files import as_rgb, checked_rate, open_capture
from dopepp.inference.sources.source import Frame

SCHEMES: Final = ("rtsp", "rtsps", "http", "https")

FIRST_S: Final = 15.0
"""Seconds until a camera's first picture: streams begin with a key frame, which may be far off."""

STALLED_S: Final = 5.0  # seconds without a picture after which a camera is taken to be gone
_RETRY_S: Final = 0.02  # seconds between two questions to a camera that has nothing


class Capture(Protocol):
    """What is used of ``cv2.VideoCapture``."""

    def isOpened(self) -> bool: ...  # noqa: N802, D102

    def read(self) -> tuple[bool, Any]: ...  # noqa: D102

    def get(self, what: int) -> float: ...  # noqa: D102

    def release(self) -> None: ...  # noqa: D102


class _Newest(NamedTuple):
    image: Any
    number: int
    time: float


class Live:
    """A camera by its number or device, or a stream by its URL.

    Args:
        address: The one or the other.
        opened: Opens it.
        clock: Seconds since 1970.
        first_s: How long to wait for the first picture, seconds.
        stalled_s: Idem for each further one.
    """

    count = None
    camera = None

    def __init__(
        self,
        address: int | str,
        opened: Callable[[int | str], Capture] | None = None,
        clock: Callable[[], float] = time.time,
        first_s: float = FIRST_S,
        stalled_s: float = STALLED_S,
    ) -> None:
        self._address, self._opened, self._clock = address, opened or _open, clock
        self._waits = first_s, stalled_s
        self.name = f"camera {address}" if isinstance(address, int) else _public(address)
        self.stem = re.sub(r"[^\w.]+", "_", self.name.partition("?")[0]).strip("_")
        self.rate = checked_rate(0.0)

    def frames(self, stride: int = 1) -> Iterator[Frame]:
        """Yield the newest picture each time, for ever; every so manieth of those asked for.

        Raises:
            UserError: There is no such camera.
            RunError: It has stopped delivering pictures.
        """
        reader = _Reader(self._capture(), self._clock)
        wait, asked = self._waits[0], 0
        try:
            while True:
                newest = reader.newest(wait)
                if newest is None:
                    since = "" if asked else " since it was opened"
                    raise RunError(f"{self.name}: no picture for {wait:g} s{since}")
                if asked % stride == 0:
                    yield Frame(as_rgb(newest.image), self.name, newest.number, newest.time)
                wait, asked = self._waits[1], asked + 1
        finally:
            reader.stop()

    def _capture(self) -> Capture:
        capture = self._opened(self._address)
        if not capture.isOpened():
            number = isinstance(self._address, int)
            raise UserError(
                f"{self.name}, which does not open",
                "the number of a connected camera" if number else "the address of a stream",
                "see whether another program shows it, and whether one has it open",
            )
        self.rate = checked_rate(capture.get(cv2.CAP_PROP_FPS))
        return capture


class _Reader:
    """A thread that reads a capture all the time, and keeps the newest picture."""

    def __init__(self, capture: Capture, clock: Callable[[], float]) -> None:
        self._capture, self._clock = capture, clock
        self._newest: _Newest | None = None
        self._fresh, self._stopped = threading.Condition(), threading.Event()
        # One that hangs in a driver must not keep the process from ending.
        threading.Thread(target=self._read, daemon=True).start()

    def newest(self, wait_s: float) -> _Newest | None:
        """Return the newest picture that has not been returned yet; None if there is none."""
        with self._fresh:
            self._fresh.wait_for(lambda: self._newest is not None, wait_s)
            newest, self._newest = self._newest, None
            return newest

    def stop(self) -> None:
        """Let the thread end and close the camera, which another thread must not do for it."""
        self._stopped.set()

    def _read(self) -> None:
        number = 0
        while not self._stopped.is_set():
            delivered, image = False, None
            with contextlib.suppress(cv2.error):
                delivered, image = self._capture.read()
            if not delivered:
                self._stopped.wait(_RETRY_S)
                continue
            with self._fresh:
                self._newest = _Newest(image, number, self._clock())
                self._fresh.notify()
            number += 1
        self._capture.release()


def is_url(text: str) -> bool:
    """Tell a URL from a path; a UserError where it is of another kind than a camera's."""
    scheme = re.match(r"([A-Za-z][A-Za-z0-9+.-]*)://", text)
    if scheme is None:
        return False
    if scheme[1].lower() not in SCHEMES:
        allowed = ", ".join(f"{one}://" for one in SCHEMES)
        raise UserError(f"address {_public(text)}", allowed, "use one of these, or a file")
    return True


def _open(address: int | str) -> Capture:
    if isinstance(address, int) or not is_url(address):
        return open_capture(address)
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, int(1000 * FIRST_S)]
    limits += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, int(1000 * STALLED_S)]
    return open_capture(address, cv2.CAP_FFMPEG, limits)


def _public(url: str) -> str:
    """Return a URL without its user's name and password."""
    host = urlsplit(url).netloc
    return url.replace(host, host.rpartition("@")[2], 1) if host else url
