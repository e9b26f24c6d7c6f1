"""Methods side by side: their figures, Δ to the baseline, how sure it is, and what to say of it.

To compare a further measure, add an entry to :data:`COMPARED`: what an instance counts in it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.experiment.results.entries import Entry
from dopepp.experiment.results.evaluators import Cost
from dopepp.experiment.results.report import FULL_SIZE_COST, Report
from dopepp.experiment.results.tables import DELTA, Figure, Row, pivot
from dopepp.metrics.bootstrap import Difference, StatisticName, paired_difference
from dopepp.metrics.pose import MEAN
from dopepp.metrics.row import COLUMNS, NOT_AVAILABLE, PoseRow

WITHIN: Final = "within noise"
BEYOND: Final = "beyond noise"

REFINED_NOTE: Final = (
    "Δ of refined poses is against the first refined row, whose own Δ is against the first row."
)

_SEEDS: Final = "seeds"
_COSTS: Final = {"parameters": ",", "GMACs": ".3f", "ms/frame": ".1f"}
"""Headings of the fields of :class:`Cost`, and how they are written."""

_HEADLINE: Final = ("add_01d", "pass_5cm", "pass_10cm", "auc_10cm", "median_rotation_deg",
                    "miss_rate")  # fmt: skip
"""Fields of the compact table."""

_SYMMETRIC: Final = ("add_or_s_01d", "median_rotation_s_deg")
"""More of them where an object has symmetries, of which the others know nothing."""

_WITH_INTERVAL: Final = ("add_01d", "auc_10cm", "median_rotation_deg")
"""Those of them whose Δ stands beside them; the full table has every one of ``COMPARED``."""

_FIELDS: Final = {column.field for column in COLUMNS}

Counted = Callable[[Report, str], Float[np.ndarray, "instances"]]
"""A report and an object's name to what each instance of it counts."""


def _passes(threshold: float) -> Counted:
    """Count an instance whose ADD is below a threshold, metres."""
    return lambda report, name: (report.errors[name] < threshold).astype(np.float64)


COMPARED: Final[dict[str, tuple[Counted, StatisticName]]] = {
    "add_01d": (lambda one, name: _passes(0.1 * one.diameters[name])(one, name), "mean"),
    "pass_5cm": (_passes(0.05), "mean"),
    "pass_10cm": (_passes(0.1), "mean"),
    "auc_10cm": (lambda one, name: np.clip(1 - one.errors[name] / 0.1, 0, 1), "mean"),
    "median_rotation_deg": (lambda one, name: one.rotation_deg[name], "median"),
}
"""Measures with a Δ, by their field of ``PoseRow``, as a statistic of what instances count."""


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
    for field, (counted, statistic) in COMPARED.items():
        mine, theirs = (
            [np.stack([counted(report, part) for report in method]) for part in objects]
            for method in (first, second)
        )
        difference = paired_difference(mine, theirs, statistic, same_seeds=same)
        if difference is not None and statistic == "mean":
            # Few seeds may have stretched the interval beyond what two shares can differ by.
            low, high = max(difference.low, -1.0), min(difference.high, 1.0)
            difference = replace(difference, low=low, high=high)
        found[field] = difference
    return found


def _scored(entry: Entry, name: str) -> list[str]:
    """Return the objects with instances that a row is about: one, or for the mean all."""
    errors = entry.reports[0].errors
    return sorted(part for part in errors if len(errors[part]) and name in (part, MEAN))


def _by_seed(entry: Entry) -> list[Report]:
    pairs = zip(entry.seeds, entry.reports, strict=True)
    return [report for _, report in sorted(pairs, key=lambda pair: str(pair[0]))]


def figures(entries: Sequence[Entry]) -> list[Figure]:
    """Return the table of a comparison, method by method and object by object.

    The first entry with a result is the baseline, of refined poses its refined ones (see
    :func:`_opposite`). The reference rows of its test set stand at the end. A method without a
    result has one line, whose object says why.
    """
    baseline = next((entry for entry in entries if entry.reports), None)
    table: list[Figure] = []
    for entry in entries:
        if entry.failure:
            state = "pruned" if entry.pruned else "failed"
            reason = f"{state}: {entry.failure}"
            table.append(Figure(entry.name, reason, "object", reason))
        elif baseline is None or not entry.reports:
            table += _cost_figures(entry, "cost only")
        else:
            opposite = _opposite(entry, entries)
            for name in entry.objects:
                known = {} if opposite is None else differences(entry, opposite, name)
                table += _object_figures(entry, name, known)
                table += _cost_figures(entry, name)
    for reference, rows in baseline.reports[0].references.items() if baseline else ():
        table += row_figures(reference, rows[MEAN] if len(rows) > 2 else next(iter(rows.values())))
    return table


