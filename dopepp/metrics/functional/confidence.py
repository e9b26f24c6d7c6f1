"""How well a share of few trials is known."""

from __future__ import annotations

import math
from statistics import NormalDist


def wilson_interval(passed: int, num: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return Wilson's score interval of a rate (Wilson 1927), which also holds near 0 and 1.

    With z the two-sided normal quantile and p = passed / num, the ends are
    (p + z²/2n ± z·√(p(1 − p)/n + z²/4n²)) / (1 + z²/n).

    Args:
        passed: Trials that passed.
        num: All trials.
        confidence: Chance that the interval holds the true rate.

    Returns:
        Its ends, in [0, 1]; (0, 1) without trials.

    Raises:
        ValueError: ``passed`` is not in 0 … num, or ``confidence`` not strictly between 0 and 1.
    """
    if not 0 <= passed <= num or not 0 < confidence < 1:
        raise ValueError(f"passed={passed}, num={num}, confidence={confidence}")
    if num == 0:
        return 0.0, 1.0
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    rate, weight = passed / num, z * z / num
    centre = (rate + weight / 2) / (1 + weight)
    half = math.sqrt(rate * (1 - rate) * weight + weight * weight / 4) / (1 + weight)
    # At the ends, rounding alone would leave the interval without the rate itself.
    low = 0.0 if passed == 0 else centre - half
    return low, 1.0 if passed == num else centre + half
