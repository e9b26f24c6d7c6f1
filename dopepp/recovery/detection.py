"""Detections with their calibrated scores and covariances, and the options of the recovery.

``evaluate.py tune=true`` fits three corrections on validation images:

- Distance: a network's keypoints are means over the poses that it considers possible, and the mean
  of a rotated shape is smaller. Poses are therefore too far away, by about the same factor.
- Covariance: peaks predict independent errors of keypoints, not their common errors.
- Score: a logistic model of the probability that the pose is correct, i.e. that ADD is below a
  tenth of the diameter. With the default weights, the score is the mean belief.

To add a feature of the score, name it in :data:`FEATURES`, compute it in
:func:`detection_features` and add its weight to :class:`RecoveryOptions`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Final

import numpy as np
from jaxtyping import Float

from dopepp.core.compiled import Array, compiled
from dopepp.core.validation import STRICT, Range, parse
from dopepp.geometry.camera import CameraMatrix, Transform, project, project_keypoints, transform
from dopepp.geometry.cuboid import NUM_CORNERS, Cuboid
from dopepp.geometry.pnp import PnPResult
from dopepp.recovery.association import KeypointGroup

FEATURES: Final = ("bias", "belief", "spread", "misfit", "found")  # features of the score
REFINED_FEATURES: Final = ("bias", "score", "verification")  # features of a refined pose's score

_FORMER_FEATURES: Final = frozenset({"refined_agreement", "refined_support"})

CANDIDATE: Final = 0.005
"""Network score from which a detection is refined. It is low, because verification distinguishes
false detections from parts with a low score."""

DISTANCE_FACTORS: Final = (0.5, 2.0)  # range; factors of trained networks are 0.9 to 1.1
COVARIANCE_FACTORS: Final = (0.5, 4.0)  # range; factors of trained networks are 0.8 to 3
REFINED_COVARIANCE_FACTORS: Final = (0.1, 4.0)
"""Range for refined poses. Refinement assumes errors that renders do not have, e.g. shadows and
inaccurate meshes, so its covariances are too large on renders."""

PROBABLE: Final = 0.5
"""Score or probability from which a pose is kept without trying an alternative."""

PASSING: Final = 0.1  # ADD, in diameters, below which a pose is correct

_CERTAIN: Final = 1e-3  # beliefs are clipped to this distance from 0 and 1
_MAX_LOGARITHM: Final = 8.0  # limit of a feature, so that outliers do not dominate
_TYPICAL_MISFIT: Final = 0.01  # average reprojection error / size in the image
_MEAN_BELIEF: Final = tuple(float(name == "belief") for name in FEATURES)
_VERIFIED: Final = 1e-4  # verified probabilities are limited to this distance from 0 and 1


@dataclass(frozen=True)
class Detection:
    """An object detected on an image, with its pose.

    Attributes:
        object: Name of the part.
        score: Confidence in the pose, in [0, 1]: the mean belief or, for tuned checkpoints, the
            probability that ADD is below a tenth of the diameter.
        belief: Mean belief over the nine keypoints, in [0, 1]; keypoints that are missing or do not
            agree with the pose count 0.
        T_cam_obj: Object-to-camera transform, metres, OpenCV camera frame.
        keypoints: The cuboid's corners and centroid projected with this pose, pixels.
        peaks: Measured keypoints, pixels; NaN for keypoints that are missing or do not agree with
            the pose.
        reprojection_error_px: RMS distance between ``peaks`` and the keypoints at the pose before
            ``distance_factor`` and before refinement, pixels.
        covariance: Covariance of a small rotation about the object's origin (rotation vector in
            the camera frame, radians) and a small translation (camera frame, metres).
        kept: Why the refinement kept the network's pose; empty otherwise.
        agreement: Share of the information of colours and edges along the outline that agrees with
            the refined pose, in [0, 1]; None without refinement.
        support: Share of the refined outline with agreeing information, in [0, 1]; occluded points
            have no information. None without refinement.
        probability: Probability that ADD(-S) is below a tenth of the diameter, from the image at
            the refined pose (:mod:`dopepp.inference.refinement.verification`); None without
            refinement by region.
        start: Pose and covariance from which refinement started; None without refinement.
        alternative: Detection of the same instance at the pose of :mod:`~.search`. It is refined if
            the refined first pose is improbable, and replaces the first pose if it is probable.
    """

    object: str
    score: float
    belief: float
    T_cam_obj: Transform
    keypoints: Float[np.ndarray, "9 2"]
    peaks: Float[np.ndarray, "9 2"]
    reprojection_error_px: float
    covariance: Float[np.ndarray, "6 6"]
    kept: str = ""
    agreement: float | None = None
    support: float | None = None
    probability: float | None = None
    start: tuple[Transform, Float[np.ndarray, "6 6"]] | None = None
    alternative: Detection | None = None


_Belief = Annotated[float, Range(1e-6, 1.0)]
_Score = Annotated[float, Range(0.0, 1.0)]
_Weight = Annotated[float, Range(-1000.0, 1000.0)]  # fitted weights are a hundred times smaller


@dataclass(frozen=True)
class RecoveryOptions:
    """Thresholds of the recovery from maps to poses; stored in the checkpoint.

    Attributes:
        sigma: Standard deviation of a target's belief peak, cells.
        field_radius: Radius of the disc around a corner that carries its vector, cells.
        peak_threshold: Belief below which a local maximum of a map does not count as a peak.
        centroid_threshold: Belief below which a centroid's peak is not an instance.
        max_angle_deg: Largest angle between the field's vector at a corner and the direction to the
            centroid, degrees.
        max_peaks: Maximum number of peaks per channel.
        min_score: Smallest score of a detection. The default is for the mean belief of untuned
            networks.
        distance_factor: Factor on the distance of every pose, set by ``evaluate.py tune=true``.
        covariance_factor: Factor on the covariance of every pose, set by ``tune=true``.
        score_bias, score_belief, score_spread, score_misfit, score_found: Weights of the score's
            features, set by ``evaluate.py tune=true``; with the defaults, the score is the mean
            belief.
        refined_min_score: Smallest score of a refined detection.
        refined_bias, refined_score, refined_verification: Weights of the features of a refined
            pose's score, set by ``evaluate.py tune=true refine=region``; with the defaults, the
            score is ``Detection.probability``.
        refined_covariance_factor: Factor on the covariance of poses refined on the image alone, set
            by ``tune=true refine=region``.
    """

    __pydantic_config__ = STRICT

    sigma: Annotated[float, Range(0.1, 100.0, "cells")] = 1.0
    field_radius: Annotated[float, Range(0.1, 1000.0, "cells")] = 2.0
    peak_threshold: _Belief = 0.02
    centroid_threshold: _Belief = 0.05
    max_angle_deg: Annotated[float, Range(1e-3, 180.0, "degrees")] = 45.0
    max_peaks: Annotated[int, Range(1, 1000)] = 64
    min_score: _Score = 0.5
    distance_factor: Annotated[float, Range(*DISTANCE_FACTORS)] = 1.0
    covariance_factor: Annotated[float, Range(*COVARIANCE_FACTORS)] = 1.0
    score_bias: _Weight = 0.0
    score_belief: _Weight = 1.0
    score_spread: _Weight = 0.0
    score_misfit: _Weight = 0.0
    score_found: _Weight = 0.0
    refined_min_score: _Score = 0.5
    refined_bias: _Weight = 0.0
    refined_score: _Weight = 0.0
    refined_verification: _Weight = 1.0
    refined_covariance_factor: Annotated[float, Range(*REFINED_COVARIANCE_FACTORS)] = 1.0

    @classmethod
    def of(cls, options: Mapping[str, float]) -> RecoveryOptions:
        """Check values by field name, from a config, a checkpoint or a caller, and return options.

        Checkpoints of former versions have weights for other features of refined poses. Their
        ``refined_`` options are ignored, so the checkpoint must be tuned again.

        Raises:
            UserError: A name is unknown, or a value is out of its range.
        """
        if not _FORMER_FEATURES.isdisjoint(options):
            options = {k: v for k, v in options.items() if not k.startswith("refined_")}
        return parse(cls, options, "recovery")

    @property
    def score_weights(self) -> tuple[float, ...]:
        """Weights of :data:`FEATURES`."""
        return tuple(getattr(self, f"score_{name}") for name in FEATURES)

    @property
    def refined_weights(self) -> tuple[float, ...]:
        """Weights of :data:`REFINED_FEATURES`."""
        return tuple(getattr(self, f"refined_{name}") for name in REFINED_FEATURES)

    def unrefined(self) -> RecoveryOptions:
        """Return a copy with the default values of all ``refined_`` options."""
        defaults = {field.name: field.default for field in fields(self)}
        return replace(self, **{k: v for k, v in defaults.items() if k.startswith("refined_")})  # type: ignore[arg-type]


def make_detection(
    group: KeypointGroup,
    result: PnPResult,
    cuboid: Cuboid,
    K: CameraMatrix,
    name: str,
    options: RecoveryOptions,
) -> Detection | None:
    """Return the calibrated detection of an instance, or None if PnP found no pose.

    Args:
        group: Keypoints of the instance.
        result: Pose and inliers from PnP on these keypoints.
        cuboid: Keypoints of the part, object frame, metres.
        K: Camera matrix, pixels.
        name: Name of the part.
        options: Options with the factors of distance and covariance and the score's weights.
    """
    if result.T_cam_obj is None or result.covariance is None:
        return None
    belief = float(np.where(result.inliers, group.score, 0.0).clip(0.0, 1.0).mean())
    detection = Detection(
        object=name,
        score=belief,
        belief=belief,
        T_cam_obj=result.T_cam_obj,
        keypoints=project_keypoints(cuboid, result.T_cam_obj, K),
        peaks=np.where(result.inliers[:, None], group.position, np.nan),
        reprojection_error_px=result.reprojection_error_px,
        covariance=result.covariance,
    )
    return calibrate(detection, cuboid, K, options)


def calibrate(
    detection: Detection, cuboid: Cuboid, K: CameraMatrix, options: RecoveryOptions
) -> Detection:
    """Return a detection with corrected distance and covariance, and with its score.

    ``options.distance_factor`` scales the translation, so the origin keeps its pixel.
    """
    if options.distance_factor != 1.0:
        T = detection.T_cam_obj.copy()
        T[:3, 3] *= options.distance_factor
        detection = replace(detection, T_cam_obj=T)
    probability, keypoints = detection.belief, detection.keypoints
    if options.score_weights != _MEAN_BELIEF:
        features = detection_features(detection, cuboid, K)
        probability = float(score(features, np.array(options.score_weights)))
    if options.distance_factor != 1.0:
        keypoints = project_keypoints(cuboid, detection.T_cam_obj, K)
    covariance = options.covariance_factor * detection.covariance
    return replace(detection, keypoints=keypoints, score=probability, covariance=covariance)


def recalibrate(
    refined: Sequence[Detection], options: RecoveryOptions, by_depth: bool = False
) -> list[Detection]:
    """Return detections with the scores and covariances of refined poses, by descending score.

    Detections without verification keep the network's score. Detections that were not refined keep
    the network's covariance.

    Args:
        refined: Detections after refinement and verification.
        options: Options with the weights and the covariance factor of refined poses.
        by_depth: Whether a depth image was used. The covariance factor was fitted without depth
            images and is not applied then.
    """
    weights, factor = np.array(options.refined_weights), options.refined_covariance_factor
    calibrated = []
    for detection in refined:
        changed = detection
        if detection.probability is not None:
            judged = float(score(refined_features(detection), weights))
            changed = replace(changed, score=judged)
        if detection.agreement is not None and not by_depth:  # refined on the image
            changed = replace(changed, covariance=factor * detection.covariance)
        calibrated.append(changed)
    return sorted(calibrated, key=lambda detection: -detection.score)


def refined_features(detection: Detection) -> Float[np.ndarray, "features"]:
    """Return 1 and the log odds of the score (before refinement) and ``detection.probability``."""
    assert detection.probability is not None
    verified = _odds(detection.probability, _VERIFIED)
    return np.array([1.0, *np.log([_odds(detection.score), verified])])


def detection_features(
    detection: Detection, cuboid: Cuboid, K: CameraMatrix
) -> Float[np.ndarray, "features"]:
    """Return the values of :data:`FEATURES`, from which a logistic model computes the score.

    Features: 1, log odds of the mean belief, logarithms of the corners' expected error and of the
    reprojection error (both relative to the part's size), and negative share of missing keypoints.

    Args:
        detection: Detection before refinement.
        cuboid: Keypoints of the part, object frame, metres.
        K: Camera matrix, pixels.
    """
    T, corners = detection.T_cam_obj, cuboid[:NUM_CORNERS]
    size = float(np.linalg.norm(np.ptp(corners, axis=0)))
    pixels = project(transform(T, corners), K)
    # A corner without a peak may lie behind the camera, where it has no pixel.
    visible = pixels[np.isfinite(pixels).all(axis=1)]
    extent = max(float(np.ptp(visible, axis=0).max()), 1.0) if len(visible) else 1.0
    spread = expected_distance(detection.covariance, corners @ T[:3, :3].T) / size
    misfit = max(detection.reprojection_error_px, 1e-9) / (extent * _TYPICAL_MISFIT)
    logarithms = np.log([_odds(detection.belief), max(spread, 1e-9) / PASSING, misfit])
    missing = float(np.isfinite(detection.peaks).all(axis=1).mean()) - 1
    return np.array([1.0, *np.clip(logarithms, -_MAX_LOGARITHM, _MAX_LOGARITHM), missing])


def log_odds(probability: float) -> float:
    """Return the natural logarithm of a probability's odds, limited to about ±9.2."""
    return math.log(_odds(probability, _VERIFIED))


def to_probability(odds: float) -> float:
    """Return the probability whose odds have the natural logarithm ``odds``."""
    return 1.0 / (1.0 + math.exp(-odds))


def _odds(probability: float, certain: float = _CERTAIN) -> float:
    """Return the odds of a probability after clipping it to [certain, 1 − certain]."""
    bounded = float(np.clip(probability, certain, 1 - certain))
    return bounded / (1 - bounded)


def score(
    features: Float[np.ndarray, "*n features"], weights: Float[np.ndarray, "features"]
) -> Float[np.ndarray, "*n"]:
    """Return the probability, in (0, 1), that each pose is correct, by a logistic model."""
    return np.asarray(1 / (1 + np.exp(-np.clip(features @ weights, -30, 30))))


@compiled()
def expected_distance(covariance: Array, points: Array) -> float:
    """Return the RMS error of an object's points that a pose's covariance predicts, metres.

    Args:
        covariance: 6×6 covariance of rotation vector (radians) and translation (metres).
        points: Points relative to the object's origin, in the axes of the covariance, metres.
    """
    total = 0.0
    moves = np.zeros((3, 6))
    for row in range(3):
        moves[row, 3 + row] = 1.0
    for x, y, z in points:
        # A rotation ω moves p by ω × p.
        moves[0, 1], moves[0, 2], moves[1, 2] = z, -y, x
        moves[1, 0], moves[2, 0], moves[2, 1] = -z, y, -x
        for row in range(3):
            for a in range(6):
                for b in range(6):
                    total += moves[row, a] * covariance[a, b] * moves[row, b]
    return math.sqrt(max(total, 0.0) / len(points))
