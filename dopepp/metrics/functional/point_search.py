"""Exact, compiled searches behind the pose errors.

Nearest points (ADD-S): a k-d tree over the object's points serves all poses. Queries follow the
order of the tree's leaves, so each query starts with the nearest point of the previous query. This
close bound prunes most of the tree.

Symmetry with the smallest maximum distance (MSSD, MSPD): first, eight probes (points far apart) are
evaluated under every symmetry. Then the most promising symmetry is evaluated at all points. Each
remaining symmetry is rejected at its first point that is farther than the best maximum so far.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dopepp.core.compiled import Array, compiled

Affine = tuple[Float[Tensor, "k 3 3"], Float[Tensor, "k 3"]]
"""Matrices and translations of affine maps."""

_LEAF: Final = 16  # Largest number of points in a leaf
_ROUNDING: Final = 1e-9
"""Share by which a bound is lowered, so that rounding errors never prune the nearest point."""

_NUM_PROBES: Final = 8  # As many as a box has corners


def mean_nearest(
    points: Float[np.ndarray, "v 3"],
    R_est: Float[np.ndarray, "n 3 3"],
    R_gt: Float[np.ndarray, "n 3 3"],
    offset: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n"]:
    """Return the mean distance from the true points to the nearest estimated points, metres.

    Rotations may be any matrices; ``offset`` is the true minus the estimated translation.
    """
    points, boxes, firsts = _tree(points)
    distances = np.empty(len(offset))
    # ‖R_est v‖ ≥ s ‖v‖ with the smallest singular value s: 1 for a rotation.
    least = np.linalg.svd(R_est, compute_uv=False)[:, 2]
    targets = np.empty_like(points)
    for n in range(len(offset)):
        _transform(points, np.ascontiguousarray(R_gt[n]), offset[n], targets)
        # A singular matrix has no inverse; its bound is 0, which prunes nothing.
        inverse = np.linalg.inv(R_est[n]) if least[n] > 0 else np.zeros((3, 3))
        bound = least[n] ** 2 * (1 - _ROUNDING)
        R, queries = np.ascontiguousarray(R_est[n]), targets @ inverse.T
        distances[n] = _mean_distance(points, boxes, firsts, R, targets, queries, bound)
    return distances


def _tree(
    points: Float[np.ndarray, "v 3"],
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "nodes 6"], Int[np.ndarray, "leaves+1"]]:
    """Build a k-d tree: points in leaf order, box of each node, first point index of each leaf."""
    depth = max(math.ceil(math.log2(len(points) / _LEAF)), 0)
    order = np.arange(len(points))
    firsts = np.linspace(0, len(points), 2**depth + 1).astype(np.int64)
    boxes = np.empty((2 ** (depth + 1) - 1, 6))
    for level in range(depth + 1):
        step = 2 ** (depth - level)
        for k in range(2**level):
            node = order[firsts[k * step] : firsts[(k + 1) * step]]
            corners = points[node]
            low, high = corners.min(axis=0), corners.max(axis=0)
            boxes[2**level - 1 + k] = *low, *high
            if level < depth:
                middle = firsts[k * step + step // 2] - firsts[k * step]
                node[:] = node[corners[:, (high - low).argmax()].argpartition(middle)]
    return np.ascontiguousarray(points[order]), boxes, firsts


@compiled()
def _transform(points: Array, R: Array, offset: Array, out: Array) -> None:
    """Write R·x + offset of every point, with the same rounding as :func:`_squared`."""
    for i in range(len(points)):
        for r in range(3):
            out[i, r] = (
                R[r, 0] * points[i, 0] + R[r, 1] * points[i, 1] + R[r, 2] * points[i, 2] + offset[r]
            )


@compiled(inline="always")
def _squared(point: Array, R: Array, target: Array) -> float:
    """Return ‖R·point − target‖²."""
    dx = R[0, 0] * point[0] + R[0, 1] * point[1] + R[0, 2] * point[2] - target[0]
    dy = R[1, 0] * point[0] + R[1, 1] * point[1] + R[1, 2] * point[2] - target[1]
    dz = R[2, 0] * point[0] + R[2, 1] * point[1] + R[2, 2] * point[2] - target[2]
    return float(dx * dx + dy * dy + dz * dz)


@compiled(inline="always")
def _squared_box_distance(box: Array, x: float, y: float, z: float) -> float:
    """Return the squared distance to a box (smallest x, y, z, largest x, y, z); 0 inside."""
    dx = max(box[0] - x, x - box[3], 0.0)
    dy = max(box[1] - y, y - box[4], 0.0)
    dz = max(box[2] - z, z - box[5], 0.0)
    return float(dx * dx + dy * dy + dz * dz)


@compiled()
def _mean_distance(
    points: Float[np.ndarray, "v 3"],
    boxes: Float[np.ndarray, "nodes 6"],
    firsts: Int[np.ndarray, "leaves+1"],
    R: Float[np.ndarray, "3 3"],
    targets: Float[np.ndarray, "v 3"],
    queries: Float[np.ndarray, "v 3"],
    bound: float,
) -> float:
    """Average the distances from targets to the nearest ``R·point`` of a tree (:func:`_tree`).

    Node k has the children 2k + 1 and 2k + 2. ``queries`` are R⁻¹·targets, and ``bound`` is a lower
    bound of ‖R v‖² / ‖v‖².
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
                low = bound * _squared_box_distance(boxes[near], x, y, z)
                high = bound * _squared_box_distance(boxes[far], x, y, z)
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


