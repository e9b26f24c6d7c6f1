"""The nearest points of one object at two poses, by one tree for all poses.

The tree splits the object's points in halves down to small leaves and keeps them in the order of
the leaves. Queries come in the same order, so the answer to one is a close guess at the next, and
most of the tree is never looked at.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.core.compiled import Array, compiled

_LEAF: Final = 16
"""Most points of a leaf: fastest of 4, 8, 16 and 32 at 2,000 and 10,000 points."""

_ROUNDING: Final = 1e-9
"""Share by which a bound is lowered, so that rounding never hides the nearest point."""


class NearestPoints:
    """Finds nearest points (metres) between an object and itself at another pose; exact."""

    def __init__(self, points: Float[np.ndarray, "v 3"]) -> None:
        depth = max(math.ceil(math.log2(len(points) / _LEAF)), 0)
        order = np.arange(len(points))
        self._firsts = np.linspace(0, len(points), 2**depth + 1).astype(np.int64)
        self._boxes = np.empty((2 ** (depth + 1) - 1, 6))
        for level in range(depth + 1):
            step = 2 ** (depth - level)
            for k in range(2**level):
                node = order[self._firsts[k * step] : self._firsts[(k + 1) * step]]
                own = points[node]
                low, high = own.min(axis=0), own.max(axis=0)
                self._boxes[2**level - 1 + k] = *low, *high
                if level < depth:
                    middle = self._firsts[k * step + step // 2] - self._firsts[k * step]
                    node[:] = node[own[:, (high - low).argmax()].argpartition(middle)]
        self._points = np.ascontiguousarray(points[order])

    def mean_distances(
        self,
        R_est: Float[np.ndarray, "n 3 3"],
        R_gt: Float[np.ndarray, "n 3 3"],
        offset: Float[np.ndarray, "n 3"],
    ) -> Float[np.ndarray, "n"]:
        """Return the mean distance from the true points to their nearest estimated ones, metres.

        ``offset`` is the true minus the estimated translation, metres. The formula holds for any
        matrix, not rotations alone.
        """
        distances = np.empty(len(offset))
        # ‖R_est v‖ ≥ s ‖v‖ with the smallest singular value s: 1 for a rotation.
        least = np.linalg.svd(R_est, compute_uv=False)[:, 2]
        targets = np.empty_like(self._points)
        for n in range(len(offset)):
            _place(self._points, np.ascontiguousarray(R_gt[n]), offset[n], targets)
            # A flat matrix cannot be undone; with the bound 0 every point is looked at.
            inverse = np.linalg.inv(R_est[n]) if least[n] > 0 else np.zeros((3, 3))
            bound = least[n] ** 2 * (1 - _ROUNDING)
            distances[n] = _mean_distance(
                self._points,
                self._boxes,
                self._firsts,
                np.ascontiguousarray(R_est[n]),
                targets,
                targets @ inverse.T,
                bound,
            )
        return distances


@compiled()
def _place(points: Array, R: Array, offset: Array, out: Array) -> None:
    """Write R·x + offset of every point, with the rounding of :func:`_squared`."""
    for i in range(len(points)):
        for r in range(3):
            out[i, r] = (
                R[r, 0] * points[i, 0] + R[r, 1] * points[i, 1] + R[r, 2] * points[i, 2] + offset[r]
            )


@compiled(inline="always")
def _squared(point: Array, R: Array, target: Array) -> float:
    dx = R[0, 0] * point[0] + R[0, 1] * point[1] + R[0, 2] * point[2] - target[0]
    dy = R[1, 0] * point[0] + R[1, 1] * point[1] + R[1, 2] * point[2] - target[1]
    dz = R[2, 0] * point[0] + R[2, 1] * point[1] + R[2, 2] * point[2] - target[2]
    return float(dx * dx + dy * dy + dz * dz)


@compiled(inline="always")
def _to_box(box: Array, x: float, y: float, z: float) -> float:
    """Return the squared distance to a box of (least x, y, z, largest x, y, z); 0 inside."""
    dx = max(box[0] - x, x - box[3], 0.0)
    dy = max(box[1] - y, y - box[4], 0.0)
    dz = max(box[2] - z, z - box[5], 0.0)
    return float(dx * dx + dy * dy + dz * dz)


@compiled()
def _mean_distance(
    points: Array,
    boxes: Array,
    firsts: Array,
    R: Array,
    targets: Array,
    queries: Array,
    bound: float,
) -> float:
    """Average the distances from targets to the nearest ``R·point``, points in the tree's order.

    A box of every node is as of :func:`_to_box`; the children of k are 2k + 1 and 2k + 2.
    ``firsts`` is the first point of every leaf, and the number of points; queries are R⁻¹·targets;
    ‖R v‖² is at least ``bound`` times ‖v‖².
    """
    num_inner = len(boxes) // 2
    nodes, floors = np.empty(64, np.int64), np.empty(64)
    total, guess = 0.0, 0
    for i in range(len(targets)):
        x, y, z = queries[i, 0], queries[i, 1], queries[i, 2]
        best = _squared(points[guess], R, targets[i])
        nodes[0], floors[0], count = 0, 0.0, 1
        while count > 0:
            count -= 1
            if floors[count] >= best:
                continue
            node = nodes[count]
            while 0 <= node < num_inner:
                near, far = 2 * node + 1, 2 * node + 2
                low = bound * _to_box(boxes[near], x, y, z)
                high = bound * _to_box(boxes[far], x, y, z)
                if high < low:
                    near, far, low, high = far, near, high, low
                if high < best:
                    nodes[count], floors[count] = far, high
                    count += 1
                node = near if low < best else -1
            if node < 0:
                continue
            for j in range(firsts[node - num_inner], firsts[node - num_inner + 1]):
                dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
                if bound * (dx * dx + dy * dy + dz * dz) < best:
                    distance = _squared(points[j], R, targets[i])
                    if distance < best:
                        best, guess = distance, j
        total += math.sqrt(best)
    return total / len(targets)
