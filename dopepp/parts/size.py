"""Sizes of parts in words, and the range of sizes and distances that a network has learned."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from dopepp.core.validation import Range, Span, check
from dopepp.geometry.rotation import Vector
from dopepp.parts.mesh.read import body_extents
from dopepp.parts.part import Part

_PLAUSIBLE: Final = (0.01, 2.0)  # Diameters of parts that a gripper can hold, metres
_SIZES: Final = (0.1, 1e5)  # Limits of a learned size, pixels
_DEPTHS: Final = (1e-4, 1e4)  # Limits of a learned distance, metres
_LISTED: Final = 3  # Most bodies whose sizes the log lists


def is_plausible(part: Part) -> bool:
    """Return whether the diameter of a part is between 1 cm and 2 m."""
    return _PLAUSIBLE[0] <= part.diameter <= _PLAUSIBLE[1]


def size_in_words(extents: Vector) -> str:
    """Format the sides of a box (metres) as ``62 × 40 × 31 mm``, the longest first."""
    sides = 1000 * np.sort(extents)[::-1]
    return " × ".join(f"{side:.0f}" if side >= 9.95 else f"{side:.1f}" for side in sides) + " mm"


def part_in_words(part: Part) -> str:
    """Describe a part in one line: name, size, unit of the file, and separate bodies if several."""
    words = f"{part.name}: {size_in_words(np.ptp(part.cuboid, axis=0))}"
    if part.unit:
        words += f", read in {part.unit}"
    if not is_plausible(part):
        low, high = _PLAUSIBLE
        words += f" (unlikely: most parts measure {low:g} – {high:g} m; is the unit right?)"
    bodies = [] if part.mesh is None else body_extents(part.mesh.vertices, part.mesh.faces)
    if len(bodies) > 1:
        sizes = [size_in_words(body) for body in bodies]
        listed = ", ".join(sizes) if len(sizes) <= _LISTED else f"the largest {sizes[0]}"
        words += f"; {len(bodies)} bodies ({listed}), which are rendered and detected as one part"
    return words


class LearnedRange(NamedTuple):
    """Range of sizes and distances of a part that a network has learned.

    Attributes:
        smallest_px: Smallest size (diameter × focal length / depth), network input pixels.
        largest_px: Largest size, network input pixels.
        nearest: Smallest depth of the cuboid's centre, metres.
        farthest: Largest depth of the cuboid's centre, metres.
    """

    smallest_px: float
    largest_px: float
    nearest: float
    farthest: float

    @classmethod
    def parse(cls, values: object) -> LearnedRange:
        """Convert a list of the four values in a checkpoint.

        Raises:
            UserError: The value is not a list of four numbers within their limits.
        """
        limits = "the learned range of sizes"
        four = check(limits, values, tuple[float, float, float, float], Range(1e-4, 1e5))
        sizes = check("sizes of a part", four[:2], tuple[float, float], Span(*_SIZES, "pixels"))
        depths = check("distances of a part", four[2:], tuple[float, float], Span(*_DEPTHS, "m"))
        return cls(*sizes, *depths)

    @classmethod
    def of(cls, pixels: float, depth: float) -> LearnedRange:
        """Return the range of a single view, within the limits of :meth:`parse`."""
        size, distance = float(np.clip(pixels, *_SIZES)), float(np.clip(depth, *_DEPTHS))
        return cls(size, size, distance, distance)


def enclosing_range(ranges: Sequence[LearnedRange]) -> LearnedRange:
    """Return the smallest range that contains all ranges."""
    smallest, largest, nearest, farthest = zip(*ranges, strict=True)
    return LearnedRange(min(smallest), max(largest), min(nearest), max(farthest))
