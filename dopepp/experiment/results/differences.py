"""Compare methods: collect their values with the differences (Δ) to a baseline.

To compare a further measure, add the score of an instance to :data:`COMPARED`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from operator import attrgetter
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.experiment.results.compared_runs import Entry
from dopepp.experiment.results.frame import (
    COST_FORMS,
    DELTA,
    FIELDS,
    MIN_DIFFERING,
    WITHIN_NOISE,
    Row,
    Value,
    means,
    pivot,
    row_values,
)
from dopepp.experiment.results.report import Report
from dopepp.metrics.bootstrap import StatisticName, paired_difference
from dopepp.metrics.pose import MEAN

REFINED_NOTE: Final = (
    "Δ of refined poses is against the first refined row, whose own Δ is against the first row."
)

# Measures of the compact table; the full table shows all measures and all Δ.
_HEADLINE: Final = frozenset({
    "", "add_01d", "pass_5cm", "pass_10cm", "auc_10cm", "median_rotation_deg", "miss_rate",
    "precision", "false_per_frame", "average_precision", "coverage",
    f"{DELTA}add_01d", f"{DELTA}auc_10cm", f"{DELTA}median_rotation_deg", *COST_FORMS,
})  # fmt: skip
_SYMMETRIC: Final = frozenset({"add_or_s_01d", "median_rotation_s_deg"})

# Score of every instance of an object, from a report and the object's name.
Scores = Callable[[Report, str], Float[np.ndarray, "instances"]]

COMPARED: Final[dict[str, tuple[Scores, StatisticName]]] = {
    "add_01d": (lambda report, name: report.errors[name] < 0.1 * report.diameters[name], "mean"),
    "pass_5cm": (lambda report, name: report.errors[name] < 0.05, "mean"),
    "pass_10cm": (lambda report, name: report.errors[name] < 0.1, "mean"),
    "auc_10cm": (lambda report, name: np.clip(1 - report.errors[name] / 0.1, 0, 1), "mean"),
    "median_rotation_deg": (lambda report, name: report.rotation_deg[name], "median"),
}
"""Measures with a Δ, by their field of ``PoseRow``: score of the instances and its statistic."""


def comparable(entry: Entry, baseline: Entry) -> bool:
    """Return whether two methods have the same known fingerprint of test images."""
    return bool(entry.test_set) and entry.test_set == baseline.test_set


def differences(entry: Entry, baseline: Entry | None, name: str) -> dict[str, Value]:
    """Return Δ of a method to a baseline on an object or ``mean``, by field of ``PoseRow``.

    The bootstrap samples seeds in pairs if both methods have the same seeds.
    """
    values = {field: Value(entry.name, name, f"{DELTA}{field}") for field in COMPARED}
    objects = _scored(entry, name)
    if baseline is None or not comparable(entry, baseline) or objects != _scored(baseline, name):
        return values
    # Reports are sorted by seed so that equal seeds are paired.
    first, second = _by_seed(entry), _by_seed(baseline)
    unknown = None in entry.seeds or None in baseline.seeds
    same = len(first) == len(second) == 1 or (
        not unknown and sorted(map(str, entry.seeds)) == sorted(map(str, baseline.seeds))
    )
    for field, (score, statistic) in COMPARED.items() if objects else ():
        scores, baseline_scores = (
            [np.stack([score(report, part) for report in method]).astype(float) for part in objects]
            for method in (first, second)
        )
        change = paired_difference(scores, baseline_scores, statistic, same_seeds=same)
        if change is None:
            values[field] = values[field]._replace(num_differing=0)
            continue
        # With few seeds the interval may exceed the largest possible difference of two shares.
        limit = 1.0 if statistic == "mean" else math.inf
        values[field] = values[field]._replace(
            value=change.value,
            low=max(change.low, -limit),
            high=min(change.high, limit),
            num_differing=change.num_differing,
            seeds_needed=math.nan if change.seeds_needed is None else change.seeds_needed,
        )
    return values


def _scored(entry: Entry, name: str) -> list[str]:
    """Return the objects with instances that a row averages: one object, or all for ``mean``."""
    errors = entry.reports[0].errors
    return sorted(part for part in errors if len(errors[part]) and name in (part, MEAN))


def _by_seed(entry: Entry) -> list[Report]:
    pairs = zip(entry.seeds, entry.reports, strict=True)
    return [report for _, report in sorted(pairs, key=lambda pair: str(pair[0]))]


def comparison_values(entries: Sequence[Entry]) -> list[Value]:
    """Return the values of a comparison: means over seeds, ordered by method and object.

    The references of the baseline's test set come last. A method without a result has one value,
    whose object states the reason.
    """
    return means(_values(entries))


def _values(entries: Sequence[Entry]) -> Iterator[Value]:
    """Yield the values of :func:`comparison_values`, one per seed, method by method."""
    baseline = next((entry for entry in entries if entry.reports), None)
    for entry in entries:
        if entry.failure:
            yield Value(entry.name, f"{'pruned' if entry.pruned else 'failed'}: {entry.failure}")
        elif not entry.reports:
            yield from _cost_values(entry, "cost only")
        for name in entry.objects:
            changes = differences(entry, _baseline_of(entry, entries), name)
            for field in FIELDS:
                for seed, report in zip(entry.seeds, entry.reports, strict=True):
                    (value,) = row_values(report.rows[name], [field])
                    yield value._replace(method=entry.name, seed=seed)
                if field in changes:
                    yield changes[field]
            yield from _cost_values(entry, name)
    for rows in baseline.reports[0].references.values() if baseline else ():
        yield from row_values(rows[MEAN] if len(rows) > 2 else next(iter(rows.values())))


def _baseline_of(entry: Entry, entries: Sequence[Entry]) -> Entry | None:
    """Return the baseline of an entry: the first result with the same kind of refinement."""
    measured = [each for each in entries if each.reports]
    alike = [each for each in measured if each.refine == entry.refine]
    # The first refined entry is compared with the first entry, which has no baseline.
    return next((each for each in (alike[0], measured[0]) if each is not entry), None)


def _cost_values(entry: Entry, name: str) -> Iterator[Value]:
    for measure, value in zip(COST_FORMS, vars(entry.cost).values(), strict=True):
        yield Value(entry.name, name, measure, math.nan if value is None else float(value))


def compact_table(values: Sequence[Value], symmetric: bool = False) -> list[Row]:
    """Return the main measures of a comparison, with ``value ± deviation`` and ``Δ [interval]``."""
    chosen = _HEADLINE | _SYMMETRIC if symmetric else _HEADLINE
    several = _has_seeds(values)

    def cells(value: Value) -> Row:
        return _labels(value, several) | ({value.heading: value.summary} if value.measure else {})

    shown = (value for value in values if value.measure in chosen)
    return pivot(shown, ("method", "object"), cells)


def full_table(values: Sequence[Value]) -> list[Row]:
    """Return a table with a cell per measure, deviation, Δ, interval end, and verdict on noise."""
    several = _has_seeds(values)

    def cells(value: Value) -> Row:
        row, title = _labels(value, True), value.heading
        if value.measure:
            row[title] = value.text
        if value.is_change:
            verdict = WITHIN_NOISE if value.within_noise else "beyond noise"
            texts = [*value.ends, verdict] if value.ends else [value.text] * 3
            row |= zip((f"{title} {end}" for end in ("low", "high", "verdict")), texts, strict=True)
        elif several and value.measure in FIELDS:
            row[f"± {title}"] = value.spread
        return row

    return pivot(values, ("method", "object"), cells)


def _labels(value: Value, with_seeds: bool) -> Row:
    """Return the labels of a row: method, object and, for pose measures, seeds."""
    if not with_seeds or value.measure not in FIELDS:
        return value.names
    return {**value.names, "seeds": ", ".join(map(str, value.seeds))}


def _has_seeds(values: Sequence[Value]) -> bool:
    return any(len(value.seeds) > 1 for value in values)


def notes(entries: Sequence[Entry], values: Sequence[Value]) -> list[str]:
    """Return sentences that explain the table: baseline, intervals, noise and narrowed networks."""
    sentences: list[str] = []
    measured = [entry for entry in entries if entry.reports]
    networks = [entry for entry in measured if not entry.refine]
    if len(measured) > 1:
        sentences += _baseline_notes(measured[0], networks[1:] or measured[1:], noise_notes(values))
    if len(measured) > len(networks) > 1:
        sentences.append(REFINED_NOTE)
    return [*sentences, *width_notes(entries)]


def width_notes(entries: Sequence[Entry]) -> list[str]:
    """Return a sentence about the widths of narrowed networks, if there are any."""
    models = [run.config.get("model") for entry in entries for run in entry.runs]
    widths = {float(model.get("width", 1.0)) for model in models if isinstance(model, dict)}
    if factors := ", ".join(f"{width:g}" for width in sorted(widths - {1.0})):
        narrowed = f"The networks were narrowed by model.width={factors}"
        return [f"{narrowed}; costs are of the narrowed networks."]
    return []


def _baseline_notes(
    baseline: Entry, others: Sequence[Entry], doubts: Sequence[str]
) -> Iterator[str]:
    """Yield sentences: baseline and intervals, ``doubts`` (on noise), and methods without Δ."""
    alike = [entry for entry in others if comparable(entry, baseline)]
    if alike:
        yield _interval_note(baseline, alike)
        yield from doubts
    seeds = set(baseline.seeds)
    several = [entry for entry in alike if max(len(entry.seeds), len(seeds)) > 1]
    if unpaired := [entry.name for entry in several if set(entry.seeds) != seeds]:
        sentence = "Not paired over seeds, because the seeds differ from the seeds of"
        yield f"{sentence} {baseline.name}: {', '.join(unpaired)}."
    if not baseline.test_set:
        sentence = f"Without Δ: the result of {baseline.name} does not identify its test images"
        yield f"{sentence}; measure again with evaluate.py."
    elif unlike := [entry.name for entry in others if not comparable(entry, baseline)]:
        sentence = f"Without Δ, because measured on other images than {baseline.name}"
        yield f"{sentence}: {', '.join(unlike)}."


def _interval_note(baseline: Entry, alike: Sequence[Entry]) -> str:
    """Return a sentence about the baseline of Δ and the sources of noise in its interval."""
    count = sum(len(errors) for errors in baseline.reports[0].errors.values())
    sentence = (
        f"Δ is against {baseline.name}, with its 95 % interval from a paired bootstrap over the "
        f"same {count:,} test instances"
    )
    single_seed = [entry.name for entry in (baseline, *alike) if len(entry.reports) == 1]
    if len(single_seed) == len(alike) + 1:
        return f"{sentence}. The interval excludes the noise of training (one training each)."
    if single_seed:
        names = ", ".join(single_seed)
        unknown = f"the training noise of {names}, which has a single training"
        return f"{sentence} and over seeds. The interval excludes {unknown}."
    return f"{sentence} and over the seeds of the trainings."


def noise_notes(values: Sequence[Value]) -> list[str]:
    """Return sentences with the measures, by method and object, whose Δ is not significant."""
    several = len({value.object for value in values if not math.isnan(value.num_differing)}) > 1
    changes = [value for value in values if value.is_change and not math.isnan(value.value)]
    sentences = []
    for (method, name), group in groupby(changes, attrgetter("method", "object")):
        if unsure := [value for value in group if value.within_noise]:
            subject = f"{method} on {name}" if several else method
            measures = (f"{value.column.heading}{_needed(value)}" for value in unsure)
            sentences.append(f"Within noise, {subject}: {', '.join(measures)}.")
    if any(value.num_differing < MIN_DIFFERING for value in changes):
        sentence = f"If methods differ on fewer than {MIN_DIFFERING} instances"
        sentences.append(f"{sentence}, the difference counts as noise.")
    return sentences


def _needed(change: Value) -> str:
    """Return a remark on how many seeds would make a difference significant, if known."""
    if math.isnan(change.seeds_needed) or change.value == 0:
        return ""
    if math.isinf(change.seeds_needed):
        return " (significant with more images only)"
    return f" (significant with about {change.seeds_needed:,.0f} seeds)"
