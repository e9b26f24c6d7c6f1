"""How images reach the worker's thread: pairing by stamps, a slot for the latest set, and its pace.

:class:`StampPairing` is an approximate time synchronisation of several cameras. A camera is faster
than a network, so the latest image waits in a :class:`Slot` while its predecessor is processed.
"""

from __future__ import annotations

import threading
import time
from bisect import insort
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final, Generic, TypeVar

import numpy as np

MAX_LAG_S: Final = 1 / 60  # default of the largest lag, seconds: half a frame period at 30 Hz
WAITING: Final = 10  # images of a camera that wait for those of the others
RESTART_S: Final = 1.0  # decrease of a camera's stamps, seconds, after which pairing starts anew
PATIENCE_S: Final = 5.0  # seconds to wait for the last image when the node stops
RECENT: Final = 100  # number of images over which rates and latencies are reported

Item = TypeVar("Item")


class StampPairing(Generic[Item]):
    """Pairs images of several cameras into sets with nearly equal stamps, seconds.

    A set is complete as soon as the stamps of one image of each camera differ by at most
    ``max_lag_s``. If ``max_lag_s`` is at most half of every camera's frame period, these images are
    nearest to each other. Each image is in one set at most, and the stamps of sets increase.
    """

    def __init__(self, num_cameras: int, max_lag_s: float = MAX_LAG_S) -> None:
        self.max_lag_s = max_lag_s
        self.lag_s: float | None = None
        """Difference of the stamps in the last set, or of the last images that were not paired."""
        self.num_sets = 0
        self._waiting: list[list[tuple[float, Item]]] = [[] for _ in range(num_cameras)]
        self._unpaired = [0] * num_cameras
        self._last = -float("inf")  # latest stamp in the last set
        self._dropped_before = 0  # sets that were dropped before the last set

    @property
    def dropped_in_a_row(self) -> int:
        """Number of sets that were dropped since the last complete set."""
        return self.dropped - self._dropped_before

    @property
    def dropped(self) -> int:
        """Number of sets that were dropped because of their lag.

        An image of every camera is dropped with a set. A faster camera has further images without
        partners, which do not count.
        """
        return min(self._unpaired)

    def add(self, camera: int, stamp: float, item: Item) -> Sequence[Item] | None:
        """Add an image of camera number ``camera``; return the set that it completes, if any."""
        waiting = self._waiting[camera]
        newest = waiting[-1][0] if waiting else self._last
        if stamp < newest - RESTART_S:  # a restarted recording or simulation
            self._waiting = [[] for _ in self._waiting]
            self._last = -float("inf")
        elif stamp <= self._last:
            self._unpaired[camera] += 1
            return None
        insort(self._waiting[camera], (stamp, item), key=lambda image: image[0])
        del self._waiting[camera][:-WAITING]  # the other cameras are silent or slower
        return self._complete_set()

    def _complete_set(self) -> list[Item] | None:
        """Return the first set within the largest lag; drop the images before it."""
        while all(self._waiting):
            heads = [waiting[0][0] for waiting in self._waiting]
            self.lag_s = max(heads) - min(heads)
            if self.lag_s > self.max_lag_s:
                oldest = heads.index(min(heads))
                self._waiting[oldest].pop(0)
                self._unpaired[oldest] += 1
                continue
            self.num_sets, self._last = self.num_sets + 1, max(heads)
            complete = [waiting[0][1] for waiting in self._waiting]
            for number, waiting in enumerate(self._waiting):
                later = [image for image in waiting[1:] if image[0] > self._last]
                self._unpaired[number] += len(waiting) - 1 - len(later)
                self._waiting[number] = later
            self._dropped_before = self.dropped
            return complete
        return None


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
