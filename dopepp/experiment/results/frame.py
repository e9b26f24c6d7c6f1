"""The results frame: one long pandas table of what was measured; every other table is a view of it.

A row of the frame is a :class:`Value`. :func:`means` averages the frame over seeds, :func:`pivot`
lays it out, and :func:`markdown`, :func:`~dopepp.core.files.write_csv` and
:func:`~dopepp.experiment.results.display.show_table` write what comes out. The pass rates that all
protocols report stand here as well: the paper's, the strict one, and one for symmetries.

To add a rate, write it down below :class:`PassRate`; it needs a field in ``PoseRow``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, TypeVar

import numpy as np
import pandas as pd
from jaxtyping import Bool
from torch import Tensor

from dopepp.drawing.curves import RateCurve
from dopepp.experiment.config.data_config import DataConfig
from dopepp.metrics.bootstrap import fewest_differing
from dopepp.metrics.functional import wilson_interval
from dopepp.metrics.pose import MEAN, Gathered
from dopepp.metrics.row import COLUMNS, NOT_AVAILABLE, Column, PoseRow, symmetry_transforms
from dopepp.parts.part import Parts

Row = dict[str, str]
"""Heading to text."""

DELTA: Final = "Δ "
"""Prefix of a measure that is a difference to the baseline."""

COST_FORMS: Final = {"parameters": ",.0f", "GMACs": ".3f", "ms/frame": ".1f"}
"""Measures of cost and how they are written."""

FIELDS: Final = {column.field: column for column in COLUMNS}
"""Columns of the measures of poses, by their field of ``PoseRow``."""

WITHIN: Final = "within noise"
BEYOND: Final = "beyond noise"

FEWEST_DIFFERING: Final = fewest_differing(0.95)
"""Differing instances without which no difference is more than chance."""

_TEXTS: Final = ("method", "object", "measure", "overrides", "folder", "job", "state")
"""Headings of columns that hold no numbers."""

Cell = TypeVar("Cell")


class Value(NamedTuple):
    """A row of the frame; numbers that do not exist are NaN.

    Attributes:
        method: Name of the method or of the reference.
        object: Name of the part, ``mean``, or the reason why there is no result.
        measure: Field of ``PoseRow``, with :data:`DELTA` before it for a difference to the
            baseline, or a heading; empty for a method without values.
        value: Value in the field's unit.
        seed: Seed of the training; None where it is not known.
        condition: Level of a condition, or middle of a bin.
        low: Lower end of the 95 % interval.
        high: Upper end.
        num_differing: Of a difference, instances on which the methods differ; NaN where they
            cannot be compared.
        seeds_to_tell: Of a difference, about how many seeds would tell it from chance.
        deviation: Standard deviation over the seeds (of a sample) of a mean.
        seeds: Seeds of the method on the object.
    """

    method: str
    object: str
    measure: str = ""
    value: float = math.nan
    seed: int | None = None
    condition: float = 0.0
    low: float = math.nan
    high: float = math.nan
    num_differing: float = math.nan
    seeds_to_tell: float = math.nan
    deviation: float = math.nan
    seeds: tuple[int, ...] = ()

    @property
    def names(self) -> Row:
        """The labels of most tables."""
        return {"method": self.method, "object": self.object}

    @property
    def is_change(self) -> bool:
        """Whether it is a difference to the baseline."""
        return self.measure.startswith(DELTA)

    @property
    def within_noise(self) -> bool:
        """Whether such a difference is to be expected of methods that are equally good."""
        return self.num_differing < FEWEST_DIFFERING or self.low <= 0 <= self.high

    @property
    def column(self) -> Column:
        """How tables show it."""
        field = self.measure.removeprefix(DELTA)
        return FIELDS.get(field) or Column(field, field)

    @property
    def heading(self) -> str:
        """Heading with its unit."""
        return f"{DELTA if self.is_change else ''}{self.column.heading}"

    @property
    def text(self) -> str:
        """What tables show: ``n/a`` where there is no value, nothing where it makes no sense."""
        form = COST_FORMS.get(self.measure.removeprefix("full-size "))
        if not self.measure or (self.is_change and math.isnan(self.num_differing)):
            return ""
        if form is not None:
            return NOT_AVAILABLE if math.isnan(self.value) else format(self.value, form)
        return self._shown(self.value)

    @property
    def spread(self) -> str:
        """What tables show of the deviation; empty of one seed."""
        if len(self.seeds) < 2 or self.is_change:
            return ""
        decimals = max(self.column.decimals, 1)
        spread = self.deviation * self.column.scale
        return NOT_AVAILABLE if math.isnan(spread) else f"{spread:.{decimals}f}"

    @property
    def ends(self) -> list[str]:
        """What tables show of the interval; nothing where there is none."""
        return [] if math.isnan(self.low) else [self._shown(self.low), self._shown(self.high)]

    @property
    def summary(self) -> str:
        """A mean with its deviation; Δ with its interval and, where it may be chance, that."""
        if self.is_change and self.ends:
            unsure = f" {WITHIN}" if self.within_noise else ""
            return f"{self.text} [{', '.join(self.ends)}]{unsure}"
        return self.text if math.isnan(self.deviation) else f"{self.text} ± {self.spread}"

    @property
    def plain(self) -> int | float | None:
        """The value as a CSV holds it: counts are integers, nothing is an empty cell."""
        if math.isnan(self.value):
            return None
        return int(self.value) if self.measure.startswith("num_") else self.value

    def _shown(self, value: float) -> str:
        return self.column.shown(None if math.isnan(value) else value, signed=self.is_change)


def make_frame(values: Iterable[Value]) -> pd.DataFrame:
    """Return the frame of some values, in their order."""
    return pd.DataFrame(list(values), columns=Value._fields).astype({"seed": "Int64"})


def values_of(frame: pd.DataFrame, **wanted: object) -> list[Value]:
    """Return the rows that have these values in these columns."""
    chosen = np.ones(len(frame), bool)
    for name, value in wanted.items():
        chosen &= (frame[name] == value).to_numpy(bool)
    return [Value(*row) for row in frame[chosen].itertuples(index=False)]


def row_values(
    row: PoseRow,
    fields: Iterable[str] = FIELDS,
    rates: Sequence[str] = (),
    condition: float = 0.0,
) -> Iterator[Value]:
    """Return some fields of a row; ``rates`` name those that have an interval."""
    for field in fields:
        value = getattr(row, field)
        value = math.nan if value is None else float(value)
        ends = interval(value, row.num_instances if field in rates else 0)
        yield Value(row.method, row.object, field, value, None, condition, *ends)


def interval(rate: float, num: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a rate over so many instances; NaN where there are none."""
    exists = num > 0 and not math.isnan(rate)
    return wilson_interval(round(rate * num), num) if exists else (math.nan, math.nan)


