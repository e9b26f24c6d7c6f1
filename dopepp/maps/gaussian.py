"""Fit Gaussians to the neighbourhoods of peaks, in compiled code.

A belief map is the maximum over instances of b = exp(c + p·x + q·y − r·x² − t·xy − s·y²), with x
and y relative to the peak's cell. Each peak is fitted to the cells in which no other peak of the
channel has the higher Gaussian. After a first fit, cells are reassigned by the fitted positions.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.refine import solve_inside

FLOOR: Final = 1e-6
"""Smallest belief, relative to the peak's, whose logarithm is used. For a peak of σ = 0.5 cells on
the border, the fit needs the third column, with a relative belief of e⁻¹²·⁵ = 4e-6."""

FIRST_MARGIN: Final = 3.0
"""Smallest difference between a cell's squared distances to any other peak and to the peak that it
belongs to, cells², before positions within cells are fitted."""

MARGIN: Final = 1.0  # Replaces FIRST_MARGIN after positions are fitted
ROUNDING: Final = 1e-6  # above the rounding errors of squared distances, cells²

PLATEAU: Final = 3  # Number of cells as high as the peak that indicates a clamped top

STEPS: Final = 3  # Gauss–Newton steps; without noise, the start is exact.
MAX_EXPONENT: Final = 10.0  # Largest logarithm of a fitted Gaussian, relative to the peak's belief
CONVERGED: Final = 1e-4  # Largest parameter change at convergence: 1e-3 px at stride 8
SHAPE_PRIOR: Final = 0.5  # Prior standard deviation of a peak's curvature, relative to the target's
RIDGE: Final = 1e-14  # Determines directions in which no cell exceeds the floor.
MIN_CURVATURE: Final = 1e-3  # 1/cells²: a standard deviation of 22 cells

CENTRE_VARIANCE: Final = 4.0
"""Variance of the position if the fit is not sound (see :func:`_mode`), cells²."""


@compiled()
def fit_peaks(
    belief: Array, cells: Array, half: int, sigma: float, position: Array, covariance: Array
) -> None:
    """Fit a Gaussian to each peak of a channel, first to the logarithms, then to the beliefs b.

    Logarithms make the first fit linear and exact for a clean Gaussian, even at the border; weights
    b² compensate for their amplification of noise (Guo, IEEE SPM 2011). Gauss–Newton on b then
    removes the bias that noise causes in logarithms.

    ``cells`` are (column, row) of each peak, ``half`` is the half-width of the window and ``sigma``
    the standard deviation of a target peak. ``position`` is filled with (x, y) of each peak, and
    ``covariance`` with the covariance of the fit plus the fitted variance, reduced by its standard
    error, in excess of ``sigma``². All lengths are cells.
    """
    (height, width), count, side = belief.shape, len(cells), 2 * half + 1
    theta, hessian = np.zeros((count, 6)), np.zeros((count, 6, 6))
    noise, freedom = 0.0, 0.0
    scores, work, workspace = np.empty(count), np.empty((5, 10)), np.empty((11, 6))
    windows, usable = np.empty((count, side, side)), np.empty((count, side, side), np.bool_)
    logarithms = np.empty((count, side, side))
    for i in range(count):
        scores[i] = belief[cells[i, 1], cells[i, 0]]
        for y in range(side):
            for x in range(side):
                row, column = cells[i, 1] - half + y, cells[i, 0] - half + x
                inside = 0 <= row < height and 0 <= column < width
                windows[i, y, x] = belief[row, column] / scores[i] if inside else math.nan
                logarithms[i, y, x] = math.log(max(windows[i, y, x], FLOOR))
        position[i, 0], position[i, 1] = cells[i, 0], cells[i, 1]
    for i in range(count):
        _own_cells(i, windows, cells, position, scores, sigma, FIRST_MARGIN, usable[i])
    for i in range(count):
        _fit_logarithm(windows[i], logarithms[i], usable[i], sigma, 0.0, work, workspace, theta[i])
        u, v, _ = _mode(windows[i], theta[i])
        position[i, 0], position[i, 1] = cells[i, 0] + u, cells[i, 1] + v
    for i in range(count):
        _own_cells(i, windows, cells, position, scores, sigma, MARGIN, usable[i])
        squared, used = _linearised(
            windows[i], usable[i], theta[i], 0.0, sigma, work, workspace[0], hessian[i]
        )
        if squared <= used:  # residuals above the peak itself: noise beside a higher peak
            noise += squared * scores[i] ** 2
            freedom += max(used - 6.0, 0.0)
    noise /= max(freedom, 1.0)
    for i in range(count):
        relative = noise / scores[i] ** 2
        _fit_logarithm(
            windows[i], logarithms[i], usable[i], sigma, relative, work, workspace, theta[i]
        )
        for _ in range(STEPS if theta[i].any() else 0):
            _linearised(
                windows[i], usable[i], theta[i], relative, sigma, work, workspace[0], hessian[i]
            )
            if _step(theta[i], hessian[i], workspace) < CONVERGED:
                break
        u, v, is_fitted = _mode(windows[i], theta[i])
        position[i, 0], position[i, 1] = cells[i, 0] + u, cells[i, 1] + v
        if is_fitted:
            _covariance(theta[i], u, v, hessian[i], relative, sigma, workspace, covariance[i])
        else:
            covariance[i] = 0.0
            covariance[i, 0, 0] = covariance[i, 1, 1] = CENTRE_VARIANCE


@compiled()
def mean_vectors(
    vectors: Array, cells: Array, position: Array, radius: float, toward: Array
) -> None:
    """Average the vector field over the disc around each peak of a corner's channel.

    Where discs overlap, a cell's vector belongs to the nearest peak. At distance d, the weight
    1 − (d/radius)² falls to 0 at the disc's edge, where inexact positions make vectors uncertain.

    ``vectors`` are the field's components (2, height, width), ``cells`` the (column, row) and
    ``position`` the fitted (x, y) of each peak, cells. ``toward``, zero on entry, is filled with
    the mean vector of each peak.
    """
    height, width = vectors.shape[1:]
    half = math.ceil(radius)
    near = np.empty(len(cells), np.int64)
    for i in range(len(cells)):
        count = 0
        for j in range(len(cells)):
            dx, dy = position[j, 0] - position[i, 0], position[j, 1] - position[i, 1]
            if j != i and dx * dx + dy * dy < 4.1 * radius**2:  # farther discs do not overlap
                near[count] = j
                count += 1
        total = 0.0
        for row in range(max(cells[i, 1] - half, 0), min(cells[i, 1] + half + 1, height)):
            for column in range(max(cells[i, 0] - half, 0), min(cells[i, 0] + half + 1, width)):
                squared = (column - position[i, 0]) ** 2 + (row - position[i, 1]) ** 2
                weight = 1 - squared / radius**2
                u, v = vectors[0, row, column], vectors[1, row, column]
                if not (weight > 0.0 and math.isfinite(u) and math.isfinite(v)):
                    continue
                nearest = True
                for j in near[:count]:
                    if (column - position[j, 0]) ** 2 + (row - position[j, 1]) ** 2 < squared:
                        nearest = False
                        break
                if nearest:
                    total += weight
                    toward[i, 0] += weight * u
                    toward[i, 1] += weight * v
        if total > 0.0:
            toward[i, 0] /= total
            toward[i, 1] /= total


@compiled()
def _own_cells(
    i: int,
    windows: Array,
    cells: Array,
    position: Array,
    scores: Array,
    sigma: float,
    margin: float,
    usable: Array,
) -> None:
    """Mark in ``usable`` the cells of the window around peak ``i`` that belong to this peak.

    A cell belongs to a peak if the cell is finite, the peak's Gaussian is the highest there, and
    fewer than :data:`PLATEAU` cells are as high as the peak or the cell is lower. Of Gaussians
    s·exp(−d²/2σ²), the highest in a cell has the smallest d² − 2σ² log s; ``margin`` is the
    required difference to any other peak, cells².
    """
    side, highest = windows.shape[1], 0
    half = side // 2
    for y in range(side):
        for x in range(side):
            usable[y, x] = math.isfinite(windows[i, y, x])
            highest += windows[i, y, x] == 1.0
    for j in range(len(cells)):
        far = max(abs(position[j, 0] - position[i, 0]), abs(position[j, 1] - position[i, 1]))
        if j == i or far > 4 * half + 2:
            continue
        handicap = 2 * sigma**2 * math.log(scores[i] / scores[j]) - margin
        # The difference of the squared distances is linear, so its minimum is at a corner.
        column = cells[i, 0] + (half if position[j, 0] > position[i, 0] else -half)
        row = cells[i, 1] + (half if position[j, 1] > position[i, 1] else -half)
        own_squared = (column - position[i, 0]) ** 2 + (row - position[i, 1]) ** 2
        other_squared = (column - position[j, 0]) ** 2 + (row - position[j, 1]) ** 2
        if own_squared - handicap < other_squared - ROUNDING:
            continue
        for y in range(side):
            for x in range(side):
                column, row = cells[i, 0] + x - half, cells[i, 1] + y - half
                own_squared = (column - position[i, 0]) ** 2 + (row - position[i, 1]) ** 2
                other_squared = (column - position[j, 0]) ** 2 + (row - position[j, 1]) ** 2
                if own_squared - handicap >= other_squared:
                    usable[y, x] = False
    if highest >= PLATEAU:
        for y in range(side):
            for x in range(side):
                usable[y, x] &= windows[i, y, x] != 1.0


@compiled()
def _fit_logarithm(
    window: Array,
    logarithm: Array,
    usable: Array,
    sigma: float,
    noise: float,
    work: Array,
    workspace: Array,
    theta: Array,
) -> None:
    """Fit the logarithm of a Gaussian to the usable cells by weighted linear least squares.

    Args:
        window: Beliefs around the peak, relative to the peak's belief, (side, side).
        logarithm: Logarithms of ``window``, at least log :data:`FLOOR`.
        usable: Whether each cell belongs to the peak.
        sigma: Standard deviation of a target peak, cells.
        noise: Variance of the values in ``window``, which weights the prior of the shape.
        work: Workspace for sums over the cells, (5, 10).
        workspace: Workspace of the solver, (11, 6).
        theta: Filled with the coefficients of (1, x, y, −x², −xy, −y²); x and y in cells from the
            central cell.
    """
    side, half, curvature = len(window), len(window) // 2, 0.5 / sigma**2
    theta[:] = 0.0
    theta[3] = theta[5] = curvature
    work[:] = 0.0
    for y in range(side):
        for x in range(side):
            value = window[y, x]
            if usable[y, x] and value > FLOOR:
                expected = -curvature * ((x - half) ** 2 + (y - half) ** 2)
                weight = value * value
                _add(work, x - half, weight, weight * (expected - logarithm[y, x]))
        _end_row(work, y - half)
    hessian = np.empty((6, 6))
    _system(work, theta, noise, sigma, hessian, workspace[0])
    solve_inside(hessian, workspace[0], 0.0, workspace[1], workspace[4:])
    theta += workspace[1]
    if work[0, 0] == 0.0:  # no usable cells: the window shows only a clamped top, without slopes
        theta[:] = 0.0


@compiled()
def _linearised(
    window: Array,
    usable: Array,
    theta: Array,
    noise: float,
    sigma: float,
    work: Array,
    gradient: Array,
    hessian: Array,
) -> tuple[float, float]:
    """Write gradient and Hessian of a Gaussian fit to the beliefs, linearised at ``theta``.

    The other arguments are those of :func:`_fit_logarithm`.

    Returns:
        The sum of squared residuals, and the number of usable cells.
    """
    side, half = len(window), len(window) // 2
    squared, used = 0.0, 0.0
    work[:] = 0.0
    for y in range(side):
        v = float(y - half)
        level = theta[0] + v * (theta[2] - theta[5] * v)
        slope = theta[1] - theta[4] * v
        for x in range(side):
            if usable[y, x]:
                u = float(x - half)
                # Clipped, because a steeper fit is wrong and its square could overflow.
                model = math.exp(min(level + u * (slope - theta[3] * u), MAX_EXPONENT))
                residual = model - window[y, x]
                squared += residual * residual
                used += 1.0
                _add(work, x - half, model * model, model * residual)
        _end_row(work, y - half)
    _system(work, theta, noise, sigma, hessian, gradient)
    return squared, used


@compiled()
def _step(theta: Array, hessian: Array, workspace: Array) -> float:
    """Add the Gauss–Newton step (gradient: ``workspace[0]``) to ``theta``; return its max norm."""
    solve_inside(hessian, workspace[0], 0.0, workspace[1], workspace[4:])
    farthest = 0.0
    for k in range(6):
        theta[k] += workspace[1, k]
        farthest = max(farthest, abs(workspace[1, k]))
    return farthest


@compiled()
def _add(work: Array, x: float, weight: float, residual: float) -> None:
    """Add a cell to the sums of its row: weight·xᵃ in ``work[a, 6]``, residual·xᵃ in ``[a, 5]``."""
    work[0, 5] += residual
    work[1, 5] += residual * x
    work[2, 5] += residual * x * x
    for a in range(5):
        work[a, 6] += weight
        weight *= x


@compiled()
def _end_row(work: Array, y: float) -> None:
    """Add a row's sums times yᵇ to ``work[a, b]`` and ``work[a, 7 + b]``; clear the row's sums."""
    power = 1.0
    for b in range(5):
        for a in range(5 - b):
            work[a, b] += work[a, 6] * power
            if a + b <= 2:
                work[a, 7 + b] += work[a, 5] * power
        power *= y
    work[:, 5:7] = 0.0


@compiled()
def _system(
    work: Array, theta: Array, noise: float, sigma: float, hessian: Array, gradient: Array
) -> None:
    """Write gradient and Hessian for ``theta`` from the sums in ``work`` and the shape's prior."""
    across, down = (0, 1, 0, 2, 1, 0), (0, 0, 1, 0, 1, 2)
    curvature = 0.5 / sigma**2
    weight = noise / (SHAPE_PRIOR * curvature) ** 2 + RIDGE
    for k in range(6):
        sign = -1.0 if k >= 3 else 1.0
        gradient[k] = sign * work[across[k], 7 + down[k]]
        for m in range(6):
            value = work[across[k] + across[m], down[k] + down[m]]
            hessian[k, m] = sign * (-value if m >= 3 else value)
        hessian[k, k] += weight if k >= 3 else RIDGE
    gradient[3] += weight * (theta[3] - curvature)
    gradient[4] += weight * theta[4]
    gradient[5] += weight * (theta[5] - curvature)


