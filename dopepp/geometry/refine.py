"""Robust refinement of poses: damped Gauss–Newton on SE(3), several starts in one batch.

Object points are centred and of unit size and pixels are rays here, so that one set of numerical
tolerances serves every part and camera. A pose is (R, t) with x_cam = R x_obj + t.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from dopepp.geometry.rotation import rotation_vector_to_matrix

GATE: Final = 3.0
"""Points beyond this many standard deviations are outliers (99.7 % of a Gaussian lies within)."""

MAX_STEPS: Final = 15
CONVERGED: Final = 1e-4
"""Relative fall of the cost below which a pose has arrived: far less than one point's noise."""

ROUNDING: Final = 1e-12
"""Fall of the cost that is none: a point that moves by a millionth of its deviation."""

FIRST_DAMPING: Final = 1e-4

LEAST_DAMPING: Final = 1e-9
"""Above the rounding of the scaled 6×6 system, so that it is never singular."""

MOST_DAMPING: Final = 1e6
"""Where steps are a millionth of Gauss–Newton's and still do not help, the pose has arrived."""


@dataclass(frozen=True)
class Poses:
    """Several poses.

    Attributes:
        rotations: R of each.
        translations: t of each, in object sizes.
    """

    rotations: Float[np.ndarray, "s 3 3"]
    translations: Float[np.ndarray, "s 3"]

    def __len__(self) -> int:
        return len(self.translations)

    def __getitem__(self, chosen: NDArray[Any] | slice) -> Poses:
        return Poses(self.rotations[chosen], self.translations[chosen])

    def __add__(self, more: Poses) -> Poses:
        return Poses(
            np.concatenate([self.rotations, more.rotations]),
            np.concatenate([self.translations, more.translations]),
        )


@dataclass(frozen=True)
class Correspondences:
    """Object points, the rays they are seen along, and how well these are known.

    Attributes:
        object_points: Points in the object frame, centred and of unit size.
        rays: (x/z, y/z) of their pixels.
        to_px: Upper left block of K: turns a difference of rays into pixels.
        sigma: Standard deviation of each pixel position (isotropic), pixels.
    """

    object_points: Float[np.ndarray, "n 3"]
    rays: Float[np.ndarray, "n 2"]
    to_px: Float[np.ndarray, "2 2"]
    sigma: Float[np.ndarray, "n"]

    def residuals(self, poses: Poses) -> Float[np.ndarray, "s n 2"]:
        """Return reprojection errors in standard deviations; NaN behind the camera."""
        points = self.object_points @ poses.rotations.transpose(0, 2, 1)
        points = points + poses.translations[:, None]
        depth = np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
        differences = points[..., :2] / depth - self.rays
        return np.asarray(differences @ self.to_px.T / self.sigma[:, None])


def refine(points: Correspondences, poses: Poses) -> Poses:
    """Minimise the Geman–McClure cost Σ r²/(r² + g²) from each start; r in standard deviations.

    A step that does not lower the cost is undone and damped more (Levenberg–Marquardt). A start
    with points behind the camera is returned as it is.
    """
    poses = Poses(poses.rotations.copy(), poses.translations.copy())
    residuals = points.residuals(poses)
    cost = _robust_cost(residuals)
    damping = np.full(len(cost), FIRST_DAMPING)
    active = np.isfinite(residuals).all((1, 2))
    for _ in range(MAX_STEPS):
        if not active.any():
            break
        moved = _move(poses, _step(points, poses, residuals, damping))
        moved_residuals = points.residuals(moved)
        moved_cost = _robust_cost(moved_residuals)
        better = active & (moved_cost < cost)
        arrived = better & (cost - moved_cost <= CONVERGED * cost + ROUNDING)
        poses.rotations[better] = moved.rotations[better]
        poses.translations[better] = moved.translations[better]
        residuals[better], cost[better] = moved_residuals[better], moved_cost[better]
        damping = np.where(better, np.maximum(damping / 10, LEAST_DAMPING), damping * 10)
        active &= ~arrived & (damping < MOST_DAMPING)
    return poses


def _move(poses: Poses, step: Float[np.ndarray, "s 6"]) -> Poses:
    """Turn poses about their own origin and shift them: the update of the normal equations."""
    turned = rotation_vector_to_matrix(step[:, :3]) @ poses.rotations
    return Poses(turned, poses.translations + step[:, 3:])


def _robust_cost(residuals: Float[np.ndarray, "s n 2"]) -> Float[np.ndarray, "s"]:
    """Return Σ r²/(r² + g²), written so that an infinite or unknown r counts as 1."""
    squared = (residuals**2).sum(-1)
    return np.asarray(residuals.shape[1] - np.nansum(GATE**2 / (squared + GATE**2), axis=-1))


def _step(
    points: Correspondences,
    poses: Poses,
    residuals: Float[np.ndarray, "s n 2"],
    damping: Float[np.ndarray, "s"],
) -> Float[np.ndarray, "s 6"]:
    """Solve the damped normal equations for a left increment (rotation vector, translation)."""
    squared = (residuals**2).sum(-1, keepdims=True)
    # Square root of Geman–McClure's weight, the derivative of r²/(r² + g²) by r², up to g².
    weight = GATE**2 / (squared + GATE**2)
    jacobian = _jacobian(points, poses) * weight[..., None]
    jacobian = jacobian.reshape(len(poses), -1, 6)
    transposed = jacobian.transpose(0, 2, 1)
    gradient = transposed @ (residuals * weight).reshape(len(poses), -1, 1)
    hessian = transposed @ jacobian
    # Scaled to a unit diagonal, rotations and translations of any size are damped alike.
    scale = 1 / np.sqrt(np.diagonal(hessian, axis1=1, axis2=2) + 1e-12)
    scaled = hessian * scale[:, :, None] * scale[:, None, :] + damping[:, None, None] * np.eye(6)
    return np.asarray(-scale * np.linalg.solve(scaled, scale[..., None] * gradient)[..., 0])


def _jacobian(points: Correspondences, poses: Poses) -> Float[np.ndarray, "s n 2 6"]:
    """Differentiate the residuals by a left increment of each pose.

    A ray (u, v) = (X, Y)/Z moves with x_cam by the rows [1, 0, −u]/Z and [0, 1, −v]/Z. Since
    d(Exp(ω) p)/dω = −[p]×, a row a becomes −a [p]× = p × a with p = R x_obj.
    """
    p = points.object_points @ poses.rotations.transpose(0, 2, 1)
    camera = p + poses.translations[:, None]
    inverse = 1 / camera[..., 2]
    u, v = camera[..., 0] * inverse, camera[..., 1] * inverse
    rows = np.zeros((*u.shape, 2, 6))
    rows[..., 0, 0] = -u * p[..., 1]
    rows[..., 0, 1] = p[..., 2] + u * p[..., 0]
    rows[..., 0, 2] = -p[..., 1]
    rows[..., 1, 0] = -v * p[..., 1] - p[..., 2]
    rows[..., 1, 1] = v * p[..., 0]
    rows[..., 1, 2] = p[..., 0]
    rows[..., 0, 3] = rows[..., 1, 4] = 1
    rows[..., 0, 5], rows[..., 1, 5] = -u, -v
    rows *= (inverse / points.sigma)[..., None, None]
    return np.asarray(points.to_px @ rows)
