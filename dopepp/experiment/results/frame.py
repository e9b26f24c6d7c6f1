"""Measured values, of which all tables are views.

:func:`means` averages a list of :class:`Value` over seeds, and :func:`pivot` arranges the values as
a table, which :func:`markdown`, :func:`~dopepp.core.files.write_csv` or
:func:`~dopepp.experiment.results.display.show_table` write.
The module also defines the pass rates that all protocols report (:class:`PassRate`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Final, Literal, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool
from torch import Tensor

from dopepp.drawing.curves import RateCurve
from dopepp.experiment.config.data_config import DataConfig
from dopepp.metrics.bootstrap import fewest_differing
from dopepp.metrics.functional import coverage, wilson_interval
from dopepp.metrics.pose import MEAN, EvaluatedInstances
from dopepp.metrics.row import COLUMNS, NOT_AVAILABLE, Column, PoseRow, symmetry_transforms
from dopepp.parts.part import Parts

Row = dict[str, str]  # texts of a table row by column heading

DELTA: Final = "Δ "  # prefix of measures that are differences to the baseline

COST_FORMS: Final = {"parameters": ",.0f", "GMACs": ".3f", "ms/frame": ".1f"}
FIELDS: Final = {column.field: column for column in COLUMNS}
NOMINAL: Final = np.linspace(0.05, 0.95, 19)  # probabilities of the measured covariance regions
WITHIN_NOISE: Final = "within noise"
MIN_DIFFERING: Final = fewest_differing(0.95)  # instances, for a significant difference

# Headings of text columns.
_TEXTS: Final = ("method", "object", "measure", "overrides", "folder", "job", "state")

Cell = TypeVar("Cell")


class Value(NamedTuple):
    """A measured value; missing numbers are NaN."""

    method: str  # or a reference
    object: str  # name of the part, `mean`, or the reason for a missing result
    measure: str = ""  # field of `PoseRow`, `DELTA` and a field, a heading, or empty
    value: float = math.nan  # in the field's unit
    seed: int | None = None  # of the training; None if unknown
    condition: float = 0.0  # level of a condition, or the middle of a bin
    low: float = math.nan  # ends of the 95 % interval
    high: float = math.nan
    num_differing: float = math.nan  # instances on which the compared methods differ
    seeds_needed: float = math.nan  # approximate number of seeds for a significant difference
    deviation: float = math.nan  # sample standard deviation over the seeds
    seeds: tuple[int, ...] = ()  # of the method on the object

    @property
    def names(self) -> Row:
        """Method and object, the labels of a table row."""
        return {"method": self.method, "object": self.object}

    @property
    def is_change(self) -> bool:
        """Whether the value is a difference from the baseline."""
        return self.measure.startswith(DELTA)

    @property
    def within_noise(self) -> bool:
        """Whether too few instances differ, or the interval of a difference contains 0."""
        return self.num_differing < MIN_DIFFERING or self.low <= 0 <= self.high

    @property
    def column(self) -> Column:
        """Column of the measure, which defines its format."""
        field = self.measure.removeprefix(DELTA)
        return FIELDS.get(field) or Column(field, field)

    @property
    def heading(self) -> str:
        """Column heading of the measure, with its unit."""
        return f"{DELTA if self.is_change else ''}{self.column.heading}"

    @property
    def text(self) -> str:
        """Text for tables: ``n/a`` for a missing value, empty for a Δ that is undefined."""
        form = COST_FORMS.get(self.measure)
        if not self.measure or (self.is_change and math.isnan(self.num_differing)):
            return ""
        if form is not None:
            return NOT_AVAILABLE if math.isnan(self.value) else format(self.value, form)
        return self._shown(self.value)

    @property
    def spread(self) -> str:
        """Text of the standard deviation over seeds; empty for a single seed."""
        if len(self.seeds) < 2 or self.is_change:
            return ""
        decimals = max(self.column.decimals, 1)
        spread = self.deviation * self.column.scale
        return NOT_AVAILABLE if math.isnan(spread) else f"{spread:.{decimals}f}"

    @property
    def ends(self) -> list[str]:
        """Texts of the ends of the 95 % interval; empty without an interval."""
        return [] if math.isnan(self.low) else [self._shown(self.low), self._shown(self.high)]

    @property
    def summary(self) -> str:
        """Mean ± deviation, or Δ with its interval and a mark if not significant."""
        if self.is_change and self.ends:
            unsure = f" {WITHIN_NOISE}" if self.within_noise else ""
            return f"{self.text} [{', '.join(self.ends)}]{unsure}"
        return self.text if math.isnan(self.deviation) else f"{self.text} ± {self.spread}"

    @property
    def plain(self) -> int | float | None:
        """Value for CSV files: an integer for a count; None, an empty cell, for NaN."""
        if math.isnan(self.value):
            return None
        return int(self.value) if self.measure.startswith("num_") else self.value

    def _shown(self, value: float) -> str:
        """Format a number in the unit of its column, with a sign for a difference."""
        return self.column.format(None if math.isnan(value) else value, signed=self.is_change)


def row_values(
    row: PoseRow, fields: Iterable[str] = FIELDS, rates: Sequence[str] = (), condition: float = 0.0
) -> Iterator[Value]:
    """Yield the values of ``fields`` of a row; those in ``rates`` have a 95 % interval."""
    for field in fields:
        value = getattr(row, field)
        value = math.nan if value is None else float(value)
        ends = interval(value, row.num_instances if field in rates else 0)
        yield Value(row.method, row.object, field, value, None, condition, *ends)


def interval(rate: float, num: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a rate over ``num`` instances; NaN without instances."""
    exists = num > 0 and not math.isnan(rate)
    return wilson_interval(round(rate * num), num) if exists else (math.nan, math.nan)