def least_farthest(
    estimated: Affine, true: Affine, points: Tensor, symmetries: Affine, perspective: bool
) -> Float[Tensor, "n"]:
    """Return the maximum point distance under the best symmetry (MSSD, MSPD).

    The distance of the estimated map (B, b) from the true map (A, a) is the minimum over symmetries
    S of the maximum over points x of ‖π(Bx + b) − π(A(Sx) + a)‖. With ``perspective``, π divides by
    the third coordinate, and the distance is infinite if a third coordinate is not positive;
    otherwise π is the identity.
    """
    ordered = _probes_first(points.detach().cpu().numpy())
    B, b, A, a, rotations, shifts = (
        tensor.detach().cpu().contiguous().numpy() for tensor in (*estimated, *true, *symmetries)
    )
    errors = np.empty(len(a))
    num_probes = min(_NUM_PROBES, len(ordered))
    _search(B, b, A, a, ordered, rotations, shifts, num_probes, perspective, errors)
    return torch.from_numpy(errors).to(points.device)


def _probes_first(points: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
    """Reorder points so that each of the first ``_NUM_PROBES`` is farthest from those before."""
    order = np.arange(len(points))
    distances = ((points - points.mean(axis=0)) ** 2).sum(axis=1)
    for k in range(min(_NUM_PROBES, len(points))):
        farthest = k + int(distances[order[k:]].argmax())
        order[[k, farthest]] = order[[farthest, k]]
        gaps = ((points - points[order[k]]) ** 2).sum(axis=1)
        distances = gaps if k == 0 else np.minimum(distances, gaps)
    return np.ascontiguousarray(points[order])


@compiled(inline="always")
def _squared_gap(P: Array, p: Array, x: Array, target: Array, perspective: bool) -> float:
    """Return ‖π(Px + p) − target‖², infinite if NaN or behind the camera."""
    u = P[0, 0] * x[0] + P[0, 1] * x[1] + P[0, 2] * x[2] + p[0]
    v = P[1, 0] * x[0] + P[1, 1] * x[1] + P[1, 2] * x[2] + p[1]
    w = P[2, 0] * x[0] + P[2, 1] * x[1] + P[2, 2] * x[2] + p[2]
    if perspective:
        if not w > 0.0:
            return np.inf
        du, dv, dw = u / w - target[0], v / w - target[1], 0.0
    else:
        du, dv, dw = u - target[0], v - target[1], w - target[2]
    squared = du * du + dv * dv + dw * dw
    return squared if squared < np.inf else np.inf


@compiled()
def _set_targets(B: Array, b: Array, points: Array, perspective: bool, targets: Array) -> bool:
    """Write π(Bx + b) of every point; return False at the first point behind the camera."""
    for j in range(len(points)):
        for r in range(3):
            targets[j, r] = (
                B[r, 0] * points[j, 0] + B[r, 1] * points[j, 1] + B[r, 2] * points[j, 2] + b[r]
            )
        if perspective:
            depth = targets[j, 2]
            if not depth > 0.0:
                return False
            targets[j, 0] /= depth
            targets[j, 1] /= depth
    return True


@compiled()
def _search(
    B: Float[np.ndarray, "n 3 3"],
    b: Float[np.ndarray, "n 3"],
    A: Float[np.ndarray, "n 3 3"],
    a: Float[np.ndarray, "n 3"],
    points: Float[np.ndarray, "v 3"],
    rotations: Float[np.ndarray, "s 3 3"],
    shifts: Float[np.ndarray, "s 3"],
    num_probes: int,
    perspective: bool,
    errors: Float[np.ndarray, "n"],
) -> None:
    """Write the smallest maximum point distance over the symmetries to ``errors``, per pose.

    The arguments are as in :func:`least_farthest`; the probes are the first points.
    """
    targets = np.empty((len(points), 3))
    P, p = np.empty((len(rotations), 3, 3)), np.empty((len(rotations), 3))
    floors = np.empty(len(rotations))
    for n in range(len(errors)):
        errors[n] = np.inf
        if not _set_targets(B[n], b[n], points, perspective, targets):
            continue
        _transform(shifts, A[n], a[n], p)
        for s in range(len(rotations)):
            for r in range(3):
                for c in range(3):
                    P[s, r, c] = (
                        A[n, r, 0] * rotations[s, 0, c]
                        + A[n, r, 1] * rotations[s, 1, c]
                        + A[n, r, 2] * rotations[s, 2, c]
                    )
            floors[s] = 0.0
            for j in range(num_probes):
                floors[s] = max(
                    floors[s], _squared_gap(P[s], p[s], points[j], targets[j], perspective)
                )
        errors[n] = np.sqrt(_least(P, p, points, targets, floors, perspective))


@compiled()
def _least(
    P: Array, p: Array, points: Array, targets: Array, floors: Array, perspective: bool
) -> float:
    """Return the smallest squared maximum distance over the symmetries (P, p).

    ``floors`` are lower bounds: each symmetry's maximum over the probes.
    """
    promising = floors.argmin()
    best, worst = np.inf, 0
    for k in range(len(floors)):
        s = promising if k == 0 else (0 if k == promising else k)
        if not floors[s] < best:
            continue
        farthest = _squared_gap(P[s], p[s], points[worst], targets[worst], perspective)
        j = 0
        while farthest < best and j < len(points):
            gap = _squared_gap(P[s], p[s], points[j], targets[j], perspective)
            if gap > farthest:
                farthest, worst = gap, j
            j += 1
        best = min(best, farthest)
    return float(best)
