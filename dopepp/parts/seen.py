"""How large, and how far away, a network has seen a part while it learned."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from dopepp.core.checks import check_range
from dopepp.core.errors import UserError


class Seen(NamedTuple):
    """What a network knows of a part's distances.

    Attributes:
        smallest_px: Smallest diameter (times focal length over depth), pixels of its input.
        largest_px: The largest one.
        nearest: Smallest depth of the cuboid's centre, metres.
        farthest: The largest one.
    """

    smallest_px: float
    largest_px: float
    nearest: float
    farthest: float

    @classmethod
    def parse(cls, values: object) -> Seen:
        """Return what a file says; a :class:`UserError` where it cannot be so."""
        if not isinstance(values, list | tuple) or len(values) != len(cls._fields):
            fix = "write the file with train.py"
            raise UserError(f"seen sizes {values!r:.100}", ", ".join(cls._fields), fix)
        check_range("sizes of a part", tuple(values[:2]), 0.1, 1e5, "pixels")
        check_range("distances of a part", tuple(values[2:]), 1e-4, 1e4, "metres")
        return cls(*map(float, values))


def widest(seen: Sequence[Seen]) -> Seen:
    """Return the range of all single views."""
    smallest, largest, nearest, farthest = zip(*seen, strict=True)
    return Seen(min(smallest), max(largest), min(nearest), max(farthest))
