"""From run folders to the lines of a comparison: a method's seeds and parts together, and names."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from dopepp.experiment.compare.entry import Entry
from dopepp.experiment.compare.runs import Run
from dopepp.experiment.report import Report

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
