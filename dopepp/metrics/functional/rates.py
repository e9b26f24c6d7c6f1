"""Rates over many errors, how sure they are, and which prediction belongs to which instance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Final, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dopepp.core.errors import UserError
from dopepp.metrics.functional.distances import Errors, nan_is_miss, to_float64

AucMethod = Literal["exact", "voc"]


def auc(errors: Errors, max_threshold: float, method: AucMethod = "exact") -> float:
    """Area under the accuracy-threshold curve from 0 to ``max_threshold``, as a share of 1.

    Args:
        errors: Errors in the unit of ``max_threshold``; a miss is infinite (NaN counts as one).
        max_threshold: End of the curve, e.g. 0.1 m.
        method: ``exact`` integrates the step curve: mean(clip(1 − e / max, 0, 1)). ``voc`` is the
            YCB-Video toolbox's sum over the k of N sorted errors that are ≤ max, in which a step
            counts from its left end: (Σ (eᵢ − eᵢ₋₁)·i + (max − eₖ)·k) / (N·max), e₀ = 0. It is
            larger than ``exact`` by eₖ / (N·max).

    A :class:`UserError`: the method is unknown or ``max_threshold`` is not positive. Without errors
    the area is 0.0.
    """
    if not max_threshold > 0:
        raise UserError(
            f"max_threshold={max_threshold}", "a positive number", "give where the curve ends"
        )
    errors = nan_is_miss(to_float64(errors))
    if method == "exact":
        values = (1 - errors / max_threshold).clamp(0, 1)
        return float(values.mean()) if len(values) else 0.0
    if method != "voc":
        raise UserError(f"auc method {method!r}", "exact, voc", "choose one of them")
    hits = errors[errors <= max_threshold].sort().values
    if len(hits) == 0:
        return 0.0
    edges = torch.cat([hits.new_zeros(1), hits, hits.new_tensor([max_threshold])])
    ranks = torch.arange(1, len(hits) + 2, dtype=torch.float64, device=hits.device)
    ranks[-1] = len(hits)
    return float(edges.diff() @ ranks) / (len(errors) * max_threshold)


def pass_rate(errors: Errors, threshold: float) -> float:
    """Share of errors strictly below ``threshold``, TP / (TP + FN); 0.0 without errors."""
    errors = to_float64(errors)
    return float((errors < threshold).double().mean()) if len(errors) else 0.0


def average_recall(errors: Errors, thresholds: Sequence[float]) -> float:
    """Mean of the pass rates at several thresholds: BOP's AR of one error function.

    AR_MSSD takes :data:`BOP_THRESHOLDS` times the diameter, AR_MSPD
    :data:`BOP_MSPD_THRESHOLDS` times width/640. A miss is infinite; without errors the average is
    0.0. No threshold at all is a :class:`UserError`.
    """
    if not len(thresholds):
        raise UserError("no thresholds", "one or more", "give those of BOP_THRESHOLDS")
    return sum(pass_rate(errors, threshold) for threshold in thresholds) / len(thresholds)


def wilson_interval(passed: int, num: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return Wilson's score interval of a rate (Wilson 1927), which also holds near 0 and 1.

    With z the two-sided normal quantile and p = passed / num, the ends are
    (p + z²/2n ± z·√(p(1 − p)/n + z²/4n²)) / (1 + z²/n).

    The confidence is the chance that the interval holds the true rate. Without trials the ends are
    (0, 1).
    """
    if num == 0:
        return 0.0, 1.0
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    rate, weight = passed / num, z * z / num
    centre = (rate + weight / 2) / (1 + weight)
    half = math.sqrt(rate * (1 - rate) * weight + weight * weight / 4) / (1 + weight)
    # At the ends, rounding alone would leave the interval without the rate itself.
    low = 0.0 if passed == 0 else centre - half
    return low, 1.0 if passed == num else centre + half


def expected_calibration_error(
    scores: Float[Tensor, "p"], correct: Bool[Tensor, "p"], bins: int = 10
) -> float:
    """Mean distance between score and share of right predictions (ECE; Guo et al. 2017, Eq. 3).

    Predictions are put into bins of equal width by their score; each bin counts by its size.

    A score on an edge belongs to the lower bin, as there; without predictions the error is 0.0. A
    ``ValueError``: the two differ in length, a score is outside of [0, 1], or there are no bins.
    """
    scores, correct = to_float64(scores), torch.as_tensor(correct, dtype=torch.bool)
    if scores.shape != correct.shape or scores.ndim != 1 or bins < 1:
        raise ValueError(
            f"scores {tuple(scores.shape)} and correct {tuple(correct.shape)} in {bins} bins"
        )
    if len(scores) == 0:
        return 0.0
    if not bool(((scores >= 0) & (scores <= 1)).all()):
        raise ValueError("scores must lie in [0, 1]")
    index = ((scores * bins).ceil().long() - 1).clamp(min=0)
    zeros = scores.new_zeros(bins)
    said = zeros.index_add(0, index, scores)
    right = zeros.index_add(0, index, correct.double())
    return float((said - right).abs().sum() / len(scores))


MATCH_DISTANCE: Final = 0.1
"""Metres between the centres of a prediction and of the instance it may be matched with."""

_RECALLS: Final = torch.from_numpy(np.linspace(0.0, 1.0, 101))
"""Recall levels at which COCO's tool reads the precision, with its rounding."""


def match(
    scores: Float[Tensor, "p"],
    distances: Float[Tensor, "p g"],
    max_distance: float = MATCH_DISTANCE,
) -> Int[Tensor, "p"]:
    """Match predictions with instances one-to-one, greedily by score.

    The best-scored prediction takes its nearest instance within ``max_distance`` (inclusive), the
    next one the nearest that is left, and so on. Equal scores go in input order, equal distances
    to the first instance; a score that is NaN comes last and a distance that is NaN never matches.

    Distances are metres from each prediction (row) to each instance (column). Returned is the
    instance of each prediction, −1 where it has none.
    """
    scores, distances = to_float64(scores), to_float64(distances)
    if distances.shape[0] != len(scores) or distances.ndim != 2:
        raise ValueError(f"{len(scores)} scores need as many rows, got {tuple(distances.shape)}")
    matches = torch.full((len(scores),), -1, dtype=torch.int64, device=scores.device)
    if distances.shape[1] == 0:
        return matches
    # Comparing with <= is False for NaN, so what may not match becomes infinitely far.
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
    """Mean of the precision at 101 recalls, each the best at that recall or a higher one (COCO).

    Equal scores stay in order and a score that is NaN comes last; a duplicate is not correct.
    Without predictions or without instances (that were to be found) it is 0.0. A ``ValueError``:
    the two differ in length, or more are correct than there are instances.
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
