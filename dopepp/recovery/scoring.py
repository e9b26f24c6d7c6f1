"""The options of the way from maps to poses, and what validation images teach about them.

``evaluate.py tune=true`` fits three things. Distance: a network's keypoints are means over the
poses it holds possible, and the mean of a turned figure is a smaller one, so its poses are too far
away by about the same factor. Covariance: peaks tell how uncertain each keypoint is, not what is
wrong with all of them alike. Score: how likely a detection's ADD is below a tenth of the diameter,
a logistic model; with the default weights the score is the mean belief. To add a feature, name it
in :data:`FEATURES`, compute it in :func:`detection_features` and give ``RecoveryOptions`` its
weight.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Final

import numpy as np
from jaxtyping import Bool, Float

from dopepp.core.compiled import Array, compiled
from dopepp.core.validation import STRICT, Range, parse
from dopepp.geometry.camera import (
    CameraMatrix,
    project,
    project_keypoints,
    transform,
)
from dopepp.geometry.cuboid import NUM_CORNERS, Cuboid
from dopepp.recovery.detection import Detection

FEATURES: Final = ("bias", "belief", "spread", "misfit", "found")  # Of the score, in this order

REFINED_FEATURES: Final = ("bias", "score", "agreement", "support")
"""Of the score of a refined pose."""

CANDIDATE: Final = 0.005
"""Score from which a detection is refined where the refined poses have a score of their own: the
picture, looked at closely, tells a ghost from a part that the network was in doubt about."""

DISTANCE_FACTORS: Final = (0.5, 2.0)
"""Smallest and greatest; trained networks' are within a tenth of 1."""

COVARIANCE_FACTORS: Final = (0.01, 100.0)  # Smallest and greatest; trained networks' are 1 to 4

_TENTH_BEYOND: Final = 10.645
"""Squared Mahalanobis distance in 6D that a tenth exceeds (chi-squared)."""

_CERTAIN: Final = 1e-3  # Beliefs nearer to 0 or 1 than this are all the same

_EXPONENTS: Final = 4.0  # Logarithms are cut off beyond this: outliers must not rule the score
_TYPICAL_MISFIT: Final = 0.01  # Reprojection error over the size in the image, neither good nor bad

PASSING: Final = 0.1  # ADD over the diameter below which a pose is right

_RIDGE: Final = 0.1  # Weight of the squared weights, in detections, which keeps them finite

_STEPS: Final = 50


_MEAN_BELIEF: Final = tuple(float(name == "belief") for name in FEATURES)
"""The score is the mean belief."""

_NETWORK_SCORE: Final = tuple(float(name == "score") for name in REFINED_FEATURES)
"""A refined pose keeps the network's score."""


_Belief = Annotated[float, Range(1e-6, 1.0)]
_Score = Annotated[float, Range(0.0, 1.0)]
_Weight = Annotated[float, Range(-1000.0, 1000.0)]  # fitted ones are a hundred times smaller