@compiled()
def _mode(window: Array, theta: Array) -> tuple[float, float, bool]:
    """Return (x, y) of the fitted maximum, and whether the fit is sound.

    The fit is sound if it has a maximum near the mean position of the cells that are as high as the
    peak. Otherwise, this mean position is returned.

    Args:
        window: Beliefs around the peak, relative to the peak's belief; NaN outside the map.
        theta: Coefficients of the fit; see :func:`_fit_logarithm`.

    Returns:
        x and y relative to the window's central cell, cells, and whether the fit is sound.
    """
    half = len(window) // 2
    across, down, count = 0.0, 0.0, 0
    for v in range(-2, 3):
        for u in range(-2, 3):
            if window[half + v, half + u] == 1.0:
                across += u
                down += v
                count += 1
    across, down = across / count, down / count
    a, b, c = 2 * theta[3], theta[4], 2 * theta[5]
    determinant = a * c - b * b
    x = (c * theta[1] - b * theta[2]) / determinant
    y = (a * theta[2] - b * theta[1]) / determinant
    smallest = 0.5 * (a + c - math.sqrt((a - c) ** 2 + 4 * b * b))
    # The peak's cell may be any cell of a clamped top.
    reach = 1.0 if count < PLATEAU else 2.0
    if smallest > MIN_CURVATURE and abs(x - across) <= reach and abs(y - down) <= reach:
        return x, y, True
    return across, down, False


