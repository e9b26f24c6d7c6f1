"""Rates over many errors: pass rate, area under the curve, average recall."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from dopepp.errors import UserError
from dopepp.metrics.functional.inputs import nan_is_miss, to_float64

AucMethod = Literal["exact", "voc"]

BOP_THRESHOLDS: Final = tuple(round(0.05 * k, 2) for k in range(1, 11))
"""0.05 to 0.5: of VSD's error and, times the diameter, of VSD's tolerance and of MSSD (BOP)."""

BOP_MSPD_THRESHOLDS: Final = tuple(5.0 * k for k in range(1, 11))
"""5 to 50 pixels: of MSPD in an image 640 pixels wide; times width/640 in others (BOP)."""


def auc(errors: Float[Tensor, "n"], max_threshold: float, method: AucMethod = "exact") -> float:
    """Area under the accuracy-threshold curve from 0 to ``max_threshold``, as a share of 1.

    Args:
        errors: Errors in the unit of ``max_threshold``; a miss is infinite (NaN counts as one).
        max_threshold: End of the curve, e.g. 0.1 m.
        method: ``exact`` integrates the step curve: mean(clip(1 − e / max, 0, 1)). ``voc`` is the
            YCB-Video toolbox's sum over the k of N sorted errors that are ≤ max, in which a step
            counts from its left end: (Σ (eᵢ − eᵢ₋₁)·i + (max − eₖ)·k) / (N·max), e₀ = 0. It is
            larger than ``exact`` by eₖ / (N·max).

    Returns:
        The area in [0, 1]; 0.0 without errors.

    Raises:
        UserError: The method is unknown or ``max_threshold`` is not positive.
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


def pass_rate(errors: Float[Tensor, "n"], threshold: float) -> float:
    """Share of errors strictly below ``threshold``, TP / (TP + FN); 0.0 without errors."""
    errors = to_float64(errors)
    return float((errors < threshold).double().mean()) if len(errors) else 0.0


def average_recall(errors: Float[Tensor, "n"], thresholds: Sequence[float]) -> float:
    """Mean of the pass rates at several thresholds: BOP's AR of one error function.

    AR_MSSD takes :data:`BOP_THRESHOLDS` times the diameter, AR_MSPD
    :data:`BOP_MSPD_THRESHOLDS` times width/640. AR_VSD is the mean over VSD's tolerances of the
    average recall at :data:`BOP_THRESHOLDS`. A data set's AR is the mean of the three.

    Args:
        errors: One error per instance that is to be found; a miss is infinite.
        thresholds: In the unit of the errors.

    Returns:
        The average in [0, 1]; 0.0 without errors.

    Raises:
        UserError: There is no threshold.
    """
    if not len(thresholds):
        raise UserError("no thresholds", "one or more", "give those of BOP_THRESHOLDS")
    return sum(pass_rate(errors, threshold) for threshold in thresholds) / len(thresholds)
