"""What a part is in words, so that a wrong unit or a stray body is seen before a training."""

from __future__ import annotations

from typing import Final

import numpy as np

from dopepp.geometry.rotation import Vector
from dopepp.parts.mesh.measure import body_extents
from dopepp.parts.part import Part

_PLAUSIBLE: Final = (0.01, 2.0)
"""Diameters that a hand or a robot's gripper holds, metres."""

_LISTED: Final = 3
"""Bodies whose sizes are told, at most."""


def is_plausible(part: Part) -> bool:
    """Tell whether a part has the size of something that is held and grasped: 1 cm to 2 m."""
    return _PLAUSIBLE[0] <= part.diameter <= _PLAUSIBLE[1]


def size_in_words(extents: Vector) -> str:
    """Return the sides of a box (metres) as ``62 × 40 × 31 mm``, the longest first."""
    sides = 1000 * np.sort(extents)[::-1]
    return " × ".join(f"{side:.0f}" if side >= 9.95 else f"{side:.1f}" for side in sides) + " mm"


def part_in_words(part: Part) -> str:
    """Return a part's name and size, the unit of its file, and its bodies where it has several."""
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
        words += f"; {len(bodies)} bodies ({listed}), which are rendered and found as one part"
    return words