@compiled()
def _covariance(
    theta: Array,
    x: float,
    y: float,
    hessian: Array,
    noise: float,
    sigma: float,
    workspace: Array,
    out: Array,
) -> None:
    """Write the covariance of the position (x, y) of a sound fit, cells²; see :func:`fit_peaks`.

    The position is P⁻¹(p, q) with the precision P = [[2r, t], [t, 2s]] of the Gaussian. Its
    differential is P⁻¹(dp − 2x·dr − y·dt, dq − x·dt − 2y·ds).
    """
    a, b, c = 2 * theta[3], theta[4], 2 * theta[5]
    determinant = a * c - b * b
    xx, xy, yy = c / determinant, -b / determinant, a / determinant
    slopes, moved, mean = workspace[:2], workspace[2], workspace[3]
    for k in range(2):
        # The sign is negative, because the equations are solved for the negative.
        across, down = (-xx, -xy) if k == 0 else (-xy, -yy)
        slopes[k, 0], slopes[k, 1], slopes[k, 2] = 0.0, across, down
        slopes[k, 3] = -2 * x * across
        slopes[k, 4] = -y * across - x * down
        slopes[k, 5] = -2 * y * down
    for k in range(2):
        solve_inside(hessian, slopes[k], 0.0, moved, workspace[4:])
        for m in range(2):
            out[k, m] = -noise * _product(slopes[m], moved)
    out[0, 1] = out[1, 0]
    # The relative uncertainty of the variance equals the relative uncertainty of (r + s)/2.
    mean[:] = 0.0
    mean[3] = mean[5] = -0.5
    solve_inside(hessian, mean, 0.0, moved, workspace[4:])
    relative = math.sqrt(-noise * _product(mean, moved)) / (0.25 * (a + c))
    angle = 0.5 * math.atan2(2 * xy, xx - yy)
    cosine, sine = math.cos(angle), math.sin(angle)
    for u, v in ((cosine, sine), (-sine, cosine)):
        variance = u * u * xx + 2 * u * v * xy + v * v * yy
        excess = max(variance * (1 - relative) - sigma**2, 0.0)
        out[0, 0] += excess * u * u
        out[0, 1] += excess * u * v
        out[1, 1] += excess * v * v
    out[1, 0] = out[0, 1]


@compiled()
def _product(left: Array, right: Array) -> float:
    """Return the dot product of two vectors of six numbers."""
    total = 0.0
    for k in range(6):
        total += left[k] * right[k]
    return total
