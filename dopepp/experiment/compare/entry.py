"""One line of a comparison: a method and its results, one per seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from dopepp.experiment.compare.runs import Run
from dopepp.experiment.methods import Cost
from dopepp.experiment.report import Report
from dopepp.metrics.pose import MEAN
from dopepp.metrics.row import COLUMNS, PoseRow

BASELINE: Final = "dope"
"""A method of this name stands first, and every other one's Δ is against it."""


@dataclass
class Entry:
    """A method in a comparison.

    Attributes:
        name: Its name.
        reports: Its results on one test set, one per seed; empty where there is none.
        seeds: The trainings' seeds, as many; None where unknown.
        failure: Why there is no result, in one line; empty where only the cost was asked for.
        pruned: Whether the reason is that a search stopped it, which is no failure.
        runs: The run folders; empty where reports do not come from any.
    """

    name: str
    reports: list[Report] = field(default_factory=list)
    seeds: list[int | None] = field(default_factory=list)
    failure: str = ""
    pruned: bool = False
    runs: list[Run] = field(default_factory=list)

    @property
    def test_set(self) -> str:
        """Fingerprint of the images; empty where it is not known."""
        return self.reports[0].test_set if self.reports else ""

    @property
    def objects(self) -> list[str]:
        """Names of the rows: every object, and the mean where there are several."""
        names = list(self.reports[0].rows)
        return [name for name in names if name != MEAN or len(names) > 2]

    def row(self, name: str) -> PoseRow:
        """Return the measures of an object, averaged over seeds.

        A measure that one seed lacks is n/a: a mean over the others would flatter.
        """
        rows = [report.rows[name] for report in self.reports]
        mean = replace(rows[0])
        for column in COLUMNS:
            values = [getattr(row, column.field) for row in rows]
            known = None not in values
            setattr(mean, column.field, float(np.mean(values)) if known else None)
        return mean

    def deviation(self, name: str, field_name: str) -> float | None:
        """Return the standard deviation over seeds (of a sample), None of fewer than two."""
        values = [getattr(report.rows[name], field_name) for report in self.reports]
        if len(values) < 2 or None in values:
            return None
        return float(np.std(values, ddof=1))

    @property
    def cost(self) -> Cost:
        """What the method costs; the time is the mean over seeds."""
        costs = [report.cost for report in self.reports]
        costs = costs or [run.cost or Cost() for run in self.runs[:1]]
        times = [cost.ms_per_frame for cost in costs if cost.ms_per_frame is not None]
        return replace(costs[0], ms_per_frame=float(np.mean(times)) if times else None)


def ordered(entries: Sequence[Entry], baseline: str = BASELINE) -> list[Entry]:
    """Put the baseline, by its name or the first word of it, before all others."""
    return sorted(entries, key=lambda e: baseline not in (e.name, e.name.split(" ")[0]))
