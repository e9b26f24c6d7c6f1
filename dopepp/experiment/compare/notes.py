"""What must be said below a comparison: against what, how sure, and what was not compared."""

from __future__ import annotations

import math
from collections.abc import Sequence

from dopepp.experiment.compare.differences import comparable
from dopepp.experiment.compare.entry import Entry
from dopepp.experiment.compare.table import Line
from dopepp.metrics.bootstrap import Difference
from dopepp.metrics.row import COLUMNS


def notes(entries: Sequence[Entry], table: Sequence[Line]) -> list[str]:
    """Return a sentence or two for each thing that the table alone does not say."""
    baseline = next((entry for entry in entries if entry.reports), None)
    found = []
    if baseline is not None:
        others = [entry for entry in entries if entry.reports and entry is not baseline]
        compared = [entry for entry in others if comparable(entry, baseline)]
        if compared:
            found += [_how(baseline, compared), *noise(table), *_unpaired(baseline, compared)]
        found += _not_compared(baseline, others)
    return found + _narrowed(entries)


def _how(baseline: Entry, compared: Sequence[Entry]) -> str:
    """Say what Δ is against and what its interval knows of."""
    count = sum(len(errors) for errors in baseline.reports[0].errors.values())
    text = (
        f"Δ is against {baseline.name}, with its 95 % interval from a paired bootstrap over the "
        f"same {count:,} test instances"
    )
    alone = [entry.name for entry in (baseline, *compared) if len(entry.reports) == 1]
    if len(alone) == len(compared) + 1:
        return f"{text}. One training each: the noise of training is not in it."
    if alone:
        return f"{text} and over seeds. Of {', '.join(alone)} there is one training: the noise of "\
            "that training is not in it."  # fmt: skip
    return f"{text} and over the seeds of the trainings."


def noise(table: Sequence[Line]) -> list[str]:
    """Name, for every method and object, the differences that may be chance."""
    several = len({line.object for line in table if line.differences}) > 1
    found = []
    for line in table:
        unsure = [
            f"{column.heading}{_needed(one)}"
            for column in COLUMNS
            if (one := line.differences.get(column.field)) is not None and one.within_noise
        ]
        if unsure:
            subject = f"{line.method} on {line.object}" if several else line.method
            found.append(f"Within noise, {subject}: {', '.join(unsure)}.")
    known = [one for line in table for one in line.differences.values() if one is not None]
    few = [one.fewest for one in known if one.num_differing < one.fewest]
    if few:
        found.append(
            f"Where methods differ on fewer than {few[0]} instances, no difference is called more "
            "than noise."
        )
    return found


def _needed(difference: Difference) -> str:
    """Say at how many seeds a difference of this size would be more than noise."""
    if difference.seeds_to_tell is None or difference.value == 0:
        return ""
    if math.isinf(difference.seeds_to_tell):
        return " (more images would be needed to tell)"
    return f" (about {difference.seeds_to_tell:,.0f} seeds would tell)"


def _unpaired(baseline: Entry, compared: Sequence[Entry]) -> list[str]:
    """Name methods whose seeds are not the baseline's."""
    mine = set(baseline.seeds)
    others = [
        entry.name
        for entry in compared
        if max(len(entry.seeds), len(mine)) > 1 and set(entry.seeds) != mine
    ]
    if not others:
        return []
    return [f"Not of the same seeds as {baseline.name}, so not paired over them: "
            f"{', '.join(others)}."]  # fmt: skip


def _not_compared(baseline: Entry, others: Sequence[Entry]) -> list[str]:
    """Name methods that were measured on something else."""
    unlike = [entry.name for entry in others if not comparable(entry, baseline)]
    if not baseline.test_set and others:
        return [f"Without Δ: {baseline.name} does not say which images it was measured on; "
                "evaluate.py measures it again."]  # fmt: skip
    if not unlike:
        return []
    return [f"Without Δ, because not measured on the same images as {baseline.name}: "
            f"{', '.join(unlike)}."]  # fmt: skip


def _narrowed(entries: Sequence[Entry]) -> list[str]:
    """Say it when networks were narrowed."""
    models = [run.config.get("model") for entry in entries for run in entry.runs]
    widths = {float(model.get("width", 1.0)) for model in models if isinstance(model, dict)}
    factors = ", ".join(f"{width:g}" for width in sorted(widths - {1.0}))
    if not factors:
        return []
    return [f"The networks were narrowed by model.width={factors}; figures of cost are of these."]