@dataclass(frozen=True)
class RecoveryOptions:
    """Thresholds of the way from maps to poses; stored in the checkpoint.

    Attributes:
        sigma: Width of a perfect belief peak, cells.
        peak_threshold: Belief below which a corner's maximum is no peak.
        centroid_threshold: Belief below which there is no instance.
        max_angle_deg: Largest angle between a corner's vector and its centroid, degrees.
        max_peaks: Most peaks kept per channel.
        min_score: Detections below this score are dropped.
        distance_factor: On the distance of every pose, as ``evaluate.py tune=true`` measures it.
        covariance_factor: On the covariance of every pose, likewise; the score does not change.
        score_bias: The first weight of the score's features, as ``evaluate.py tune=true`` fits
            them; these defaults leave the mean belief.
        refined_min_score: Refined detections below this score are dropped.
        refined_bias: The first weight of the score of refined poses, as ``evaluate.py tune=true
            refine=region`` fits them; these defaults leave the network's score.
    """

    __pydantic_config__ = STRICT

    sigma: Annotated[float, Range(0.1, 100.0, "cells")] = 1.0
    peak_threshold: _Belief = 0.02
    centroid_threshold: _Belief = 0.05
    max_angle_deg: Annotated[float, Range(1e-3, 180.0, "degrees")] = 45.0
    max_peaks: Annotated[int, Range(1, 1000)] = 16
    min_score: _Score = 0.0
    distance_factor: Annotated[float, Range(*DISTANCE_FACTORS)] = 1.0
    covariance_factor: Annotated[float, Range(*COVARIANCE_FACTORS)] = 1.0
    score_bias: _Weight = 0.0
    score_belief: _Weight = 1.0
    score_spread: _Weight = 0.0
    score_misfit: _Weight = 0.0
    score_found: _Weight = 0.0
    refined_min_score: _Score = 0.0
    refined_bias: _Weight = 0.0
    refined_score: _Weight = 1.0
    refined_agreement: _Weight = 0.0
    refined_support: _Weight = 0.0

    @classmethod
    def of(cls, options: Mapping[str, float]) -> RecoveryOptions:
        """Check the options of a config, a checkpoint or a caller.

        Raises:
            UserError: A name is unknown, or a value is out of its range.
        """
        return parse(cls, options, "recovery")

    @property
    def score_weights(self) -> tuple[float, ...]:
        """Weights of the score's features, in their order."""
        return tuple(getattr(self, f"score_{name}") for name in FEATURES)

    @property
    def refined_weights(self) -> tuple[float, ...]:
        """Weights of the features of a refined pose's score, in their order."""
        return tuple(getattr(self, f"refined_{name}") for name in REFINED_FEATURES)

    def unrefined(self) -> RecoveryOptions:
        """Return the options with nothing learned about refined poses."""
        defaults = {field.name: field.default for field in fields(self)}
        return replace(self, **{k: v for k, v in defaults.items() if k.startswith("refined_")})  # type: ignore[arg-type]

    def of_candidates(self) -> RecoveryOptions:
        """Return the options that keep every detection that refinement is to judge."""
        if self.refined_weights == _NETWORK_SCORE:
            return self
        return replace(self, min_score=min(self.min_score, CANDIDATE))


def calibrated(
    detection: Detection, cuboid: Cuboid, K: CameraMatrix, options: RecoveryOptions
) -> Detection:
    """Return a detection at its corrected distance, with its score and corrected covariance.

    The part moves along the ray through its origin. With the default weights the score is the mean
    belief.
    """
    if options.distance_factor != 1.0:
        T = detection.T_cam_obj.copy()
        T[:3, 3] *= options.distance_factor
        keypoints = project_keypoints(cuboid, T, K)
        detection = replace(detection, T_cam_obj=T, keypoints=keypoints)
    probability = detection.belief
    if options.score_weights != _MEAN_BELIEF:
        features = detection_features(detection, cuboid, K)
        probability = float(score(features, np.array(options.score_weights)))
    covariance = options.covariance_factor * detection.covariance
    return replace(detection, score=probability, covariance=covariance)


def rescored(refined: Sequence[Detection], options: RecoveryOptions) -> list[Detection]:
    """Return the detections that refinement has judged, with their scores, the best first."""
    if options.refined_weights != _NETWORK_SCORE:
        weights = np.array(options.refined_weights)
        scores = [float(score(refined_features(detection), weights)) for detection in refined]
        refined = [replace(old, score=new) for old, new in zip(refined, scores, strict=True)]
    passed = [one for one in refined if one.score >= options.refined_min_score]
    return sorted(passed, key=lambda one: -one.score)


def refined_features(detection: Detection) -> Float[np.ndarray, "features"]:
    """Return the features of a refined detection, whose score is still the network's."""
    sure = float(np.clip(detection.score, _CERTAIN, 1 - _CERTAIN))
    known = detection.agreement or 0.0, detection.support or 0.0
    return np.array([1.0, np.log(sure / (1 - sure)), *known])


def fit_distance_factor(
    estimated: Float[np.ndarray, "n 4 4"], true: Float[np.ndarray, "n 4 4"]
) -> float:
    """Return the median ratio of true to estimated distance; 1 without poses."""
    if not len(estimated):
        return 1.0
    distances = [np.linalg.norm(T[:, :3, 3], axis=1) for T in (true, estimated)]
    return float(np.clip(np.median(distances[0] / distances[1]), *DISTANCE_FACTORS))


