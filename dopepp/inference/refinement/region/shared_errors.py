"""Normal equations of an outline whose points share errors.

All points share two errors, which are unknowns with a prior:

- Offset: blur, a halo or a mesh that is too thick move every point outwards by the same distance.
  The offset is normally distributed.
- Scale: a larger part or focal length has the same effect on the outline as a nearer part. All
  errors up to a limit are equally likely. The pose is corrected by the expected error. A precise
  prior therefore keeps its distance if prior and outline differ by less than the limit. With a
  broad prior, the outline determines the distance. A normally distributed error would move every
  distance, even a correct distance, part of the way to the outline's distance.

Neighbouring points have errors in common, and outliers get a small weight.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.refine import MIN_DAMPING, solve_damped
from dopepp.geometry.rotation import Vector
from dopepp.inference.refinement.region.shifts import Shifts
from dopepp.inference.refinement.solver import DAMPING, NormalEquations

INDEPENDENT_PX: Final = 4.0  # length of the outline within which small errors are equal
MIN_INFORMATION: Final = 1e-3  # pixels⁻²; smaller information is ignored

REWEIGHTINGS: Final = 2  # number of times that outliers are weighted again

GATE: Final = 2.0  # standard deviations at which a point has a quarter of its weight

ALIKE: Final = 0.5
"""Length of the outline within which errors above a pixel are equal, share of the extent."""

OFFSET_PX: Final = 0.5
"""Standard deviation of the offset that all points share: blur, a halo, an error of the mesh.
Measured outlines lie 0.2 pixels outside the outlines of published poses on real frames of two
parts."""

SCALE_ERROR: Final = 0.005
"""Default of the largest relative error of the part's size or of the focal length."""


def region_terms(
    rows: Float[np.ndarray, "points 6"],
    shifts: Shifts,
    prior: NormalEquations,
    spacing: float,
    extent: float,
    position: Vector,
    scale_error: float = SCALE_ERROR,
) -> NormalEquations:
    """Return the normal equations of an outline, with offset and scale eliminated.

    Points are reweighted by their residuals after a common step: the spread of the residuals is
    added to each point's variance, and outliers get a small weight (Geman–McClure).

    Args:
        rows: Derivatives of each point's motion along its normal by the pose, pixels.
        shifts: Measured shift of the part's border at each point.
        prior: Normal equations of the prior and of other terms.
        spacing: Distance between points, pixels.
        extent: Extent of the part, pixels.
        position: Object's origin, camera frame, metres.
        scale_error: Largest relative error of the scale.
    """
    H, g = np.zeros((7, 7)), np.zeros(7)
    independent, alike = min(1.0, spacing / INDEPENDENT_PX), ALIKE * extent / spacing
    prior = np.ascontiguousarray(prior[0]), np.ascontiguousarray(prior[1])
    _terms(rows, shifts, prior, independent, alike, H, g)
    # The Schur complement eliminates the offset.
    last = H[:6, 6] / (H[6, 6] + 1.0 / OFFSET_PX**2)
    H, g = H[:6, :6] - last[:, None] * H[:6, 6], g[:6] - last * g[6]
    _eliminate_scale(H, g, prior, position, max(scale_error, 1e-9))
    return H, g


@compiled()
def _eliminate_scale(
    H: Array, g: Array, prior: NormalEquations, position: Array, limit: float
) -> None:
    """Eliminate a bounded error of the scale from the normal equations, in place.

    The pose moves to the minimum of prior and outline for the expected scale error. ``H`` is
    reduced as for a normally distributed scale error of the same variance.

    Args:
        H: Matrix of the outline's normal equations.
        g: Right side of the outline's normal equations.
        prior: Normal equations of the prior.
        position: Position of the part in the camera frame, metres.
        limit: Largest relative error of the scale.
    """
    prior_H, prior_g = prior
    both, target, column = np.empty((6, 6)), np.empty(6), np.zeros(6)
    step, pull = np.empty(6), np.empty(6)  # steps for a scale error of 0 and of 1
    for c in range(6):
        for a in range(3):
            column[c] += H[c, 3 + a] * position[a]
    for c in range(6):
        target[c] = -g[c] - prior_g[c]
        for d in range(6):
            both[c, d] = H[c, d] + prior_H[c, d]
    solve_damped(both, target, MIN_DAMPING, step)
    solve_damped(both, column, MIN_DAMPING, pull)
    information = gradient = 0.0
    for a in range(3):
        information += position[a] * column[3 + a]
        gradient += position[a] * g[3 + a]
    free = information
    for c in range(6):
        gradient -= column[c] * step[c]
        free += column[c] * pull[c]
    free = max(free, 1e-12)
    error = _truncated_mean(gradient / free, 1.0 / math.sqrt(free), limit)
    # A uniform distribution has a third of the variance.
    pivot = information + 3.0 / limit**2
    for c in range(6):
        step[c] += error * pull[c]
        for d in range(6):
            H[c, d] -= column[c] * column[d] / pivot
    for c in range(6):
        g[c] = -prior_g[c]
        for d in range(6):
            g[c] += (H[c, d] + prior_H[c, d]) * step[d]


