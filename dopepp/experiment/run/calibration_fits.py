"""Fits of the corrections of distance, covariance and score (:mod:`dopepp.recovery.detection`)."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from dopepp.core.errors import UserError
from dopepp.recovery.detection import (
    COVARIANCE_FACTORS,
    DISTANCE_FACTORS,
    REFINED_COVARIANCE_FACTORS,
    score,
)

# Squared Mahalanobis distances that 75 % and 10 % of 6D Gaussian errors exceed.
_QUARTER: Final = 3.455
_TENTH_BEYOND: Final = 10.645
_WRONG_RANGE: Final = math.log(1e6)  # range of ln(squared distance) of wrong poses
_RIDGE: Final = 0.1  # weight of the squared weights, in detections; keeps the weights finite
_DEFAULTS_RIDGE: Final = 1.0  # weight of the squared distance from default weights, in detections
_STEPS: Final = 50  # maximum number of iterations of a fit
_MAX_STEP: Final = 4.0  # limit of a Newton step, so that outliers do not dominate


def fit_distance_factor(
    estimated: Float[np.ndarray, "n 4 4"], true: Float[np.ndarray, "n 4 4"]
) -> float:
    """Return the median ratio of true to estimated distance, from T_cam_obj; 1 without poses."""
    if not len(estimated):
        return 1.0
    distances = [np.linalg.norm(T[:, :3, 3], axis=1) for T in (true, estimated)]
    return float(np.clip(np.median(distances[0] / distances[1]), *DISTANCE_FACTORS))


def fit_covariance_factor(
    squared_distances: Float[np.ndarray, "n"], *, refined: bool = False
) -> float:
    """Return the factor by which covariances must be multiplied to match the poses' errors.

    The squared distances are a mixture: of correct poses, with a multiple of χ² with six degrees of
    freedom, and of wrong poses, with uniform logarithms. Expectation-maximisation separates the
    two. The factor matches the 90 % quantile of the correct poses: their errors have heavier tails
    than a Gaussian, and refinement, which uses the covariance as its prior, must reach the true
    pose.

    Args:
        squared_distances: Squared Mahalanobis distances of estimated from true poses, under the
            uncorrected covariances.
        refined: Whether the poses were refined.

    Raises:
        UserError: The factor is outside :data:`COVARIANCE_FACTORS`, or for refined poses outside
            :data:`REFINED_COVARIANCE_FACTORS`.
    """
    squared = np.asarray(squared_distances, np.float64)
    squared = squared[np.isfinite(squared) & (squared > 0)]
    if not len(squared):
        return 1.0
    factor, share = float(np.quantile(squared, 0.25)) / _QUARTER, 0.5
    for _ in range(_STEPS):
        ratio = squared / factor
        # Densities of the logarithm: s·χ²₆(s) of correct poses, and a constant for incorrect poses.
        right = share * ratio**3 * np.exp(-ratio / 2) / 16
        certainty = right / (right + (1 - share) / _WRONG_RANGE)
        share = float(np.clip(certainty.mean(), 0.01, 0.99))
        factor = float((certainty * squared).sum() / (6 * max(certainty.sum(), 1e-9)))
    order = np.argsort(squared)
    passed = np.cumsum(certainty[order]) / certainty.sum()
    factor = float(squared[order[np.searchsorted(passed, 0.9)]]) / _TENTH_BEYOND
    low, high = REFINED_COVARIANCE_FACTORS if refined else COVARIANCE_FACTORS
    if not low <= factor <= high:
        tendency = "confident" if factor > high else "cautious"
        causes = f"train longer, because the network is far too {tendency}; or, if"
        if refined:
            causes = f"the refinement is far too {tendency}; check the mesh and scale_error; if"
        raise UserError(
            f"covariances that must be multiplied by {factor:.3g} to match the poses' errors",
            f"a factor from {low:g} to {high:g}",
            f"{causes} the part looks the same in several orientations, state its symmetries with "
            "data.symmetries=auto",
        )
    return factor


def fit_weights(
    features: Float[np.ndarray, "n features"],
    correct: Bool[np.ndarray, "n"],
    defaults: Float[np.ndarray, "features"] | None = None,
) -> Float[np.ndarray, "features"]:
    """Fit the score's weights by maximum likelihood (Newton's method) and a ridge penalty.

    Args:
        features: Features of the detections.
        correct: Whether each pose is correct; False for a detection where there is no part.
        defaults: Weights from which deviations are penalised (default: 0).

    Raises:
        ValueError: All or no detections are correct.
    """
    correct = np.asarray(correct, bool)
    if not correct.any() or correct.all():
        raise ValueError("a score needs correct and incorrect detections to learn from")
    if defaults is None:
        defaults = np.zeros(features.shape[1])
        ridge = _RIDGE * np.eye(len(defaults))
        ridge[0, 0] = 0.0  # the share of correct detections is well determined
    else:
        ridge = _DEFAULTS_RIDGE * np.eye(len(defaults))
    weights = defaults.copy()
    for _ in range(_STEPS):
        predicted = score(features, weights)
        gradient = features.T @ (correct - predicted) - ridge @ (weights - defaults)
        hessian = (features * (predicted * (1 - predicted))[:, None]).T @ features + ridge
        step = np.linalg.lstsq(hessian, gradient, rcond=None)[0]
        weights = weights + step * min(1.0, _MAX_STEP / max(float(np.abs(step).max()), 1e-12))
        if np.abs(step).max() < 1e-9:
            break
    return weights
