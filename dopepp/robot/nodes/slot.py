"""Slot and Pace: how a camera's images reach the worker's thread, and how fast they are answered.

A camera is faster than a network, so the latest image waits while its predecessor is processed.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final, Generic, TypeVar

import numpy as np

PATIENCE_S: Final = 5.0  # seconds to wait for the last image when the node stops
RECENT: Final = 100  # number of images over which rates and latencies are reported

Item = TypeVar("Item")


class Slot(Generic[Item]):
    """Queue of length 1 to a worker thread: a new image replaces an image that still waits.

    The thread calls ``handle`` with each image. An exception of this function ends the thread and
    is raised again by :meth:`put` and :meth:`check`.
    """

    def __init__(self, handle: Callable[[Item], None]) -> None:
        self._handle = handle
        self._item: Item | None = None
        self._fresh, self._stopped = threading.Condition(), False
        self._error: Exception | None = None
        self.replaced = 0
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def put(self, item: Item) -> None:
        """Store an image for the thread in place of a waiting image."""
        self.check()
        with self._fresh:
            self.replaced += self._item is not None
            self._item = item
            self._fresh.notify()

    def check(self) -> None:
        """Raise the exception that ended the thread, if any."""
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        """Stop the thread after its current image, for which this method waits at most 5 s."""
        with self._fresh:
            self._stopped = True
            self._fresh.notify()
        self._thread.join(PATIENCE_S)

    def _run(self) -> None:
        """Process images until :meth:`stop` is called; the thread's main function."""
        try:
            while True:
                with self._fresh:
                    self._fresh.wait_for(lambda: self._item is not None or self._stopped)
                    item, self._item = self._item, None
                    if item is None or self._stopped:
                        return
                self._handle(item)
        except Exception as error:
            self._error = error


class Pace:
    """Rate and latency of the published answers, over the last :data:`RECENT` images."""

    def __init__(self) -> None:
        self._times, self._latencies = deque[float](maxlen=RECENT), deque[float](maxlen=RECENT)
        self._answered = 0

    def count(self, latency_s: float) -> None:
        """Record an answer; ``latency_s`` is the time since its image was captured, seconds."""
        self._times.append(time.monotonic())
        self._latencies.append(1000 * latency_s)
        self._answered += 1

    def values(self) -> dict[str, str]:
        """Return the number of answers, their rate and their latency as texts by name and unit."""
        values = {"answered": str(self._answered)}
        if len(self._times) > 1:
            span = self._times[-1] - self._times[0]
            values["rate (1/s)"] = f"{(len(self._times) - 1) / max(span, 1e-9):.1f}"
        if self._latencies:
            values["latency, median (ms)"] = f"{np.median(self._latencies):.1f}"
            values["latency, 95 % (ms)"] = f"{np.percentile(self._latencies, 95):.1f}"
        return values