def means(values: Iterable[Value]) -> list[Value]:
    """Average values over seeds: one value per method, object, measure and condition.

    The mean is NaN if the value of any seed is missing; a mean over the others would be biased.
    """
    groups: dict[tuple[object, ...], list[Value]] = {}
    for value in values:
        key = (value.method, value.object, value.measure, value.condition)
        groups.setdefault(key, []).append(value)
    averages = []
    for group in groups.values():
        numbers = [value.value for value in group]
        averages.append(
            group[0]._replace(
                value=fmean(numbers),
                deviation=float(np.std(numbers, ddof=1)) if len(numbers) > 1 else math.nan,
                seeds=tuple(sorted(value.seed for value in group if value.seed is not None)),
            )
        )
    return averages


def pivot(
    values: Iterable[Value], keys: Sequence[str], cells: Callable[[Value], Mapping[str, Cell]]
) -> list[dict[str, Cell]]:
    """Return a table row per combination of ``keys``, merged from the cells of its values."""
    rows: dict[tuple[object, ...], dict[str, Cell]] = {}
    for value in values:
        rows.setdefault(tuple(getattr(value, key) for key in keys), {}).update(cells(value))
    return list(rows.values())


def heading(measure: str) -> str:
    """Return the column heading of a measure, with its unit."""
    return Value("", "", measure).heading


def header_of(rows: Sequence[Mapping[str, object]]) -> list[str]:
    """Return all headings, beginning with the headings of the longest row."""
    return list(dict.fromkeys([*max(rows, key=len), *(key for row in rows for key in row)]))


def markdown(rows: Sequence[Mapping[str, str]]) -> str:
    """Format rows as a Markdown table with right-aligned numbers."""
    header = header_of(rows)
    aligned = [
        "---" if number == 0 or title in _TEXTS else "---:" for number, title in enumerate(header)
    ]
    cells = [header, aligned, *([row.get(title, "") for title in header] for row in rows)]
    return "".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in cells
    )


def rate_curves(rates: Iterable[Value], per_unit: float = 1.0) -> dict[str, RateCurve]:
    """Return a curve for each method: the rate against the condition multiplied by ``per_unit``."""
    points: dict[str, list[tuple[float, ...]]] = {}
    for rate in rates:
        point = (per_unit * rate.condition, rate.value, rate.low, rate.high)
        points.setdefault(rate.method, []).extend([point] if rate.ends else [])
    arrays = {method: np.array(rows).reshape(-1, 4).T for method, rows in points.items()}
    return {method: RateCurve(*columns) for method, columns in arrays.items()}


def coverage_curve(instances: EvaluatedInstances) -> RateCurve | None:
    """Return the observed against the nominal coverage of an object's covariance regions.

    None without a matched pose that has a covariance.
    """
    distances = instances.errors.mahalanobis
    stated = None if distances is None else distances[distances.isfinite()]
    if stated is None or not len(stated):
        return None
    rates = np.array([coverage(stated, level) for level in NOMINAL])
    ends = np.array([interval(rate, len(stated)) for rate in rates])
    return RateCurve(NOMINAL, rates, *ends.T)


def shown_rows(rows: Mapping[str, PoseRow]) -> dict[str, PoseRow]:
    """Return the rows of all objects, and their mean if there are several."""
    return {name: row for name, row in rows.items() if name != MEAN or len(rows) > 2}


@dataclass(frozen=True)
class PassRate:
    """Share of instances whose error is below a threshold."""

    field: str  # of `PoseRow`
    error: Literal["add", "mssd"]
    threshold: float  # in diameters if relative, else in metres
    relative: bool = True

    @property
    def title(self) -> str:
        """Title of the rate's curves: its heading without the unit."""
        return heading(self.field).removesuffix(" %")

    def passed(self, instances: EvaluatedInstances) -> Bool[Tensor, "n"]:
        """Return which instances of an object have an error below the threshold."""
        unit = instances.part.diameter if self.relative else 1.0
        errors: Tensor = getattr(instances.errors, self.error)
        return errors < self.threshold * unit


ADD_01D: Final = PassRate("add_01d", "add", 0.1)
ADD_5CM: Final = PassRate("pass_5cm", "add", 0.05, relative=False)
ADD_10CM: Final = PassRate("pass_10cm", "add", 0.1, relative=False)
MSSD_01D: Final = PassRate("mssd_01d", "mssd", 0.1)


def reported_rates(data: DataConfig, parts: Parts) -> tuple[PassRate, ...]:
    """Return the paper's pass rate (0.1 m on YCB-Video, else 0.05 m) and the strict rates."""
    is_ycb = data.root is not None and data.format == "ycb_video"
    rates = (ADD_10CM if is_ycb else ADD_5CM), ADD_01D
    symmetric = any(len(symmetry_transforms(part)) > 1 for part in parts)
    return (*rates, MSSD_01D) if symmetric else rates
