"""Where a part's visible points find the depth they expect: a search over shifts, compiled.

A descent needs a start from which the nearest surface is the right one. A plate that lies 14 mm
away from its measured surface, or 10 mm beside it on a table, is no such start.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.rotation import Vector
from dopepp.inference.refinement.fit import Prior
from dopepp.inference.refinement.view import DepthView
from dopepp.inference.refinement.visible import Points

MOST_POINTS: Final = 400
"""Points in the search."""

ACROSS: Final = 6
"""Steps to each side, along x and y."""

REACH: Final = 2.5
"""Standard deviations of the prior that are searched along the viewing axis."""

MISSING: Final = 0.5
"""What a point without depth costs, against 1 for one that looks past the surface."""

HIDDEN: Final = 0.5
"""What a point costs that something stands before, or whose depth agrees but in part."""

PENALTY: Final = 0.03
"""Share of the points that a shift by one standard deviation of the prior must gain."""

LEAST_POINTS: Final = 20
"""Points that must find their depth."""


def best_shift(
    view: DepthView, points: Points, prior: Prior, moved: Vector, step: float, tolerance: float
) -> Vector | None:
    """Return the shift in camera axes that most points agree on; None where too few have depth.

    The points are those of the part that are visible at the present pose, in the camera frame;
    ``moved`` is how far that pose is from the prior's already, ``step`` is between neighbouring
    shifts along x and y, and ``tolerance`` is the depth by which a point may differ and still
    count, the less the more. All are metres.
    """
    chosen = np.ascontiguousarray(points[:: -(-len(points) // MOST_POINTS)])
    information = np.ascontiguousarray(prior.information[3:, 3:])
    sigma = np.sqrt(np.linalg.inv(information)[2, 2])
    half = int(np.ceil(REACH * sigma / view.noise))
    shift = np.zeros(3)
    agreeing = _search(
        view.depth, view.K, chosen, information, moved, step, view.noise, half, tolerance, shift
    )
    return shift if agreeing >= LEAST_POINTS else None


@compiled()
def _search(
    depth: Array,
    K: Array,
    points: Array,
    information: Array,
    moved: Array,
    step: float,
    bin_size: float,
    half: int,
    tolerance: float,
    best: Array,
) -> int:
    """Try every shift across and vote on the one along the axis; return the votes of the best.

    Votes fall into ``half`` bins of ``bin_size`` metres to each side of the present depth, and
    count less the farther off they are, up to ``tolerance``. ``best`` is filled with the shift,
    metres; see :func:`best_shift` for the others.
    """
    rows, columns = depth.shape
    count = points.shape[0]
    width = max(1, int(tolerance / bin_size))
    votes = np.zeros(2 * half + 1)
    highest, most = -np.inf, 0
    for a in range(-ACROSS, ACROSS + 1):
        for b in range(-ACROSS, ACROSS + 1):
            votes[:] = 0.0
            missing, beyond, counted = 0, 0, 0
            for i in range(count):
                x, y, z = points[i, 0] + a * step, points[i, 1] + b * step, points[i, 2]
                u, v = round(K[0, 0] * x / z + K[0, 2]), round(K[1, 1] * y / z + K[1, 2])
                if not (0 <= u < columns and 0 <= v < rows):
                    continue
                measured = depth[int(v), int(u)]
                if measured <= 0.0:
                    missing += 1
                    continue
                counted += 1
                place = int(np.floor((measured - z) / bin_size + 0.5)) + half
                if place > 2 * half:
                    beyond += 1
                elif place >= 0:
                    votes[place] += 1.0
            behind = float(beyond)
            for k in range(2 * half, -1, -1):
                near = votes[k]
                for w in range(1, width):
                    share = 1.0 - w / width
                    if k >= w:
                        near += share * votes[k - w]
                    if k + w <= 2 * half:
                        near += share * votes[k + w]
                if k + width <= 2 * half:
                    behind += votes[k + width]
                if near < 1.0:
                    continue
                shift = (a * step + moved[0], b * step + moved[1], (k - half) * bin_size + moved[2])
                far = 0.0
                for m in range(3):
                    for n in range(3):
                        far += shift[m] * information[m, n] * shift[n]
                hidden = max(counted - near - behind, 0.0)
                score = near - behind - HIDDEN * hidden - MISSING * missing - PENALTY * count * far
                if score > highest:
                    highest, most = score, int(near)
                    best[0], best[1] = a * step, b * step
                    best[2] = (k - half) * bin_size
    return most
