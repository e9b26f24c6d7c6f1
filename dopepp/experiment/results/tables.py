"""The one results table: a line per figure, and how it becomes rows, Markdown, CSV and curves.

Whatever is measured becomes a list of :class:`Figure`. Every table, in a file or in the terminal,
is a choice of them, laid out by :func:`pivot`. The pass rates that all protocols report stand here
as well: the paper's, the strict one, and one for symmetries.

To add a rate, write it down below :class:`PassRate`; it needs a field in ``PoseRow``.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeVar

import numpy as np
from jaxtyping import Bool
from torch import Tensor

from dopepp.drawing.curves import RateCurve
from dopepp.experiment.config.data import DataConfig
from dopepp.metrics.bootstrap import Difference
from dopepp.metrics.functional import wilson_interval
from dopepp.metrics.pose import MEAN, Gathered
from dopepp.metrics.row import COLUMNS, Column, PoseRow, symmetries
from dopepp.parts.part import Parts

Row = dict[str, str]
"""Heading to text."""

DELTA: Final = "Δ "
"""What a difference to the baseline has before its measure."""

_COLUMNS: Final = {column.field: column for column in COLUMNS}
_TEXTS: Final = ("method", "object", "measure", "overrides", "folder")
"""Headings of what is no number."""

_Cell = TypeVar("_Cell")


@dataclass(frozen=True)
class Figure:
    """One line of the results table.

    Attributes:
        object: The part's name, ``mean``, or why there is no result.
        measure: A field of ``PoseRow``, with :data:`DELTA` before it for a difference to the
            baseline, or the heading of something else.
        value: In the field's unit; None where it does not exist, a text where it is no number.
        condition: The level at which it was measured; 0 where there is but one.
        seeds: Of the trainings that it is the mean of; None where unknown.
        num_instances: Instances that it is the rate of.
        deviation: Standard deviation over the seeds (of a sample); None of fewer than two.
    """

    method: str
    object: str
    measure: str
    value: float | str | None
    condition: float = 0.0
    seeds: tuple[int | None, ...] = ()
    num_instances: int = 0
    deviation: float | None = None
    difference: Difference | None = None

    @property
    def names(self) -> Row:
        """The labels of most tables."""
        return {"method": self.method, "object": self.object}

    @property
    def column(self) -> Column:
        """How tables show it."""
        return _column(self.measure.removeprefix(DELTA))

    @property
    def heading(self) -> str:
        """What stands above it, with its unit."""
        return heading(self.measure)

    @property
    def text(self) -> str:
        """What a table shows."""
        if isinstance(self.value, str):
            return self.value
        return self.column.shown(self.value, signed=self.difference is not None)

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % interval: of a difference from the bootstrap, of a rate Wilson's."""
        if self.difference is not None:
            return self.difference.low, self.difference.high
        if not self.num_instances or self.value is None:
            return None
        return wilson_interval(round(float(self.value) * self.num_instances), self.num_instances)

    @property
    def ends(self) -> list[str]:
        """What a table shows of the interval."""
        signed = self.difference is not None
        return [self.column.shown(end, signed=signed) for end in self.interval or ()]


def heading(measure: str) -> str:
    """Return what stands above a measure in tables, with its unit."""
    field = measure.removeprefix(DELTA)
    return measure.removesuffix(field) + _column(field).heading


def _column(field: str) -> Column:
    return _COLUMNS.get(field) or Column(field, field)


def shown_rows(rows: Mapping[str, PoseRow]) -> dict[str, PoseRow]:
    """Return the rows of all objects and, of several, of their mean."""
    return {name: row for name, row in rows.items() if name != MEAN or len(rows) > 2}


def select(table: Iterable[Figure], **wanted: object) -> list[Figure]:
    """Return the figures with these attributes."""
    return [one for one in table if all(getattr(one, name) == is_ for name, is_ in wanted.items())]


def pivot(
    table: Iterable[Figure],
    key: Callable[[Figure], object],
    cells: Callable[[Figure], Mapping[str, _Cell]],
) -> list[dict[str, _Cell]]:
    """Lay figures out: those with one key are a row, which has the cells of all, by heading."""
    rows: dict[object, dict[str, _Cell]] = {}
    for one in table:
        rows.setdefault(key(one), {}).update(cells(one))
    return list(rows.values())


def rate_curves(rates: Sequence[Figure], per_unit: float = 1.0) -> dict[str, RateCurve]:
    """Return, by method, a rate over the conditions, times ``per_unit``, that had instances."""
    curves = {}
    for method in dict.fromkeys(one.method for one in rates):
        own = [one for one in rates if one.method == method and one.interval is not None]
        points = [(per_unit * one.condition, one.value, *(one.interval or ())) for one in own]
        curves[method] = RateCurve(*np.array(points, np.float64).reshape(-1, 4).T)
    return curves


def header_of(rows: Sequence[Mapping[str, object]]) -> list[str]:
    """Return the headings of the fullest row; others may lack some."""
    fullest: Mapping[str, object] = max(rows, key=len)
    return list(fullest)


def read_csv(path: Path) -> list[Row]:
    """Read a CSV back; nothing where there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="", errors="replace") as stream:
        return list(csv.DictReader(stream))


def markdown_text(rows: Sequence[Mapping[str, str]], texts: Sequence[str] = _TEXTS) -> str:
    """Return a Markdown table under the headings of the fullest row, all but texts to the right."""
    header = header_of(rows)
    aligned = ["---" if heading in texts else "---:" for heading in header]
    cells = [header, aligned, *([row.get(key, "") for key in header] for row in rows)]
    return "".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in cells
    )


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
    symmetric = any(len(symmetries(part)) > 1 for part in parts)
    return (*rates, MSSD_01D) if symmetric else rates
