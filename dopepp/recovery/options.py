"""The thresholds of the way from maps to poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from dopepp.core.errors import UserError

FEATURES: Final = ("bias", "belief", "spread", "misfit", "found")
"""What the score is made of, in this order (:mod:`dopepp.recovery.calibration`)."""

DISTANCE_FACTORS: Final = (0.5, 2.0)
"""Smallest and greatest factor on a distance; trained networks' are within a tenth of 1."""

_HEAVIEST: Final = 1000.0
"""Largest weight of a feature; fitted ones are a hundred times smaller."""


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
        distance_factor: On the distance of every pose (:mod:`dopepp.recovery.calibration`), as
            ``evaluate.py tune=true`` measures it.
        score_bias: It and the following are the weights of the score's features, as ``evaluate.py
            tune=true`` fits them; these defaults leave the mean belief.
    """

    sigma: float = 1.0
    peak_threshold: float = 0.02
    centroid_threshold: float = 0.05
    max_angle_deg: float = 45.0
    max_peaks: int = 16
    min_score: float = 0.0
    distance_factor: float = 1.0
    score_bias: float = 0.0
    score_belief: float = 1.0
    score_spread: float = 0.0
    score_misfit: float = 0.0
    score_found: float = 0.0

    def __post_init__(self) -> None:
        limits = {
            "sigma": (0.1, 100.0),
            "peak_threshold": (1e-6, 1.0),
            "centroid_threshold": (1e-6, 1.0),
            "max_angle_deg": (1e-3, 180.0),
            "max_peaks": (1, 1000),
            "min_score": (0.0, 1.0),
            "distance_factor": DISTANCE_FACTORS,
            **{f"score_{name}": (-_HEAVIEST, _HEAVIEST) for name in FEATURES},
        }
        for name, (lowest, highest) in limits.items():
            value = getattr(self, name)
            if not lowest <= value <= highest:
                raise UserError(
                    f"recovery option {name}={value}", f"{lowest:g} to {highest:g}", "change it"
                )

    @property
    def score_weights(self) -> tuple[float, ...]:
        """Weights of the score's features, in their order."""
        return tuple(getattr(self, f"score_{name}") for name in FEATURES)
