"""Robust pose refinement by damped Gauss–Newton on SE(3), and tests for degenerate points.

During refinement, object points are centred and of unit size and pixels are rays, so that one set
of numerical tolerances serves every part and camera. A pose is (R, t) with x_cam = R x_obj + t.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.rotation import RotationMatrix, Vector

GATE: Final = 3.0
"""Points beyond this many standard deviations are outliers (99.7 % of a Gaussian lies within)."""

MAX_STEPS: Final = 15
CONVERGED: Final = 1e-4
"""Relative decrease of the cost at convergence: far less than one point's noise."""

ROUNDING: Final = 1e-12
"""Negligible decrease of the cost: a point moves by a millionth of its deviation."""

FIRST_DAMPING: Final = 1e-4

MIN_DAMPING: Final = 1e-9
"""Larger than rounding errors of the scaled 6×6 system, which is therefore never singular."""

MAX_DAMPING: Final = 1e6
"""Damping at convergence: steps of a millionth of Gauss–Newton's do not reduce the cost."""

NO_GATE: Final = 1e3  # A gate so wide that the cost is the least-squares cost
_TINY_ANGLE: Final = 1e-8
"""Angle below which a rotation's second-order term vanishes in float64, radians."""

MIN_POINTS: Final = 4

UNDETERMINED: Final = 1e3
"""Standard deviation of a direction that measurements leave undetermined, radians or metres."""

ObjectPoints = Float[np.ndarray, "n 3"]
Rays = Float[np.ndarray, "n 2"]
Whitenings = Float[np.ndarray, "n 2 2"]


class Points(NamedTuple):
    """Points of an object and their images; during refinement centred and of unit size."""

    solid: ObjectPoints  # Positions in the object frame
    rays: Rays  # Measured ray (x/z, y/z) of each point
    # Matrix of each point from ray differences to standard deviations of the pixel.
    whitening: Whitenings


SMALLEST: Final = 1e-9  # Smallest valid extent of the object points, metres
LARGEST: Final = 1e9  # Largest valid extent of the object points, metres
SAME_PIXEL: Final = 1e-3  # Largest difference of two positions that count as equal, pixels


