"""The search that MSSD and MSPD share: the symmetry under which the farthest point is nearest.

A symmetry is out as soon as one point is farther than the farthest of the best symmetry so far.
Eight points as far apart as can be are tried first under every symmetry; the most promising one is
measured in full, and nearly all others then end after a point or two. Nothing is left out that
could be smaller, so the result is that of trying everything.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dopepp.core.compiled import Array, compiled
from dopepp.metrics.functional.inputs import Errors, Points, chunks, nan_is_miss

Affine = tuple[Float[Tensor, "k 3 3"], Float[Tensor, "k 3"]]
"""Matrices and what is added to their products."""

_NUM_PROBES: Final = 8
"""Points tried first: as many as a box has corners."""


def least_farthest(
    estimated: Affine, true: Affine, points: Points, symmetries: Affine, perspective: bool
) -> Errors:
    """Return min over S of max over x of ‖π(Bx + b) − π(A(Sx) + a)‖, infinite where it is NaN.

    Estimated are (B, b), true are (A, a); symmetries are rotations and translations of the S. With
    ``perspective`` π divides by the third coordinate, which must be positive; otherwise it changes
    nothing.
    """
    if points.device.type != "cpu":
        return _try_everything(estimated, true, points, symmetries, perspective)
    ordered = _probes_first(points.detach().numpy())
    B, b, A, a, turns, shifts = (
        tensor.detach().contiguous().numpy() for tensor in (*estimated, *true, *symmetries)
    )
    errors = np.empty(len(a))
    num_probes = min(_NUM_PROBES, len(ordered))
    _search(B, b, A, a, ordered, turns, shifts, num_probes, perspective, errors)
    return torch.from_numpy(errors)


def _try_everything(
    estimated: Affine, true: Affine, points: Tensor, symmetries: Affine, perspective: bool
) -> Errors:
    """Take every point under every symmetry, many at once: for a GPU."""
    errors = torch.full_like(true[1][:, 0], torch.inf)
    for chunk in chunks(len(errors), len(points)):
        A, a = true[0][chunk], true[1][chunk]
        targets = _place(estimated[0][chunk], estimated[1][chunk], points, perspective)
        for turn, shift in zip(*symmetries, strict=True):
            placed = _place(A @ turn, A @ shift + a, points, perspective)
            farthest = (targets - placed).square_().sum(dim=2).amax(dim=1)
            errors[chunk] = torch.fmin(errors[chunk], nan_is_miss(farthest).sqrt())
    return errors


def _place(R: Tensor, t: Tensor, points: Tensor, perspective: bool) -> Float[Tensor, "n v 3"]:
    placed: Tensor = points @ R.mT + t[:, None]
    if not perspective:
        return placed
    depth = placed[..., 2:]
    return torch.where(depth > 0, placed / depth, torch.nan)


def _probes_first(points: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
    """Put the probes first: each is the point farthest from the ones before it."""
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
    """Return ‖π(Px + p) − target‖², infinite where it is no number or not before the camera."""
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
    """Write π(Bx + b) of every point; return False as soon as one is not before the camera."""
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
    B: Array,
    b: Array,
    A: Array,
    a: Array,
    points: Array,
    turns: Array,
    shifts: Array,
    num_probes: int,
    perspective: bool,
    errors: Array,
) -> None:
    """Fill in the errors of all poses; arguments as of :func:`least_farthest`."""
    targets = np.empty((len(points), 3))
    P, p = np.empty((len(turns), 3, 3)), np.empty((len(turns), 3))
    floors = np.empty(len(turns))
    for n in range(len(errors)):
        errors[n] = np.inf
        if not _set_targets(B[n], b[n], points, perspective, targets):
            continue
        for s in range(len(turns)):
            for r in range(3):
                for c in range(3):
                    P[s, r, c] = (
                        A[n, r, 0] * turns[s, 0, c]
                        + A[n, r, 1] * turns[s, 1, c]
                        + A[n, r, 2] * turns[s, 2, c]
                    )
                p[s, r] = (
                    A[n, r, 0] * shifts[s, 0]
                    + A[n, r, 1] * shifts[s, 1]
                    + A[n, r, 2] * shifts[s, 2]
                    + a[n, r]
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
    """Return the least squared maximum over the symmetries, given as matrices and translations.

    ``targets`` is where the points should be, ``floors`` of every symmetry the maximum over some.
    """
    promising = floors.argmin()
    best, culprit = np.inf, 0
    for k in range(len(floors)):
        s = promising if k == 0 else (0 if k == promising else k)
        if not floors[s] < best:
            continue
        farthest = _squared_gap(P[s], p[s], points[culprit], targets[culprit], perspective)
        j = 0
        while farthest < best and j < len(points):
            gap = _squared_gap(P[s], p[s], points[j], targets[j], perspective)
            if gap > farthest:
                farthest, culprit = gap, j
            j += 1
        best = min(best, farthest)
    return float(best)
