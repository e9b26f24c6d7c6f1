"""Which prediction belongs to which instance, and how well scores tell right from wrong."""

from __future__ import annotations

from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dopepp.metrics.functional.inputs import to_float64

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

    Args:
        scores: Confidence of each prediction.
        distances: Metres from each prediction (row) to each instance (column).
        max_distance: Largest distance of a match, metres.

    Returns:
        The instance of each prediction, −1 where it has none.
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

    Args:
        scores: Confidence of every prediction of the whole test set; equal ones stay in order and
            a score that is NaN comes last.
        correct: Whether it is the one that found its instance; a duplicate is not.
        num_instances: Instances that were to be found.

    Returns:
        The average precision in [0, 1]; 0.0 without predictions or without instances.

    Raises:
        ValueError: The two differ in length, or more are correct than there are instances.
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
