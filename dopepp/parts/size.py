"""How large a part is, and how large and how far away a network has seen it.

The log describes each mesh, so that a wrong unit or a stray body is seen before a training.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import scipy  # its parts load when they are used
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.core.validation import Span, check
from dopepp.geometry.rotation import Vector
from dopepp.parts.mesh import Faces, Vertices, weld
from dopepp.parts.part import Part

_PLAUSIBLE: Final = (0.01, 2.0)  # Diameters that a hand or a robot's gripper holds, metres
_LISTED: Final = 3  # Most bodies whose sizes the log lists
_MANY_CAVITIES: Final = 1000
"""More surfaces than a part's cavities have: what else faces inwards counts as a body."""


def is_plausible(part: Part) -> bool:
    """Return whether a part has the size of something that is held and grasped: 1 cm to 2 m."""
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


def body_extents(vertices: Vertices, faces: Faces) -> list[Float[np.ndarray, "3"]]:
    """Return the sides of the box of each separate body, the largest body first.

    A body is a connected surface (corners at one position are one) that bounds no cavity: one that
    faces inwards and lies in another one's box is no body.
    """
    positions, corners = weld(vertices, faces)
    start, end = corners.reshape(-1), corners[:, [1, 2, 0]].reshape(-1)
    joined = scipy.sparse.coo_array(
        (np.ones(len(start), bool), (start, end)), shape=(len(positions),) * 2
    )
    count, of_vertex = scipy.sparse.csgraph.connected_components(joined, directed=False)
    if count == 1:
        return [np.ptp(positions, axis=0)]
    lower, upper = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(lower, of_vertex, positions)
    np.maximum.at(upper, of_vertex, positions)
    bodies = of_vertex[corners[:, 0]]
    # From its own middle, so that an open surface's sign is its own as well.
    a, b, c = (positions[corners] - ((lower + upper) / 2)[bodies][:, None]).swapaxes(0, 1)
    volumes = np.bincount(bodies, np.einsum("ij,ij->i", a, np.cross(b, c)), minlength=count)
    is_body = np.ones(count, bool)
    for body in np.flatnonzero(volumes < 0)[:_MANY_CAVITIES]:
        around = (lower < lower[body]).all(axis=1) & (upper > upper[body]).all(axis=1)
        is_body[body] = not around.any()
    extents = (upper - lower)[is_body]
    return list(extents[np.argsort(-extents.prod(axis=1), kind="stable")])


class Seen(NamedTuple):
    """Range of the views of a part that a network has learned.

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
        """Validate the four numbers of a file.

        Raises:
            UserError: They are not four numbers, or out of range.
        """
        if not isinstance(values, list | tuple) or len(values) != len(cls._fields):
            fix = "write the file with train.py"
            raise UserError(f"seen sizes {values!r:.100}", ", ".join(cls._fields), fix)
        sizes = check("sizes of a part", values[:2], tuple[float, float], Span(0.1, 1e5, "pixels"))
        depths = check(
            "distances of a part", values[2:], tuple[float, float], Span(1e-4, 1e4, "metres")
        )
        return cls(*sizes, *depths)


def widest(ranges: Sequence[Seen]) -> Seen:
    """Return the smallest range that contains all given ones."""
    smallest, largest, nearest, farthest = zip(*ranges, strict=True)
    return Seen(min(smallest), max(largest), min(nearest), max(farthest))
