"""Pose errors, the rates made of them, and the assignment of predictions to instances.

Functions are pure and batched, and compute in float64. Poses are ``(R_est, t_est, R_gt, t_gt)`` of
shapes (N, 3, 3), (N, 3), (N, 3, 3), (N, 3) in metres, ``T_cam_obj`` convention; object points are
(V, 3). Errors are (N,), infinite for poses that are not finite, and never NaN.

To add an error, write one function of this form in ``distances.py``, its formula in
``docs/reference/metrics.md`` and a test against an independent implementation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Final, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dopepp.metrics.functional.distances import BOP_MSPD_THRESHOLDS as BOP_MSPD_THRESHOLDS
from dopepp.metrics.functional.distances import BOP_THRESHOLDS as BOP_THRESHOLDS
from dopepp.metrics.functional.distances import VSD_DELTA as VSD_DELTA
from dopepp.metrics.functional.distances import Errors, nan_is_miss, to_float64
from dopepp.metrics.functional.distances import add as add
from dopepp.metrics.functional.distances import add_s as add_s
from dopepp.metrics.functional.distances import mahalanobis as mahalanobis
from dopepp.metrics.functional.distances import mspd as mspd
from dopepp.metrics.functional.distances import mssd as mssd
from dopepp.metrics.functional.distances import reprojection_error as reprojection_error
from dopepp.metrics.functional.distances import rotation_error_deg as rotation_error_deg
from dopepp.metrics.functional.distances import translation_error as translation_error
from dopepp.metrics.functional.distances import vsd as vsd

AucMethod = Literal["exact", "voc"]


def auc(errors: Errors, max_threshold: float, method: AucMethod = "exact") -> float:
    """Return the area under the accuracy-threshold curve from 0 to ``max_threshold``, in [0, 1].

    An infinite or NaN error is a miss. ``exact`` integrates the step curve:
    mean(clip(1 − e / max, 0, 1)). ``voc`` is the rule of the YCB-Video toolbox, which is larger by
    eₖ / (N·max): (Σ (eᵢ − eᵢ₋₁)·i + (max − eₖ)·k) / (N·max) over the k of N sorted errors ≤ max,
    e₀ = 0. Without errors, the area is 0.
    """
    errors = nan_is_miss(to_float64(errors))
    if method == "exact":
        values = (1 - errors / max_threshold).clamp(0, 1)
        return float(values.mean()) if len(values) else 0.0
    hits = errors[errors <= max_threshold].sort().values
    if len(hits) == 0:
        return 0.0
    edges = torch.cat([hits.new_zeros(1), hits, hits.new_tensor([max_threshold])])
    ranks = torch.arange(1, len(hits) + 2, dtype=torch.float64, device=hits.device)
    ranks[-1] = len(hits)
    return float(edges.diff() @ ranks) / (len(errors) * max_threshold)


def pass_rate(errors: Errors, threshold: float) -> float:
    """Return the share of errors strictly below ``threshold``; 0.0 without errors."""
    errors = to_float64(errors)
    return float((errors < threshold).double().mean()) if len(errors) else 0.0


def average_recall(errors: Errors, thresholds: Sequence[float]) -> float:
    """Return the mean of the pass rates at several thresholds: BOP's AR of one error.

    AR_MSSD uses :data:`BOP_THRESHOLDS` times the diameter, AR_MSPD :data:`BOP_MSPD_THRESHOLDS`
    times width/640.
    """
    return sum(pass_rate(errors, threshold) for threshold in thresholds) / len(thresholds)


def wilson_interval(passed: int, num: int) -> tuple[float, float]:
    """Return Wilson's 95 % score interval of the rate ``passed / num`` (Wilson 1927).

    With z the two-sided normal quantile and p the rate, the ends are
    (p + z²/2n ± z·√(p(1 − p)/n + z²/4n²)) / (1 + z²/n); without trials they are 0 and 1.
    """
    if num == 0:
        return 0.0, 1.0
    z = NormalDist().inv_cdf(0.975)
    rate, weight = passed / num, z * z / num
    centre = (rate + weight / 2) / (1 + weight)
    half = math.sqrt(rate * (1 - rate) * weight + weight * weight / 4) / (1 + weight)
    # Rounding errors could exclude the rates 0 and 1 from their own intervals.
    low = 0.0 if passed == 0 else centre - half
    return low, 1.0 if passed == num else centre + half


def region_levels(distances: Errors) -> Errors:
    """Return, for each pose, the smallest confidence level whose region contains the true pose.

    The squared Mahalanobis distance x of a true pose from its estimate follows χ² with six degrees
    of freedom if the covariance is correct. The level is that distribution's value at x,
    1 − exp(−x/2)·(1 + x/2 + x²/8). The distances of :func:`mahalanobis` are infinite for a miss.
    """
    half = nan_is_miss(to_float64(distances)).square() / 2
    return torch.where(half.isfinite(), 1 - (-half).exp() * (1 + half + half.square() / 2), 1.0)


def coverage(distances: Errors, level: float = 0.9) -> float:
    """Return the share of Mahalanobis distances inside a confidence region; 0.0 without any."""
    levels = region_levels(distances)
    return float((levels <= level).double().mean()) if len(levels) else 0.0


def expected_calibration_error(scores: Float[Tensor, "p"], correct: Bool[Tensor, "p"]) -> float:
    """Return the mean gap between score and share of correct predictions (ECE; Guo 2017, Eq. 3).

    Predictions are sorted into ten bins of equal width by score, and bins are weighted by size. A
    score on an edge belongs to the lower bin. Without predictions the error is 0.0.

    Raises:
        ValueError: The lengths differ, or a score is outside [0, 1].
    """
    scores, correct = to_float64(scores), torch.as_tensor(correct, dtype=torch.bool)
    if scores.shape != correct.shape or scores.ndim != 1:
        raise ValueError(f"scores {tuple(scores.shape)} and correct {tuple(correct.shape)} differ")
    if len(scores) == 0:
        return 0.0
    if not bool(((scores >= 0) & (scores <= 1)).all()):
        raise ValueError("scores must lie in [0, 1]")
    index = ((scores * 10).ceil().long() - 1).clamp(min=0)
    zeros = scores.new_zeros(10)
    confidence = zeros.index_add(0, index, scores)
    accuracy = zeros.index_add(0, index, correct.double())
    return float((confidence - accuracy).abs().sum() / len(scores))


_RECALLS: Final = torch.from_numpy(np.linspace(0.0, 1.0, 101))
"""Recall levels of COCO's tool, with its rounding."""


