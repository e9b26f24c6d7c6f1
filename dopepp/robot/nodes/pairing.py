"""Pairing of the images of several cameras by their stamps (approximate time synchronisation)."""

from __future__ import annotations

from bisect import insort
from collections.abc import Sequence
from typing import Final, Generic, TypeVar

MAX_LAG_S: Final = 1 / 60  # default of the largest lag, seconds: half a frame period at 30 Hz
WAITING: Final = 10  # images of a camera that wait for those of the others
RESTART_S: Final = 1.0  # decrease of a camera's stamps, seconds, after which pairing starts anew

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
