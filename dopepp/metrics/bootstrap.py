"""Confidence intervals of differences between two methods: a paired, hierarchical bootstrap.

Both methods are measured on the same instances and trained with one or several seeds. For each
resample, seeds and instances are sampled with replacement, jointly for both methods, and the
difference is recomputed. The interval holds the middle share of the resampled differences
(percentile bootstrap; Efron and Tibshirani, An Introduction to the Bootstrap, 1993).

To support another statistic, add its function to :data:`STATISTICS`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Float
from scipy.stats import norm, t

from dopepp.core.errors import UserError

Numbers = Sequence[Float[np.ndarray, "_ instances"]]
"""For each object, the values of a measure by seed and instance."""

Draws = Float[np.ndarray, "resamples seeds"]
"""Weight of each seed in each resample; weights sum to 1."""

_Statistic = Callable[[Float[np.ndarray, "... n"]], Float[np.ndarray, "..."]]
StatisticName = Literal["mean", "median"]

_BLOCK: Final = 4_000_000  # Count of numbers resampled at once: 32 MB
_CONFIDENCE: Final = 0.95
_LEVEL: Final = (1 + _CONFIDENCE) / 2  # quantile at the upper end of a two-sided interval


@dataclass(frozen=True)
class Difference:
    """Difference of a statistic between a method and the baseline.

    Attributes:
        value: The method's statistic minus the baseline's.
        low, high: Ends of the 95 % confidence interval.
        num_differing: Number of instances on which the methods differ.
        fewest: Smallest ``num_differing`` that can be significant (:func:`fewest_differing`).
        seeds_needed: Estimated number of seeds that would make the difference significant
            (:func:`seeds_needed`); None if unknown.
    """

    value: float
    low: float
    high: float
    num_differing: int
    fewest: int
    seeds_needed: float | None = None

    @property
    def within_noise(self) -> bool:
        """Whether too few instances differ to be significant, or the interval contains 0."""
        return self.num_differing < self.fewest or self.low <= 0 <= self.high


def paired_difference(
    mine: Numbers,
    baseline: Numbers,
    statistic: StatisticName = "mean",
    *,
    same_seeds: bool = True,
    num_resamples: int = 5000,
    few_seeds: bool = True,
    seed: int = 0,
) -> Difference | None:
    """Return the difference of a statistic between two methods, with its confidence interval.

    The statistic over instances is averaged over objects and seeds. With a single seed, the
    interval does not cover the noise of training.

    Args:
        mine: Values of the method. The median ignores values that are not finite (misses).
        baseline: Values of the baseline, on the same instances.
        statistic: Name of the statistic.
        same_seeds: Whether row s of both methods has the same seed, to resample seeds in pairs.
        num_resamples: Number of resamples.
        few_seeds: Whether to correct for few seeds. Resamples of S seeds spread less than new
            seeds, so the seed effect of each resample is multiplied by t₍S₋₁₎ / z · √(S / (S − 1)),
            the ratio of Student's t to the normal quantile: 9.2 for S = 2, 2.7 for 3, 1.6 for 5.
        seed: Seed of the resamples.

    Returns:
        The difference, or None if a statistic is undefined (a median without finite numbers).

    Raises:
        UserError: The counts of objects, instances or paired seeds differ or are zero, or the
            statistic is a mean and numbers are not finite.
    """
    mine = [np.asarray(values, np.float64) for values in mine]
    baseline = [np.asarray(values, np.float64) for values in baseline]
    _check(mine, baseline, statistic, same_seeds)
    compute = STATISTICS[statistic]
    figures = [np.mean([compute(v) for v in values], axis=0) for values in (mine, baseline)]
    if np.isnan(np.concatenate(figures)).any():
        return None
    rng = np.random.default_rng(seed)
    counts = [len(by_seed) for by_seed in figures]
    draws = [rng.multinomial(n, np.full(n, 1 / n), num_resamples) / n for n in counts]
    if same_seeds:
        draws[1] = draws[0]
    resampled = _resampled_difference(mine, baseline, compute, draws, rng)
    effects = [figures[0] - figures[1]] if same_seeds else [figures[0], -figures[1]]
    if few_seeds:
        resampled += sum(map(_stretching, effects, draws))
    defined = resampled[~np.isnan(resampled)]
    if not len(defined):
        return None
    tail = (1 - _CONFIDENCE) / 2
    low, high = np.quantile(defined, [tail, 1 - tail])
    value = float(figures[0].mean() - figures[1].mean())
    paired = same_seeds and len(figures[0]) > 1 and statistic == "mean"
    needed = seeds_needed(mine, baseline) if paired else None
    num_differing, fewest = _num_differing(mine, baseline), fewest_differing(_CONFIDENCE)
    return Difference(value, float(low), float(high), num_differing, fewest, needed)


def seeds_needed(mine: Numbers, baseline: Numbers) -> float:
    """Estimate how many paired seeds would make a difference in means significant.

    With S seeds the interval's half-width is √(z² · V + t₍S₋₁₎² · W / S), where V is the variance
    of the mean over instances and W the variance of the difference over seeds.

    Returns:
        Number of seeds, larger than the present number; infinite if there are too few instances.
    """
    differences = [ours - theirs for ours, theirs in zip(mine, baseline, strict=True)]
    if min(values.shape[1] for values in differences) < 2:
        return math.inf
    effects = np.mean([values.mean(axis=1) for values in differences], axis=0)
    variances = [v.mean(axis=0).var(ddof=1) / v.shape[1] for v in differences]
    over_instances = sum(variances)
    z = norm.ppf(_LEVEL)
    room = effects.mean() ** 2 - z**2 * over_instances / len(differences) ** 2
    if room <= 0:
        return math.inf
    over_seeds = effects.var(ddof=1)
    # Student's t exceeds z, so z gives a lower bound; t is close to z, so the search is short.
    fewest = max(len(effects) + 1, math.ceil(z**2 * over_seeds / room))
    spread = ((num, t.ppf(_LEVEL, num - 1) ** 2 * over_seeds) for num in itertools.count(fewest))
    return float(next(num for num, reached in spread if reached < room * num))


def fewest_differing(confidence: float) -> int:
    """Return the smallest number of differing instances that can be significant.

    If both methods are equally good, k differing instances all favour the same method with
    probability 2 · ½ᵏ (sign test). The bootstrap is overconfident for fewer differing instances,
    because its resamples hardly differ.
    """
    return math.ceil(math.log2(2 / (1 - confidence)))


def _finite_median(values: Float[np.ndarray, "... n"]) -> Float[np.ndarray, "..."]:
    """Return the median of the finite values on the last axis, or NaN without finite values."""
    ordered = np.sort(np.where(np.isfinite(values), values, np.inf), axis=-1)
    count = np.isfinite(ordered).sum(axis=-1, keepdims=True)
    middle = np.maximum(np.concatenate([(count - 1) // 2, count // 2], axis=-1), 0)
    middle = np.minimum(middle, values.shape[-1] - 1)
    median = np.take_along_axis(ordered, middle, axis=-1).mean(axis=-1)
    return np.where(count[..., 0] > 0, median, np.nan)


STATISTICS: Final[dict[StatisticName, _Statistic]] = {
    "mean": lambda values: np.asarray(values.mean(axis=-1)),
    "median": _finite_median,
}
"""Statistics over the last axis, by name."""


def _check(mine: Numbers, baseline: Numbers, statistic: str, same_seeds: bool) -> None:
    """Check that the shapes match, and that the values of a mean are finite."""
    shapes = [[values.shape for values in method] for method in (mine, baseline)]
    plain = all(len(shape) == 2 and min(shape) > 0 for shape in [*shapes[0], *shapes[1]])
    seeds = [{shape[0] for shape in method} for method in shapes]
    counts = [[shape[-1] for shape in method] for method in shapes] if plain else [[], []]
    if not plain or not mine or counts[0] != counts[1] or max(map(len, seeds)) > 1:
        raise UserError(
            f"arrays of shapes {shapes[0]} for the method and {shapes[1]} for the baseline",
            "shape (seeds, instances) for each object, with the same instances in both methods",
            "evaluate both methods on the same test set",
        )
    if same_seeds and seeds[0] != seeds[1]:
        problem = f"{seeds[0].pop()} seeds against {seeds[1].pop()}"
        raise UserError(problem, "equal numbers of seeds, to pair them", "pass same_seeds=False")
    if statistic == "mean" and not all(np.isfinite(v).all() for v in [*mine, *baseline]):
        problem, fix = "a mean over values that are not finite", "replace misses, e.g. by 0"
        raise UserError(problem, "finite values", fix)


def _resampled_difference(
    mine: Numbers,
    baseline: Numbers,
    compute: _Statistic,
    draws: Sequence[Draws],
    rng: np.random.Generator,
) -> Float[np.ndarray, "resamples"]:
    """Return the difference of the statistic in each resample, averaged over objects.

    ``draws`` are the weights of the seeds of both methods; ``rng`` samples the instances.
    """
    total = np.zeros(len(draws[0]))
    for ours, theirs in zip(mine, baseline, strict=True):
        count = ours.shape[1]
        step = max(1, _BLOCK // (count * max(len(ours), len(theirs))))
        for start in range(0, len(total), step):
            rows = slice(start, start + step)
            drawn = rng.integers(count, size=(len(total[rows]), count))
            for sign, values, weights in ((1, ours, draws[0]), (-1, theirs, draws[1])):
                by_seed = compute(values[:, drawn]).T
                # Seeds with weight 0 are excluded, because their statistic may be NaN.
                weighted = np.where(weights[rows] > 0, weights[rows] * by_seed, 0.0)
                total[rows] += sign * weighted.sum(axis=1)
    return total / len(mine)


def _stretching(
    effects: Float[np.ndarray, "seeds"], draws: Draws
) -> Float[np.ndarray, "resamples"]:
    """Return a term per resample that widens the distribution, too narrow for few seeds.

    The term moves each resample away from the mean, so that the interval gets the width that
    Student's t gives for this number of seeds. ``effects`` are the differences between the methods.
    """
    num = len(effects)
    if num == 1:
        return np.zeros(len(draws))
    factor = t.ppf(_LEVEL, num - 1) / norm.ppf(_LEVEL) * math.sqrt(num / (num - 1))
    return np.asarray((factor - 1) * (draws @ (effects - effects.mean())))


def _num_differing(mine: Numbers, baseline: Numbers) -> int:
    """Count the instances whose mean over seeds differs between the methods."""
    count = 0
    for ours, theirs in zip(mine, baseline, strict=True):
        finite = [np.where(np.isfinite(v), v, np.inf) for v in (ours, theirs)]
        means = [np.sort(values, axis=0).mean(axis=0) for values in finite]
        # Values are sorted, because the order of a sum changes its rounding. The tolerance covers
        # the rounding of means over different numbers of seeds.
        count += int((~np.isclose(means[0], means[1], rtol=1e-12, atol=0)).sum())
    return count