def _opposite(entry: Entry, entries: Sequence[Entry]) -> Entry | None:
    """Return what an entry is set off against: the first with a result, refined if it is itself.

    The first refined one is set off against the first of all, and that one against nothing.
    """
    measured = [one for one in entries if one.reports]
    alike = [one for one in measured if one.refine == entry.refine]
    return next((one for one in (alike[0], measured[0]) if one is not entry), None)


def _object_figures(
    entry: Entry, name: str, known: dict[str, Difference | None]
) -> Iterator[Figure]:
    """Return a method's figures of an object: means over the seeds, and Δ where it is known.

    A measure that one seed lacks does not exist: a mean over the others would flatter.
    """
    seeds = tuple(entry.seeds)
    named = sorted(map(str, seeds), key=lambda text: (len(text), text))
    yield Figure(entry.name, name, _SEEDS, "" if seeds == (None,) else ", ".join(named), 0, seeds)
    for column in COLUMNS:
        values = [getattr(report.rows[name], column.field) for report in entry.reports]
        mean = None if None in values else float(np.mean(values))
        spread = float(np.std(values, ddof=1)) if mean is not None and len(values) > 1 else None
        yield Figure(entry.name, name, column.field, mean, seeds=seeds, deviation=spread)
        if column.field in COMPARED:
            difference = known.get(column.field)
            value = None if difference is None else difference.value
            shown = value if column.field in known else ""
            yield Figure(entry.name, name, f"{DELTA}{column.field}", shown, difference=difference)


def row_figures(reference: str, row: PoseRow) -> Iterator[Figure]:
    """Return the figures of a reference row, which nothing is set off against."""
    yield Figure(reference, row.object, _SEEDS, "")
    for column in COLUMNS:
        yield Figure(reference, row.object, column.field, getattr(row, column.field))


def _cost_figures(entry: Entry, name: str) -> Iterator[Figure]:
    """Return the cost in this run and, of a narrowed network, at full size behind it."""
    costs = {"": entry.cost}
    if entry.reports and (wide := entry.reports[0].details.get(FULL_SIZE_COST)) is not None:
        costs["full-size "] = Cost(**wide)
    for prefix, cost in costs.items():
        for (title, form), value in zip(_COSTS.items(), vars(cost).values(), strict=True):
            text = NOT_AVAILABLE if value is None else format(value, form)
            yield Figure(entry.name, name, f"{prefix}{title}", text)


def headline(table: Sequence[Figure], symmetric: bool = False) -> list[Row]:
    """Return the compact table: ``value ± deviation`` and ``Δ [interval]`` in one cell each.

    ``symmetric`` says whether an object has symmetries.
    """
    chosen = {"object", *_HEADLINE, *(f"{DELTA}{field}" for field in _WITH_INTERVAL), *_COSTS}
    if symmetric:
        chosen.update(_SYMMETRIC)
    if _has_seeds(table):
        chosen.add(_SEEDS)
    return pivot(
        (one for one in table if one.measure in chosen),
        attrgetter("method", "object"),
        lambda one: {**one.names, one.heading: summary(one)},
    )


def full(table: Sequence[Figure]) -> list[Row]:
    """Return everything, a number a cell: measures, deviations, Δ, its interval and verdict."""
    several = _has_seeds(table)

    def cells(one: Figure) -> Row:
        row = {**one.names, one.heading: one.text}
        if one.measure.startswith(DELTA):
            return row | _interval_cells(one)
        if several and one.measure in _FIELDS:
            row[f"± {one.heading}"] = _deviation(one)
        return row

    return pivot(table, attrgetter("method", "object"), cells)


def summary(one: Figure) -> str:
    """Return a mean with its deviation; Δ with its interval and, where it may be chance, that."""
    if one.difference is not None:
        low, high = one.ends
        unsure = f" {WITHIN}" if one.difference.within_noise else ""
        return f"{one.text} [{low}, {high}]{unsure}"
    return one.text if one.deviation is None else f"{one.text} ± {_deviation(one)}"


