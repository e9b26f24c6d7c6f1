"""Tables of rows by heading as CSV and Markdown; a row may lack columns.

The pass rates that every protocol reports: the paper's, the strict one, and one for symmetries.

To add one, write it down below :class:`PassRate`; it needs a field in ``PoseRow``.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from jaxtyping import Bool
from torch import Tensor

from dopepp.experiment.config.data import DataConfig
from dopepp.metrics.assignment import symmetries
from dopepp.metrics.pose import Gathered
from dopepp.metrics.row import COLUMNS
from dopepp.parts.part import Part

Row = dict[str, str]
"""Heading to text."""

_TEXTS: Final = ("method", "object", "measure", "overrides", "folder")
"""Headings of what is no number."""


def csv_text(rows: Sequence[Mapping[str, object]]) -> str:
    """Return a CSV under the headings of the fullest row; what a row lacks, and None, is empty."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, _header(rows), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def read_csv(path: Path) -> list[Row]:
    """Read a CSV back; nothing where there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def markdown_text(rows: Sequence[Mapping[str, str]]) -> str:
    """Return a Markdown table under the headings of the fullest row, numbers to the right."""
    header = _header(rows)
    aligned = ["---" if heading in _TEXTS else "---:" for heading in header]
    cells = [header, aligned, *([row.get(key, "") for key in header] for row in rows)]
    return "".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in cells
    )


def _header(rows: Sequence[Mapping[str, object]]) -> list[str]:
    fullest: Mapping[str, object] = max(rows, key=len)
    return list(fullest)


@dataclass(frozen=True)
class PassRate:
    """The share of instances whose error is below a threshold.

    Attributes:
        field: Its field in a :class:`~dopepp.metrics.row.PoseRow`.
        error: The error.
        threshold: In metres, or in diameters where ``relative``.
        relative: Whether the threshold is in diameters.
    """

    field: str
    error: Literal["add", "mssd"]
    threshold: float
    relative: bool = True

    @property
    def heading(self) -> str:
        """What stands above it in tables, with its unit."""
        return heading(self.field)

    def passed(self, instances: Gathered) -> Bool[Tensor, "n"]:
        """Tell which instances of an object pass."""
        unit = instances.part.diameter if self.relative else 1.0
        errors: Tensor = getattr(instances.errors, self.error)
        return errors < self.threshold * unit


ADD_01D: Final = PassRate("add_01d", "add", 0.1)
ADD_5CM: Final = PassRate("pass_5cm", "add", 0.05, relative=False)
ADD_10CM: Final = PassRate("pass_10cm", "add", 0.1, relative=False)
MSSD_01D: Final = PassRate("mssd_01d", "mssd", 0.1)


def heading(field: str) -> str:
    """Return what stands above a field of a row in tables, with its unit."""
    return next(column.heading for column in COLUMNS if column.field == field)


def reported_rates(data: DataConfig, parts: Sequence[Part]) -> tuple[PassRate, ...]:
    """Return the rates for these data: the paper's and ADD-0.1d.

    The paper's is ADD below 0.1 m on images of YCB-Video, below 0.05 m on parts. Where a part has
    symmetries, of which ADD knows nothing, MSSD-0.1d stands beside them.
    """
    is_ycb = data.root is not None and data.format == "ycb_video"
    rates = (ADD_10CM if is_ycb else ADD_5CM), ADD_01D
    symmetric = any(len(symmetries(part)) > 1 for part in parts)
    return (*rates, MSSD_01D) if symmetric else rates
