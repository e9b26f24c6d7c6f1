"""What must be said below a comparison: against what, how sure, and what was not compared.

The comparison as a table: a compact one to read, and a full one for programs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from dopepp.experiment.reports.compare.entries import COMPARED, Entry, comparable, differences
from dopepp.experiment.reports.evaluators import Cost
from dopepp.experiment.reports.report import FULL_SIZE_COST
from dopepp.experiment.reports.tables import Row
from dopepp.metrics.bootstrap import Difference
from dopepp.metrics.pose import MEAN
from dopepp.metrics.row import COLUMNS, NOT_AVAILABLE, Column, PoseRow

WITHIN: Final = "within noise"
BEYOND: Final = "beyond noise"

_HEADLINE: Final = ("add_01d", "pass_5cm", "pass_10cm", "auc_10cm", "median_rotation_deg",
                    "miss_rate")  # fmt: skip
"""Fields of the compact table."""

_WITH_INTERVAL: Final = ("add_01d", "auc_10cm", "median_rotation_deg")
"""Those of them whose Δ stands beside them; the full table has every one of ``COMPARED``."""


@dataclass(frozen=True)
class Line:
    """One method on one object, or a reference row.

    Attributes:
        method: The method's name.
        object: The object's name, or what there is instead of a result.
        entry: The method; None for a reference row.
        row: The measures, averaged over seeds; None where there are none but perhaps the cost.
        differences: To the baseline, by the measure's field.
    """

    method: str
    object: str
    entry: Entry | None = None
    row: PoseRow | None = None
    differences: Mapping[str, Difference | None] = field(default_factory=dict)


def lines(entries: Sequence[Entry]) -> list[Line]:
    """Return a line per method and object; the first entry with a result is the baseline.

    The reference rows of the baseline's test set stand at the end.
    """
    baseline = next((entry for entry in entries if entry.reports), None)
    found = []
    for entry in entries:
        if entry.failure:
            state = "pruned" if entry.pruned else "failed"
            found.append(Line(entry.name, f"{state}: {entry.failure}"))
            continue
        if baseline is None or not entry.reports:
            found.append(Line(entry.name, "cost only", entry))
            continue
        for name in entry.objects:
            known = {} if entry is baseline else differences(entry, baseline, name)
            found.append(Line(entry.name, name, entry, entry.row(name), known))
    for reference, rows in baseline.reports[0].references.items() if baseline else ():
        row = rows[MEAN] if len(rows) > 2 else next(iter(rows.values()))
        found.append(Line(reference, row.object, None, row))
    return found


def headline(table: Sequence[Line]) -> list[Row]:
    """Return the compact table: ``value ± deviation`` and ``Δ [interval]`` in one cell each."""
    several = _has_seeds(table)
    columns = {column.field: column for column in COLUMNS}
    rows = []
    for line in table:
        row = {"method": line.method, "object": line.object}
        if line.row is not None:
            if several:
                row["seeds"] = _seeds(line)
            for name in _HEADLINE:
                column = columns[name]
                row[column.heading] = with_deviation(line, column)
                if name in _WITH_INTERVAL:
                    row[f"Δ {column.heading}"] = interval(line, column)
        row |= _costs(line, full_size=False)
        rows.append(row)
    return rows


def full(table: Sequence[Line]) -> list[Row]:
    """Return everything, a number a cell: measures, deviations, Δ, its interval and verdict."""
    rows, several = [], _has_seeds(table)
    for line in table:
        row = {"method": line.method, "object": line.object}
        if line.row is not None:
            row["seeds"] = _seeds(line)
            for column in COLUMNS:
                row[column.heading] = column.text(line.row)
                if several:
                    row[f"± {column.heading}"] = _deviation(line, column)
                if column.field in COMPARED:
                    row |= _difference(line, column)
        row |= _costs(line, full_size=True)
        rows.append(row)
    return rows


def _has_seeds(table: Sequence[Line]) -> bool:
    """Tell whether any method was trained with several seeds."""
    return any(line.entry is not None and len(line.entry.reports) > 1 for line in table)


def _seeds(line: Line) -> str:
    """Return the seeds, or how many there are where they have no numbers."""
    if line.entry is None or line.entry.seeds == [None]:
        return ""
    return ", ".join(sorted(map(str, line.entry.seeds), key=lambda text: (len(text), text)))


def _deviation(line: Line, column: Column) -> str:
    """Return the standard deviation over seeds; empty of one seed."""
    if line.entry is None or len(line.entry.reports) < 2:
        return ""
    value = line.entry.deviation(line.object, column.field)
    return NOT_AVAILABLE if value is None else f"{value * column.scale:.{max(column.decimals, 1)}f}"


def with_deviation(line: Line, column: Column) -> str:
    """Return the mean over seeds and, of several, the standard deviation."""
    assert line.row is not None
    deviation = _deviation(line, column)
    text = column.text(line.row)
    return f"{text} ± {deviation}" if deviation not in ("", NOT_AVAILABLE) else text


def _numbers(difference: Difference, column: Column) -> tuple[str, str, str]:
    """Return Δ and the ends of its interval in the table's unit."""
    ends = (difference.value, difference.low, difference.high)
    value, low, high = (f"{end * column.scale:+.{column.decimals}f}" for end in ends)
    return value, low, high


def interval(line: Line, column: Column) -> str:
    """Return Δ with its interval and, where it may be chance, that word."""
    if column.field not in line.differences:
        return ""
    difference = line.differences[column.field]
    if difference is None:
        return NOT_AVAILABLE
    value, low, high = _numbers(difference, column)
    return f"{value} [{low}, {high}]" + (f" {WITHIN}" if difference.within_noise else "")


def _difference(line: Line, column: Column) -> Row:
    """Return Δ, its interval and its verdict as cells of their own."""
    headings = [f"Δ {column.heading}{end}" for end in ("", " low", " high", " verdict")]
    if column.field not in line.differences:
        return dict.fromkeys(headings, "")
    difference = line.differences[column.field]
    if difference is None:
        return dict.fromkeys(headings, NOT_AVAILABLE)
    verdict = WITHIN if difference.within_noise else BEYOND
    return dict(zip(headings, (*_numbers(difference, column), verdict), strict=True))


def _costs(line: Line, full_size: bool) -> Row:
    """Return the cost in this run and, of a narrowed network, at full size beside it."""
    if line.entry is None:
        return {}
    texts = _cost(line.entry.cost, "")
    details = line.entry.reports[0].details if line.entry.reports else {}
    wide = details.get(FULL_SIZE_COST)
    if full_size and wide is not None:
        texts |= _cost(Cost(**wide), "full-size ")
    return texts


def _cost(cost: Cost, prefix: str) -> Row:
    """Return what is known of a cost."""
    facts = {"parameters": (cost.parameters, ","), "GMACs": (cost.gmacs, ".3f"),
             "ms/frame": (cost.ms_per_frame, ".1f")}  # fmt: skip
    return {
        f"{prefix}{heading}": NOT_AVAILABLE if value is None else format(value, form)
        for heading, (value, form) in facts.items()
    }


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