def _has_seeds(table: Sequence[Figure]) -> bool:
    """Tell whether any method was trained with several seeds."""
    return any(len(one.seeds) > 1 for one in table)


def _deviation(one: Figure) -> str:
    """Return the standard deviation over seeds; empty of one seed."""
    if len(one.seeds) < 2:
        return ""
    if one.deviation is None:
        return NOT_AVAILABLE
    return f"{one.deviation * one.column.scale:.{max(one.column.decimals, 1)}f}"


def _interval_cells(one: Figure) -> Row:
    """Return the ends of Δ's interval and its verdict as cells of their own."""
    headings = [f"{one.heading} {end}" for end in ("low", "high", "verdict")]
    if one.difference is None:
        return dict.fromkeys(headings, one.text)
    verdict = WITHIN if one.difference.within_noise else BEYOND
    return dict(zip(headings, (*one.ends, verdict), strict=True))


def notes(entries: Sequence[Entry], table: Sequence[Figure]) -> list[str]:
    """Return a sentence or two for each thing that the table alone does not say."""
    found: list[str] = []
    measured = [entry for entry in entries if entry.reports]
    networks = [entry for entry in measured if not entry.refine]
    if len(measured) > 1:
        found += _compared(measured[0], networks[1:] or measured[1:], noise(table))
    if len(measured) > len(networks) > 1:
        found.append(REFINED_NOTE)
    models = [run.config.get("model") for entry in entries for run in entry.runs]
    widths = {float(model.get("width", 1.0)) for model in models if isinstance(model, dict)}
    if factors := ", ".join(f"{width:g}" for width in sorted(widths - {1.0})):
        narrowed = f"The networks were narrowed by model.width={factors}"
        found.append(f"{narrowed}; figures of cost are of these.")
    return found


def _compared(baseline: Entry, others: Sequence[Entry], doubts: Sequence[str]) -> Iterator[str]:
    """Say what Δ is against, how sure it is, and what has none."""
    compared = [entry for entry in others if comparable(entry, baseline)]
    if compared:
        yield _how(baseline, compared)
        yield from doubts
    mine = set(baseline.seeds)
    several = [one for one in compared if max(len(one.seeds), len(mine)) > 1]
    if unpaired := [entry.name for entry in several if set(entry.seeds) != mine]:
        said = f"Not of the same seeds as {baseline.name}, so not paired over them"
        yield f"{said}: {', '.join(unpaired)}."
    if not baseline.test_set:
        said = f"Without Δ: {baseline.name} does not say which images it was measured on"
        yield f"{said}; evaluate.py measures it again."
    elif unlike := [entry.name for entry in others if not comparable(entry, baseline)]:
        said = f"Without Δ, because not measured on the same images as {baseline.name}"
        yield f"{said}: {', '.join(unlike)}."


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


def noise(table: Sequence[Figure]) -> list[str]:
    """Name, for every method and object, the differences that may be chance."""
    changes = [one for one in table if one.measure.startswith(DELTA) and one.value != ""]
    several = len({one.object for one in changes}) > 1
    unsure = [one for one in changes if one.difference is not None and one.difference.within_noise]
    found = []
    for row in pivot(unsure, attrgetter("method", "object"), lambda one: {one.measure: one}):
        one = next(iter(row.values()))
        subject = f"{one.method} on {one.object}" if several else one.method
        measures = ", ".join(f"{one.column.heading}{_needed(one)}" for one in row.values())
        found.append(f"Within noise, {subject}: {measures}.")
    known = [one.difference for one in changes if one.difference is not None]
    few = [one.fewest for one in known if one.num_differing < one.fewest]
    if few:
        said = f"Where methods differ on fewer than {few[0]} instances"
        found.append(f"{said}, no difference is called more than noise.")
    return found


def _needed(one: Figure) -> str:
    """Say at how many seeds a difference of this size would be more than noise."""
    seeds = None if one.difference is None else one.difference.seeds_to_tell
    if seeds is None or one.value == 0:
        return ""
    if math.isinf(seeds):
        return " (more images would be needed to tell)"
    return f" (about {seeds:,.0f} seeds would tell)"
