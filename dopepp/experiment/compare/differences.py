"""How far a method is from the baseline, and how sure that is.

To compare a further measure, add an entry to :data:`COMPARED`: what an instance counts in it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.experiment.compare.entry import Entry
from dopepp.experiment.report import Report
from dopepp.metrics.bootstrap import Difference, StatisticName, paired_difference
from dopepp.metrics.pose import MEAN

Counted = Callable[[Report, str], Float[np.ndarray, "instances"]]


@dataclass(frozen=True)
class Compared:
    """A measure as a statistic of what every instance of an object counts.

    Attributes:
        counted: A report and an object's name to a number per instance.
        statistic: Of these numbers.
    """

    counted: Counted
    statistic: StatisticName = "mean"


def _passes(threshold: float) -> Counted:
    """Count an instance whose ADD is below a threshold, metres."""
    return lambda report, name: (report.errors[name] < threshold).astype(np.float64)


COMPARED: Final[dict[str, Compared]] = {
    "add_01d": Compared(lambda report, name: _passes(0.1 * report.diameters[name])(report, name)),
    "pass_5cm": Compared(_passes(0.05)),
    "pass_10cm": Compared(_passes(0.1)),
    "auc_10cm": Compared(lambda report, name: np.clip(1 - report.errors[name] / 0.1, 0, 1)),
    "median_rotation_deg": Compared(lambda report, name: report.rotation_deg[name], "median"),
}
"""Measures with a Δ, by their field of ``PoseRow``."""


def comparable(entry: Entry, baseline: Entry) -> bool:
    """Tell whether two methods were measured on the same images."""
    return bool(entry.test_set) and entry.test_set == baseline.test_set


def differences(entry: Entry, baseline: Entry, name: str) -> dict[str, Difference | None]:
    """Return the differences in an object's measures; none where they cannot be compared.

    Seeds are drawn in pairs where both methods have the same ones.
    """
    objects = _scored(entry, name)
    if not comparable(entry, baseline) or not objects or objects != _scored(baseline, name):
        return {}
    # Sorted by seed, row s of both methods is of one seed where they have the same ones.
    first, second = _by_seed(entry), _by_seed(baseline)
    unknown = None in entry.seeds or None in baseline.seeds
    same = len(first) == len(second) == 1 or (
        not unknown and sorted(map(str, entry.seeds)) == sorted(map(str, baseline.seeds))
    )
    found = {}
    for field, one in COMPARED.items():
        mine, theirs = (
            [np.stack([one.counted(report, part) for report in method]) for part in objects]
            for method in (first, second)
        )
        difference = paired_difference(mine, theirs, one.statistic, same_seeds=same)
        found[field] = _within_shares(difference) if one.statistic == "mean" else difference
    return found


def _within_shares(difference: Difference | None) -> Difference | None:
    """Cut an interval that few seeds have stretched beyond what two shares can differ by."""
    if difference is None:
        return None
    return replace(difference, low=max(difference.low, -1.0), high=min(difference.high, 1.0))


def _scored(entry: Entry, name: str) -> list[str]:
    """Return the objects with instances that a row is about: one, or for the mean all."""
    if name != MEAN:
        errors = entry.reports[0].errors.get(name)
        return [name] if errors is not None and len(errors) else []
    return sorted(part for part, errors in entry.reports[0].errors.items() if len(errors))


def _by_seed(entry: Entry) -> list[Report]:
    pairs = zip(entry.seeds, entry.reports, strict=True)
    return [report for _, report in sorted(pairs, key=lambda pair: str(pair[0]))]
