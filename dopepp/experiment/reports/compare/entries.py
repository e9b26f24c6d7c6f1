"""From run folders to the lines of a comparison: a method's seeds and parts together, and names.

One line of a comparison: a method and its results, one per seed.

How far a method is from the baseline, and how sure that is.

To compare a further measure, add an entry to :data:`COMPARED`: what an instance counts in it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.experiment.reports.compare.runs import Run
from dopepp.experiment.reports.evaluators import Cost
from dopepp.experiment.reports.report import Report
from dopepp.metrics.bootstrap import Difference, StatisticName, paired_difference
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


_LONGEST_NAME: Final = 60
"""Characters of a name that tables and legends have room for."""


def group(runs: Sequence[Run]) -> list[Entry]:
    """Put runs that differ in nothing but the seed into one entry, in order of the first one.

    They must have been measured on the same test set. Networks of other parts, trained alike with
    the same seeds, join the entry: one network a part, as the paper has it. A run without a result
    stands alone.
    """
    entries: list[Entry] = []
    for run in runs:
        entry = next((one for one in entries if _belongs(run, one)), None)
        if entry is None:
            entry = Entry("", failure=run.failure, pruned=run.pruned)
            entries.append(entry)
        entry.runs.append(run)
        if run.report is not None:
            entry.reports.append(run.report)
            entry.seeds.append(run.seed)
    entries = _joined(entries)
    _name(entries)
    return entries


def _joined(entries: Sequence[Entry]) -> list[Entry]:
    """Join entries that differ in nothing but their parts."""
    methods: list[list[Entry]] = []
    for entry in entries:
        method = next((one for one in methods if _is_of_another_part(entry, one)), None)
        if method is None:
            methods.append([entry])
        else:
            method.append(entry)
    return [method[0] if len(method) == 1 else _join(method) for method in methods]


def _is_of_another_part(entry: Entry, method: Sequence[Entry]) -> bool:
    first = method[0]
    if not entry.reports or not first.reports or not entry.runs[0].recipe:
        return False
    known = {name for one in method for name in one.reports[0].errors}
    return (
        entry.runs[0].recipe == first.runs[0].recipe
        and entry.reports[0].name == first.reports[0].name
        and None not in entry.seeds
        and set(entry.seeds) == set(first.seeds)
        and known.isdisjoint(entry.reports[0].errors)
    )


def _join(method: Sequence[Entry]) -> Entry:
    by_seed = [dict(zip(entry.seeds, entry.reports, strict=True)) for entry in method]
    return replace(
        method[0],
        reports=[Report.joined([one[seed] for one in by_seed]) for seed in method[0].seeds],
        runs=[run for entry in method for run in entry.runs],
    )


def _belongs(run: Run, entry: Entry) -> bool:
    """Tell whether a run is another seed of what an entry holds."""
    first = entry.runs[0]
    return (
        run.report is not None
        and first.report is not None
        and run.seed is not None
        and run.seed not in entry.seeds
        and None not in entry.seeds
        and bool(run.recipe)
        and (run.recipe, _shown(run.report)) == (first.recipe, _shown(first.report))
    )


def _shown(report: Report) -> tuple[str, str]:
    return report.name, report.test_set


def _name(entries: Sequence[Entry]) -> None:
    """Name each entry after its model and the overrides in which the entries differ.

    Where these are too many, and where two entries would have one name, the folder's name serves.
    """
    overrides = [
        [text for text in entry.runs[0].overrides if all(text in r.overrides for r in entry.runs)]
        for entry in entries
    ]
    for entry, mine in zip(entries, overrides, strict=True):
        differing = [text for text in mine if not all(text in other for other in overrides)]
        rest = [text for text in differing if not text.startswith("model=")]
        entry.name = " ".join([entry.runs[0].model, *rest])
        if len(entry.name) > _LONGEST_NAME:
            entry.name = f"{entry.runs[0].model} {_place(entry)}"
    counts = Counter(entry.name for entry in entries)
    for entry in entries:
        if counts[entry.name] > 1:
            entry.name = f"{entry.name} {_place(entry)}"


def _place(entry: Entry) -> str:
    """Return a run folder's name; of a job, whose name is a number, with its multirun's."""
    folder = entry.runs[0].folder.resolve()
    return f"{folder.parent.name}/{folder.name}" if folder.name.isdigit() else folder.name


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
    for name, one in COMPARED.items():
        mine, theirs = (
            [np.stack([one.counted(report, part) for report in method]) for part in objects]
            for method in (first, second)
        )
        difference = paired_difference(mine, theirs, one.statistic, same_seeds=same)
        found[name] = _within_shares(difference) if one.statistic == "mean" else difference
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
