"""What a condition's measurement leaves: a table, a CSV file, curves and examples."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from dopepp.drawing.png import figure_image, write_png, write_whole
from dopepp.drawing.rates import RateCurve, rates_figure
from dopepp.drawing.sheet import Tile, contact_sheet
from dopepp.experiment import display
from dopepp.experiment.condition import Condition, Level
from dopepp.experiment.pass_rates import PassRate, heading
from dopepp.experiment.tables import csv_text, markdown_text
from dopepp.metrics.functional import wilson_interval
from dopepp.metrics.pose import MEAN
from dopepp.metrics.row import COLUMNS

_log = logging.getLogger(__name__)

_FIELDS: Final = ("auc_10cm", "median_rotation_deg", "miss_rate")
"""Measures that stand beside the pass rates."""

_SYMMETRIC: Final = ("median_rotation_s_deg",)
"""Further ones, where a part has symmetries."""


def record_condition(
    run_dir: Path,
    condition: Condition,
    levels: Sequence[Level],
    tiles: Sequence[Tile],
    rates: Sequence[PassRate],
) -> None:
    """Print the table and write ``NAME.csv``, ``.md``, ``.png`` and ``NAME_examples.png``.

    Args:
        run_dir: Where the files go.
        condition: What was changed.
        levels: What was measured, ascending.
        tiles: The examples, image by image, each at all levels.
        rates: The pass rates.
    """
    is_symmetric = any(
        row.num_symmetries > 1 for rows in levels[0].rows.values() for row in rows.values()
    )
    fields = [*(rate.field for rate in rates), *_FIELDS, *(_SYMMETRIC if is_symmetric else ())]
    tables = {name: _table(condition, levels, name) for name in fields}
    shown = [{"measure": heading(name), **row} for name, rows in tables.items() for row in rows]
    display.show_table(f"{condition.name}: {condition.axis}", shown, num_labels=3)
    notes = [level.note for level in levels if level.note]
    for line in notes:
        _log.warning("%s", line)
    records = csv_text(_records(condition, levels, fields))
    write_whole(run_dir / condition.table_file, records.encode())
    parts = [f"## {heading(name)}\n\n{markdown_text(rows)}" for name, rows in tables.items()]
    text = "\n".join([f"{condition.introduction}\n", *(f"{line}\n" for line in notes), *parts])
    write_whole(run_dir / f"{condition.name}.md", text.encode())
    panels = _panels(condition, levels, rates)
    figure = rates_figure(panels, condition.axis, len(rates), ratio=condition.ratio)
    write_png(run_dir / f"{condition.name}.png", figure_image(figure))
    if tiles:
        sheet = contact_sheet(tiles, columns=len(levels))
        write_png(run_dir / f"{condition.name}_examples.png", sheet)


def _objects(levels: Sequence[Level], method: str) -> list[str]:
    """Return what a method has a row for: its objects and, of several, their mean."""
    objects = list(levels[0].rows[method])
    return objects if len(objects) > 2 else [name for name in objects if name != MEAN]


def _table(condition: Condition, levels: Sequence[Level], name: str) -> list[dict[str, str]]:
    """Return one measure in the paper's layout: a row per method and object, levels in columns."""
    (column,) = (column for column in COLUMNS if column.field == name)
    return [
        {
            "method": method,
            "object": label,
            **{
                condition.heading(one.value): column.text(one.rows[method][label]) for one in levels
            },
        }
        for method in levels[0].rows
        for label in _objects(levels, method)
    ]


def _records(
    condition: Condition, levels: Sequence[Level], fields: Sequence[str]
) -> list[dict[str, object]]:
    """Return the rows of the CSV file: rates in [0, 1], n/a empty."""
    return [
        {
            "method": method,
            "object": label,
            condition.level: one.value,
            **one.facts,
            "num_instances": one.rows[method][label].num_instances,
            **{name: getattr(one.rows[method][label], name) for name in fields},
        }
        for method in levels[0].rows
        for label in _objects(levels, method)
        for one in levels
    ]


def _panels(
    condition: Condition, levels: Sequence[Level], rates: Sequence[PassRate]
) -> dict[str, dict[str, RateCurve]]:
    """Return a panel per object and rate, in each every method that was measured on it."""
    labels = dict.fromkeys(label for rows in levels[0].rows.values() for label in rows)
    labels.pop(MEAN)
    return {
        f"{label}: {rate.heading.removesuffix(' %')}": {
            method: curve
            for method, rows in levels[0].rows.items()
            if label in rows and len((curve := _curve(condition, levels, method, label, rate)).x)
        }
        for label in labels
        for rate in rates
    }


def _curve(
    condition: Condition, levels: Sequence[Level], method: str, label: str, rate: PassRate
) -> RateCurve:
    """Return one method's rate on one object over the levels at which an instance counts."""
    points = []
    for one in levels:
        row = one.rows[method][label]
        if row.num_instances:
            value = getattr(row, rate.field)
            interval = wilson_interval(round(value * row.num_instances), row.num_instances)
            points.append((condition.shown(one.value), value, *interval))
    return RateCurve(*np.array(points, np.float64).reshape(-1, 4).T)