def fit_covariance_factor(squared_distances: Float[np.ndarray, "n"]) -> float:
    """Return the factor that makes true poses as far from estimates as covariances say.

    Compared is what nine of ten squared Mahalanobis distances, found with a factor of 1, do not
    exceed: their tails are heavier than a Gaussian's, and refinement, whose prior this is, must
    reach the truth.
    """
    if not len(squared_distances):
        return 1.0
    factor = float(np.quantile(squared_distances, 0.9)) / _TENTH_BEYOND
    return float(np.clip(factor, *COVARIANCE_FACTORS))


def detection_features(
    detection: Detection, cuboid: Cuboid, K: CameraMatrix
) -> Float[np.ndarray, "features"]:
    """Return the features of one detection, of which anything but the score is read."""
    T, corners = detection.T_cam_obj, cuboid[:NUM_CORNERS]
    size = float(np.linalg.norm(np.ptp(corners, axis=0)))
    pixels = project(transform(T, corners), K)
    # A corner without a peak may lie behind the camera, where it has no pixel.
    seen = pixels[np.isfinite(pixels).all(axis=1)]
    extent = max(float(np.ptp(seen, axis=0).max()), 1.0) if len(seen) else 1.0
    sure = float(np.clip(detection.belief, _CERTAIN, 1 - _CERTAIN))
    spread = _expected_distance(detection.covariance, corners @ T[:3, :3].T) / size
    misfit = max(detection.reprojection_error_px, 1e-9) / (extent * _TYPICAL_MISFIT)
    logarithms = np.log([sure / (1 - sure), max(spread, 1e-9) / PASSING, misfit])
    missing = float(np.isfinite(detection.peaks).all(axis=1).mean()) - 1
    return np.array([1.0, *np.clip(logarithms, -2 * _EXPONENTS, 2 * _EXPONENTS), missing])


def score(
    features: Float[np.ndarray, "*n features"], weights: Float[np.ndarray, "features"]
) -> Float[np.ndarray, "*n"]:
    """Return the probability that each pose is right, in (0, 1)."""
    return np.asarray(1 / (1 + np.exp(-np.clip(features @ weights, -30, 30))))


def fit_weights(
    features: Float[np.ndarray, "n features"], correct: Bool[np.ndarray, "n"]
) -> Float[np.ndarray, "features"]:
    """Fit the weights by maximum likelihood (Newton's method) with a ridge.

    A detection without an instance is not correct. A ``ValueError``: all or no detections are
    right.
    """
    correct = np.asarray(correct, bool)
    if not correct.any() or correct.all():
        raise ValueError("a score needs right and wrong detections to learn from")
    weights = np.zeros(features.shape[1])
    ridge = _RIDGE * np.eye(len(weights))
    ridge[0, 0] = 0.0  # the share of right ones is known well
    for _ in range(_STEPS):
        said = score(features, weights)
        gradient = features.T @ (correct - said) - ridge @ weights
        hessian = (features * (said * (1 - said))[:, None]).T @ features + ridge
        step = np.linalg.lstsq(hessian, gradient, rcond=None)[0]
        weights = weights + step * min(1.0, _EXPONENTS / max(float(np.abs(step).max()), 1e-12))
        if np.abs(step).max() < 1e-9:
            break
    return weights


@compiled()
def _expected_distance(covariance: Array, points: Array) -> float:
    """Return the RMS distance by which points (camera axes, from the origin) are uncertain."""
    total = 0.0
    moves = np.zeros((3, 6))
    for row in range(3):
        moves[row, 3 + row] = 1.0
    for x, y, z in points:
        # A turn ω moves p by ω × p.
        moves[0, 1], moves[0, 2], moves[1, 2] = z, -y, x
        moves[1, 0], moves[2, 0], moves[2, 1] = -z, y, -x
        for row in range(3):
            for a in range(6):
                for b in range(6):
                    total += moves[row, a] * covariance[a, b] * moves[row, b]
    return math.sqrt(max(total, 0.0) / len(points))