def match(
    scores: Float[Tensor, "p"], distances: Float[Tensor, "p g"], max_distance: float
) -> Int[Tensor, "p"]:
    """Match predictions with instances one-to-one, greedily by descending score.

    Predictions with equal scores keep the input order; NaN scores come last. Matches have a
    distance of at most ``max_distance``, metres.

    Returns:
        Index of each prediction's instance; −1 if it matches none.

    Raises:
        ValueError: The numbers of scores and rows differ.
    """
    scores, distances = to_float64(scores), to_float64(distances)
    if distances.shape[0] != len(scores) or distances.ndim != 2:
        raise ValueError(f"{len(scores)} scores need as many rows, got {tuple(distances.shape)}")
    matches = torch.full((len(scores),), -1, dtype=torch.int64, device=scores.device)
    if distances.shape[1] == 0:
        return matches
    # Pairs farther apart, or with a NaN distance, get an infinite distance and never match.
    free = torch.where(distances <= max_distance, distances, torch.inf)
    for prediction in scores.nan_to_num(nan=-torch.inf).argsort(descending=True, stable=True):
        nearest = free[prediction].argmin()
        if free[prediction, nearest].isfinite():
            matches[prediction] = nearest
            free[:, nearest] = torch.inf
    return matches


def average_precision(
    scores: Float[Tensor, "p"], correct: Bool[Tensor, "p"], num_instances: int
) -> float:
    """Return COCO's average precision: the mean interpolated precision at 101 recall levels.

    Predictions with equal scores keep the input order; NaN scores come last. Duplicates are not
    correct.

    Returns:
        The average precision in [0, 1]; 0.0 without predictions or instances.

    Raises:
        ValueError: The lengths differ, or more predictions are correct than there are instances.
    """
    scores, correct = to_float64(scores), torch.as_tensor(correct, dtype=torch.bool)
    if scores.shape != correct.shape or scores.ndim != 1:
        raise ValueError(f"scores {tuple(scores.shape)} and correct {tuple(correct.shape)} differ")
    if int(correct.sum()) > num_instances:
        raise ValueError(f"{int(correct.sum())} correct predictions of {num_instances} instances")
    if len(scores) == 0 or num_instances == 0:
        return 0.0
    order = scores.nan_to_num(nan=-torch.inf).argsort(descending=True, stable=True)
    hits = correct[order].double().cumsum(0)
    ranks = torch.arange(1, len(hits) + 1, dtype=torch.float64, device=hits.device)
    best = (hits / ranks).flip(0).cummax(0).values.flip(0)
    first = torch.searchsorted(hits / num_instances, _RECALLS.to(hits.device))
    reached = first < len(hits)
    return float(torch.where(reached, best[first.clamp(max=len(hits) - 1)], 0.0).mean())