def covariance_of(information: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Invert an information matrix, after adding a prior with the deviation ``UNDETERMINED``."""
    return np.asarray(np.linalg.inv(information + np.eye(len(information)) / UNDETERMINED**2))


@compiled()
def refine_pose(points: Points, R: RotationMatrix, t: Vector, gate: float) -> None:
    """Refine the pose (R, t) in place: minimise the Geman–McClure cost Σ r²/(r² + g²), gate g.

    Steps are damped, and a step that does not reduce the cost is repeated with more damping
    (Levenberg–Marquardt). A pose with points behind the camera remains unchanged.
    """
    n = len(points.rays)
    residuals, moved_residuals = np.empty((n, 2)), np.empty((n, 2))
    moved_R, moved_t = np.empty((3, 3)), np.empty(3)
    hessian, gradient, step = np.empty((6, 6)), np.empty(6), np.empty(6)
    workspace = np.empty((7, 6))
    if not reproject(points, R, t, residuals):
        return
    cost, damping = _robust_cost(residuals, gate), FIRST_DAMPING
    normal_equations(points, R, t, residuals, gate, hessian, gradient)
    for _ in range(MAX_STEPS):
        solve_inside(hessian, gradient, damping, step, workspace)
        apply_rotation(step, R, moved_R)
        for r in range(3):
            moved_t[r] = t[r] + step[3 + r]
        reproject(points, moved_R, moved_t, moved_residuals)
        moved_cost = _robust_cost(moved_residuals, gate)
        if moved_cost < cost:
            arrived = cost - moved_cost <= CONVERGED * cost + ROUNDING
            cost = moved_cost
            copy_pose(moved_R, moved_t, R, t)
            for i in range(n):
                residuals[i, 0], residuals[i, 1] = moved_residuals[i, 0], moved_residuals[i, 1]
            if arrived:
                return
            damping = max(damping / 10, MIN_DAMPING)
            normal_equations(points, R, t, residuals, gate, hessian, gradient)
        else:
            damping *= 10
            if damping >= MAX_DAMPING:
                return


@compiled()
def reproject(points: Points, R: RotationMatrix, t: Vector, out: Array) -> bool:
    """Write the whitened reprojection errors (n, 2); NaN for points behind the camera.

    Return whether all points are in front of the camera.
    """
    object_points, rays, whitening = points
    in_front = True
    for i in range(len(rays)):
        x, y, z = object_points[i, 0], object_points[i, 1], object_points[i, 2]
        depth = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
        if not depth > 0.0:
            out[i, 0] = out[i, 1] = math.nan
            in_front = False
            continue
        u = (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]) / depth - rays[i, 0]
        v = (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]) / depth - rays[i, 1]
        out[i, 0] = whitening[i, 0, 0] * u + whitening[i, 0, 1] * v
        out[i, 1] = whitening[i, 1, 0] * u + whitening[i, 1, 1] * v
    return in_front


@compiled()
def copy_pose(R: Array, t: Array, to_R: Array, to_t: Array) -> None:
    """Copy a pose in place; assigned slices would take a second to compile."""
    for r in range(3):
        to_t[r] = t[r]
        for c in range(3):
            to_R[r, c] = R[r, c]


@compiled()
def _robust_cost(residuals: Array, gate: float) -> float:
    """Return Σ r²/(r² + g²); an infinite or NaN r contributes 1."""
    cost = 0.0
    for i in range(len(residuals)):
        squared = residuals[i, 0] ** 2 + residuals[i, 1] ** 2
        cost += squared / (squared + gate**2) if squared < math.inf else 1.0
    return cost


@compiled()
def normal_equations(
    points: Points, R: Array, t: Array, errors: Array, gate: float, hessian: Array, gradient: Array
) -> None:
    """Write JᵀJ and Jᵀr of a left increment (rotation vector, translation), with robust weights.

    The errors are the whitened reprojection errors of :func:`reproject`.

    The derivatives of a ray (u, v) = (X, Y)/Z by x_cam are [1, 0, −u]/Z and [0, 1, −v]/Z. Since
    d(Exp(ω) p)/dω = −[p]×, a row a becomes −a [p]× = p × a with p = R x_obj. The weights are the
    derivative of r²/(r² + g²) by r², times g², with the gate g. Points behind the camera are
    ignored.
    """
    object_points, rays, whitening = points
    for c in range(6):
        gradient[c] = 0.0
        for d in range(6):
            hessian[c, d] = 0.0
    rows, jacobian = np.empty((2, 6)), np.empty(6)
    for i in range(len(rays)):
        squared = errors[i, 0] ** 2 + errors[i, 1] ** 2
        if not squared >= 0.0:
            continue
        x, y, z = object_points[i, 0], object_points[i, 1], object_points[i, 2]
        px = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
        py = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
        pz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
        inverse = 1.0 / (pz + t[2])
        u, v = (px + t[0]) * inverse, (py + t[1]) * inverse
        rows[0, 0], rows[0, 1], rows[0, 2] = -u * py, pz + u * px, -py
        rows[1, 0], rows[1, 1], rows[1, 2] = -v * py - pz, v * px, px
        rows[0, 3], rows[0, 4], rows[0, 5] = 1.0, 0.0, -u
        rows[1, 3], rows[1, 4], rows[1, 5] = 0.0, 1.0, -v
        weight = (gate**2 / (squared + gate**2)) ** 2
        for r in range(2):
            a, b = whitening[i, r, 0] * inverse, whitening[i, r, 1] * inverse
            for c in range(6):
                jacobian[c] = a * rows[0, c] + b * rows[1, c]
            for c in range(6):
                gradient[c] += weight * jacobian[c] * errors[i, r]
                for d in range(c + 1):
                    hessian[c, d] += weight * jacobian[c] * jacobian[d]
    for c in range(6):
        for d in range(c):
            hessian[d, c] = hessian[c, d]


@compiled()
def solve_damped(hessian: Array, gradient: Array, damping: float, step: Array) -> None:
    """Write the solution of (H + damping·I) step = −gradient, with H scaled to a unit diagonal."""
    solve_inside(hessian, gradient, damping, step, np.empty((7, 6)))


@compiled()
def solve_inside(
    hessian: Array, gradient: Array, damping: float, step: Array, workspace: Array
) -> None:
    """Like :func:`solve_damped`, in a (7, 6) workspace that a loop allocates once."""
    L, scale = workspace[:6], workspace[6]
    for i in range(6):
        scale[i] = 1.0 / math.sqrt(hessian[i, i] + 1e-12)
    for i in range(6):
        for j in range(i + 1):
            value = hessian[i, j] * scale[i] * scale[j]
            if i == j:
                value += damping
            for k in range(j):
                value -= L[i, k] * L[j, k]
            # A smaller value would be a rounding error.
            L[i, j] = math.sqrt(max(value, MIN_DAMPING**2)) if i == j else value / L[j, j]
    for i in range(6):
        step[i] = -scale[i] * gradient[i]
        for k in range(i):
            step[i] -= L[i, k] * step[k]
        step[i] /= L[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            step[i] -= L[k, i] * step[k]
        step[i] /= L[i, i]
    for i in range(6):
        step[i] *= scale[i]


@compiled()
def apply_rotation(step: Array, R: Array, out: Array) -> None:
    """Write Exp(ω) R into ``out``; ω, a rotation vector, is the first three numbers of a step."""
    x, y, z = step[0], step[1], step[2]
    angle = math.sqrt(x * x + y * y + z * z)
    a, b = 1.0, 0.5
    if angle > _TINY_ANGLE:
        half = math.sin(0.5 * angle) / angle
        a, b = math.sin(angle) / angle, 2.0 * half * half
    # Exp(ω) p = p + a ω × p + b ω × (ω × p).
    for c in range(3):
        px, py, pz = R[0, c], R[1, c], R[2, c]
        qx, qy, qz = y * pz - z * py, z * px - x * pz, x * py - y * px
        out[0, c] = px + a * qx + b * (y * qz - z * qy)
        out[1, c] = py + a * qy + b * (z * qx - x * qz)
        out[2, c] = pz + a * qz + b * (x * qy - y * qx)


def degenerate(points: Points, to_px: Float[np.ndarray, "2 2"]) -> str:
    """Return why the points do not determine a pose, or an empty string.

    Here, points are in metres, and the whitenings map pixels instead of rays. ``to_px`` maps rays
    to pixels.
    """
    count = len(points.rays)
    if count < MIN_POINTS:
        return too_few(count)
    extent, length, breadth, distinct, image_length, image_breadth, noise = _spreads(points, to_px)
    if not SMALLEST < extent < LARGEST:
        return f"the object points extend over {extent:.3g} m"
    if breadth < 1e-6 * length:
        return "the object points lie on one line"
    if distinct < MIN_POINTS:
        return f"only {int(distinct)} distinct pixels, {MIN_POINTS} are needed"
    if image_breadth < 1e-3 * image_length:
        return "the pixels lie on one line"
    if math.hypot(image_length, image_breadth) < noise * math.sqrt(count):
        return "the pixels spread no wider than their own noise"
    return ""


def too_few(num_points: int) -> str:
    """Return the error message that states how many points are usable and how many are needed."""
    return f"only {num_points} usable points, {MIN_POINTS} are needed"


@compiled()
def _spreads(
    points: Points, to_px: Array
) -> tuple[float, float, float, float, float, float, float]:
    """Return the spreads that :func:`degenerate` compares.

    The values are the object's extent (metres), the object's two largest singular values divided
    by the extent, the number of distinct pixels, the pixels' two singular values, and the median
    deviation (det W)^(−1/2), both in pixels.
    """
    object_points, rays, whitening = points
    n, extent = len(rays), 0.0
    for axis in range(3):
        lowest = highest = object_points[0, axis]
        for i in range(n):
            lowest = min(lowest, object_points[i, axis])
            highest = max(highest, object_points[i, axis])
        extent = max(extent, highest - lowest)
    centred, spread, sigma = np.empty((n, 3)), np.empty((n, 2)), np.empty(n)
    for axis in range(3):
        mean = column_mean(object_points, axis)
        for i in range(n):
            centred[i, axis] = (object_points[i, axis] - mean) / extent  # NaN for a single position
    for i in range(n):
        deviation = (whitening[i, 0, 0] * whitening[i, 1, 1]) ** -0.5
        rank = i
        while rank > 0 and sigma[rank - 1] > deviation:
            sigma[rank] = sigma[rank - 1]
            rank -= 1
        sigma[rank] = deviation
        for axis in range(2):
            spread[i, axis] = to_px[axis, 0] * rays[i, 0] + to_px[axis, 1] * rays[i, 1]
    distinct = 0.0
    for i in range(n):
        new = True
        for j in range(i):
            dx, dy = spread[i, 0] - spread[j, 0], spread[i, 1] - spread[j, 1]
            new &= abs(dx) > SAME_PIXEL or abs(dy) > SAME_PIXEL
        distinct += new
    for axis in range(2):
        mean = column_mean(spread, axis)
        for i in range(n):
            spread[i, axis] -= mean
    solid = np.linalg.svd(centred, False)[1] if np.isfinite(centred).all() else np.zeros(3)
    flat = np.linalg.svd(spread, False)[1] if np.isfinite(spread).all() else np.zeros(2)
    median = 0.5 * (sigma[(n - 1) // 2] + sigma[n // 2])
    return extent, solid[0], solid[1], distinct, flat[0], flat[1], median


@compiled()
def column_mean(rows: Array, column: int) -> float:
    """Return the mean of a column of a 2-D array."""
    total = 0.0
    for i in range(len(rows)):
        total += rows[i, column]
    return total / len(rows)