def means(frame: pd.DataFrame) -> pd.DataFrame:
    """Average over seeds: a row per method, object, measure and condition.

    A measure that one seed lacks does not exist: a mean over the others would flatter.
    """
    groups = frame.groupby(["method", "object", "measure", "condition"], sort=False)
    complete = groups["value"].count() == groups.size()
    table = groups.first()
    table["value"] = groups["value"].mean().where(complete)
    table["deviation"] = groups["value"].std().where(complete)
    table["seeds"] = groups["seed"].agg(lambda seeds: tuple(sorted(seeds.dropna())))
    return table.reset_index()[list(Value._fields)]


def pivot(
    values: Iterable[Value], keys: Sequence[str], cells: Callable[[Value], Mapping[str, Cell]]
) -> list[dict[str, Cell]]:
    """Lay values out: those with equal keys become one row, which has the cells of all of them."""
    rows: dict[tuple[object, ...], dict[str, Cell]] = {}
    for value in values:
        rows.setdefault(tuple(getattr(value, key) for key in keys), {}).update(cells(value))
    return list(rows.values())


def heading(measure: str) -> str:
    """Return the heading of a measure, with its unit."""
    return Value("", "", measure).heading


def header_of(rows: Sequence[Mapping[str, object]]) -> list[str]:
    """Return all headings, those of the fullest row first."""
    return list(dict.fromkeys([*max(rows, key=len), *(key for row in rows for key in row)]))


def markdown(rows: Sequence[Mapping[str, str]]) -> str:
    """Return a Markdown table; numbers are aligned to the right."""
    header = header_of(rows)
    aligned = [
        "---" if number == 0 or title in _TEXTS else "---:" for number, title in enumerate(header)
    ]
    cells = [header, aligned, *([row.get(title, "") for title in header] for row in rows)]
    return "".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in cells
    )


def rate_curves(rates: Iterable[Value], per_unit: float = 1.0) -> dict[str, RateCurve]:
    """Return a rate over the conditions, times ``per_unit``, that had instances, by method."""
    points: dict[str, list[tuple[float, ...]]] = {}
    for rate in rates:
        point = (per_unit * rate.condition, rate.value, rate.low, rate.high)
        points.setdefault(rate.method, []).extend([point] if rate.ends else [])
    arrays = {method: np.array(rows).reshape(-1, 4).T for method, rows in points.items()}
    return {method: RateCurve(*columns) for method, columns in arrays.items()}


def shown_rows(rows: Mapping[str, PoseRow]) -> dict[str, PoseRow]:
    """Return the rows of all objects and, of several, of their mean."""
    return {name: row for name, row in rows.items() if name != MEAN or len(rows) > 2}


@dataclass(frozen=True)
class PassRate:
    """The share of instances whose error is below a threshold.

    It has a field in a :class:`~dopepp.metrics.row.PoseRow`. The threshold is in diameters where
    ``relative``, else in metres.
    """

    field: str
    error: Literal["add", "mssd"]
    threshold: float
    relative: bool = True

    @property
    def title(self) -> str:
        """What stands above its curves."""
        return heading(self.field).removesuffix(" %")

    def passed(self, instances: Gathered) -> Bool[Tensor, "n"]:
        """Tell which instances of an object pass."""
        unit = instances.part.diameter if self.relative else 1.0
        errors: Tensor = getattr(instances.errors, self.error)
        return errors < self.threshold * unit


ADD_01D: Final = PassRate("add_01d", "add", 0.1)
ADD_5CM: Final = PassRate("pass_5cm", "add", 0.05, relative=False)
ADD_10CM: Final = PassRate("pass_10cm", "add", 0.1, relative=False)
MSSD_01D: Final = PassRate("mssd_01d", "mssd", 0.1)


def reported_rates(data: DataConfig, parts: Parts) -> tuple[PassRate, ...]:
    """Return the rates for these data: the paper's and ADD-0.1d.

    The paper's is ADD below 0.1 m on images of YCB-Video, below 0.05 m on parts. Where a part has
    symmetries, of which ADD knows nothing, MSSD-0.1d stands beside them.
    """
    is_ycb = data.root is not None and data.format == "ycb_video"
    rates = (ADD_10CM if is_ycb else ADD_5CM), ADD_01D
    symmetric = any(len(symmetry_transforms(part)) > 1 for part in parts)
    return (*rates, MSSD_01D) if symmetric else rates
