"""What the runs logged while they trained, as lines to overlay (paper Fig. 12)."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from dopepp.drawing.panels import Line
from dopepp.experiment.compare.entry import Entry

LOG_FILE: Final = "metrics.csv"

Series = dict[int, float]
"""Step to value."""


def training_lines(
    entries: Sequence[Entry], column: str, colours: Mapping[str, str], scale: float = 1.0
) -> list[Line]:
    """Return a line per method for a column of ``metrics.csv``; also of runs that did not finish.

    Several seeds are drawn at the steps that all of them have logged.

    Args:
        entries: The methods.
        column: E.g. ``train/loss``.
        colours: By method.
        scale: Factor of the values.
    """
    lines = []
    for entry in entries:
        series = [one for run in entry.runs if (one := logged(run.folder / LOG_FILE, column))]
        steps = sorted(set(series[0]).intersection(*series[1:])) if series else []
        if steps:
            values = scale * np.array([[one[step] for step in steps] for one in series])
            lines.append(Line(entry.name, np.array(steps, float), values, colours[entry.name]))
    return lines


def logged(path: Path, column: str) -> Series:
    """Return what a log holds in a column; empty where there is no such file or column."""
    if not path.is_file():
        return {}
    with path.open(newline="", errors="replace") as stream:
        rows = list(csv.DictReader(stream))
    cells = ((_number(row.get("step")), _number(row.get(column))) for row in rows)
    return {int(step): value for step, value in cells if step is not None and value is not None}


def _number(text: object) -> float | None:
    """Return a finite number, None for anything else that a log may hold."""
    try:
        number = float(str(text))
    except ValueError:
        return None
    return number if math.isfinite(number) else None
