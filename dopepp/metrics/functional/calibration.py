"""Whether scores mean what they say."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dopepp.metrics.functional.inputs import to_float64


def expected_calibration_error(
    scores: Float[Tensor, "p"], correct: Bool[Tensor, "p"], bins: int = 10
) -> float:
    """Mean distance between score and share of right predictions (ECE; Guo et al. 2017, Eq. 3).

    Predictions are put into bins of equal width by their score; each bin counts by its size.

    Args:
        scores: Confidence of every prediction, in [0, 1].
        correct: Whether it is right.
        bins: Number of bins; a score on an edge belongs to the lower one, as there.

    Returns:
        The error in [0, 1]; 0.0 without predictions.

    Raises:
        ValueError: The two differ in length, a score is outside of [0, 1], or there are no bins.
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
