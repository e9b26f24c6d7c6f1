"""Views of a video or a camera that add something to a calibration."""

from __future__ import annotations

from typing import Final

import numpy as np

from dopepp.robot.calibration.board import MIN_POINTS, Sighting

APART: Final = 0.04
"""Mean shift of a board's points between two views that differ, share of the picture's width."""

MAX_VIEWS: Final = 60

LOOKS_PER_S: Final = 5.0
"""How often a video is looked at."""


class Views:
    """Keeps the views that differ; of those that do not, the one in which the board moved least.

    So a video is worth its pauses: what is blurred by motion gives way to what is not.
    """

    def __init__(self, width: int) -> None:
        self.kept: list[Sighting] = []
        self._limit = APART * width
        self._motions: list[float] = []
        self._last: Sighting | None = None

    def offer(self, sighting: Sighting) -> bool:
        """Take the next sighting; tell whether it is a new view."""
        motion = np.inf if self._last is None else _shift(self._last, sighting)
        self._last = sighting
        shifts = [_shift(one, sighting) for one in self.kept]
        nearest = int(np.argmin(shifts)) if shifts else 0
        if not shifts or shifts[nearest] > self._limit:
            self.kept.append(sighting)
            self._motions.append(motion)
            return True
        if motion < self._motions[nearest]:
            self.kept[nearest], self._motions[nearest] = sighting, motion
        return False

    @property
    def is_full(self) -> bool:
        """Whether more views would cost time only."""
        return len(self.kept) >= MAX_VIEWS


def _shift(one: Sighting, other: Sighting) -> float:
    """Return the mean distance between the points that both show, pixels; infinite if too few."""
    same = (one.points[:, None] == other.points[None]).all(axis=2)
    first, second = np.nonzero(same)
    if len(first) < MIN_POINTS:
        return np.inf
    return float(np.linalg.norm(one.pixels[first] - other.pixels[second], axis=1).mean())
