"""From run folders to the lines of a comparison: seeds of one method together, each with a name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final

from dopepp.experiment.compare.entry import Entry
from dopepp.experiment.compare.runs import Run
from dopepp.experiment.report import Report

_LONGEST_NAME: Final = 60
"""Characters of a name that tables and legends have room for."""


def group(runs: Sequence[Run]) -> list[Entry]:
    """Put runs that differ in nothing but the seed into one entry, in order of the first one.

    They must have been measured on the same test set. A run without a result stands alone.
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
    _name(entries)
    return entries


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
        [text for text in entry.runs[0].overrides
         if not (text.startswith("seed=") and len(entry.runs) > 1)]
        for entry in entries
    ]  # fmt: skip
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