@compiled()
def _truncated_mean(mean: float, deviation: float, limit: float) -> float:
    """Return the mean of a normal distribution that is truncated to [-limit, limit]."""
    low, high = (-limit - mean) / deviation, (limit - mean) / deviation
    share = 0.5 * (math.erf(high / math.sqrt(2.0)) - math.erf(low / math.sqrt(2.0)))
    if share < 1e-6:  # far outside the limits, where the nearer limit is almost certain
        return math.copysign(limit, mean)
    difference = math.exp(-0.5 * low * low) - math.exp(-0.5 * high * high)
    return mean + deviation * difference / (math.sqrt(2.0 * math.pi) * share)


@compiled()
def _terms(
    rows: Array,
    shifts: Shifts,
    prior: NormalEquations,
    independent: float,
    alike: float,
    H: Array,
    g: Array,
) -> None:
    """Write the robustly weighted normal equations of (rotation, shift, offset of the outline).

    Args:
        rows: Derivatives of each point's motion by the pose, (n, 6).
        shifts: Measured shift of the outline at each point.
        prior: Normal equations of the prior.
        independent: Number of measurements that a point represents if errors are small.
        alike: Number of neighbouring points that share an error otherwise.
        H: Filled with the 7×7 matrix of the normal equations.
        g: Filled with their right-hand side.
    """
    (means, information), (prior_H, prior_g) = shifts, prior
    squares, valid, weights = np.empty(len(rows)), np.empty(len(rows)), np.empty(len(rows))
    num_valid = 0
    for i in range(len(rows)):
        weights[i] = 0.0
        if information[i] > MIN_INFORMATION:
            weights[i] = information[i] * independent
            num_valid += 1
    if not num_valid:
        return
    matrix, gradient, step = np.empty((6, 6)), np.empty(6), np.empty(6)
    for _ in range(REWEIGHTINGS):
        _add(rows, means, weights, H, g)
        pivot = H[6, 6] + 1.0 / OFFSET_PX**2
        for c in range(6):
            last = H[6, c] / pivot
            gradient[c] = last * g[6] - g[c] - prior_g[c]
            for d in range(6):
                matrix[c, d] = H[c, d] + prior_H[c, d] - last * H[6, d]
        solve_damped(matrix, gradient, DAMPING, step)
        drawn = 0.0
        for c in range(6):
            drawn += H[6, c] / pivot * step[c]
        offset, k = g[6] / pivot - drawn, 0
        for i in range(len(rows)):
            residual = means[i] - offset
            for c in range(6):
                residual -= rows[i, c] * step[c]
            squares[i] = residual * residual
            if information[i] > MIN_INFORMATION:
                valid[k] = squares[i]
                k += 1
        # The median of a squared normal variable is 0.455 of its variance.
        spread = _median(valid[:num_valid]) / 0.455
        # A spread below a pixel is noise. A larger one has a cause that neighbouring points share:
        # a shadow, a highlight or an error of the mesh.
        share = min(independent, 1.0 / max(alike * min(1.0, spread), 1.0))
        for i in range(len(rows)):
            if information[i] > MIN_INFORMATION:
                variance = 1.0 / information[i] + spread
                weights[i] = share / variance / (1.0 + squares[i] / (GATE**2 * variance)) ** 2
    _add(rows, means, weights, H, g)


@compiled()
def _median(values: Array) -> float:
    """Return the median by quickselect, which reorders the values."""
    half = len(values) // 2
    low, high = 0, len(values) - 1
    while low < high:
        pivot, i, j = values[half], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < half:
            low = i
        if half < i:
            high = j
    if len(values) % 2:
        return float(values[half])
    below = values[0]
    for i in range(half):
        below = max(below, values[i])
    return float((below + values[half]) / 2)


@compiled()
def _add(rows: Array, means: Array, weights: Array, H: Array, g: Array) -> None:
    """Write the weighted normal equations of (rotation, shift, offset); every point has the offset.

    Args:
        rows: Derivatives of each point's motion by the pose, (n, 6).
        means: Measured shift of the outline at each point, pixels.
        weights: Weight of each point.
        H: Filled with the 7×7 matrix of the normal equations.
        g: Filled with their right-hand side.
    """
    row = np.ones(7)
    for c in range(7):
        g[c] = 0.0
        for d in range(7):
            H[c, d] = 0.0
    for i in range(len(rows)):
        if weights[i] == 0.0:
            continue
        for c in range(6):
            row[c] = rows[i, c]
        for c in range(7):
            g[c] += weights[i] * row[c] * means[i]
            for d in range(c + 1):
                H[c, d] += weights[i] * row[c] * row[d]
    for c in range(7):
        for d in range(c):
            H[d, c] = H[c, d]
