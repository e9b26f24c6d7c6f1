"""What the shading protocol writes down: the paper's table, a CSV file, curves and examples."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from dopepp.data.shading import TOLERANCE
from dopepp.drawing.png import figure_image, write_png, write_whole
from dopepp.drawing.rates import RateCurve, rates_figure
from dopepp.drawing.sheet import Tile, contact_sheet
from dopepp.experiment import display
from dopepp.experiment.pass_rates import PassRate, heading
from dopepp.experiment.shading import ShadedRows
from dopepp.experiment.tables import csv_text, markdown_text
from dopepp.metrics.functional import wilson_interval
from dopepp.metrics.pose import MEAN
from dopepp.metrics.row import COLUMNS

_log = logging.getLogger(__name__)

SHADING_FILE: Final = "shading.csv"

_FIELDS: Final = ("auc_10cm", "median_rotation_deg", "miss_rate")
"""Measures that stand beside the pass rates."""

_SYMMETRIC: Final = ("median_rotation_s_deg",)
"""Further ones, where a part has symmetries."""


def record_shading(
    run_dir: Path,
    measured: Sequence[ShadedRows],
    tiles: Sequence[Tile],
    rates: Sequence[PassRate],
) -> None:
    """Print the table and write ``shading.csv``, ``.md``, ``.png`` and ``shading_examples.png``.

    Args:
        run_dir: Where the files go.
        measured: By share, 0 first.
        tiles: The examples, image by image.
        rates: The pass rates.
    """
    is_symmetric = any(
        row.num_symmetries > 1 for rows in measured[0].rows.values() for row in rows.values()
    )
    fields = [*(rate.field for rate in rates), *_FIELDS, *(_SYMMETRIC if is_symmetric else ())]
    tables = {name: _table(measured, name) for name in fields}
    shown = [{"measure": heading(name), **row} for name, rows in tables.items() for row in rows]
    display.show_table("shading: share of the visible area covered", shown, num_labels=3)
    for line in (notes := _notes(measured)):
        _log.warning("%s", line)
    write_whole(run_dir / SHADING_FILE, csv_text(_records(measured, fields)).encode())
    parts = [f"## {heading(name)}\n\n{markdown_text(rows)}" for name, rows in tables.items()]
    text = "\n".join([f"{_INTRODUCTION}\n", *(f"{line}\n" for line in notes), *parts])
    write_whole(run_dir / "shading.md", text.encode())
    figure = rates_figure(
        _panels(measured, rates), "share of the visible area covered (%)", len(rates)
    )
    write_png(run_dir / "shading.png", figure_image(figure))
    if tiles:
        sheet = contact_sheet(tiles, columns=len(measured))
        write_png(run_dir / "shading_examples.png", sheet)


_INTRODUCTION: Final = """# Shading

Columns: the share of every object's visible pixels that patches of the image's own background
cover (paper Table 3). What counts is decided before the shading."""


def _objects(measured: Sequence[ShadedRows], method: str) -> list[str]:
    """Return what a method has a row for: its objects and, of several, their mean."""
    objects = list(measured[0].rows[method])
    return objects if len(objects) > 2 else [name for name in objects if name != MEAN]


def _table(measured: Sequence[ShadedRows], name: str) -> list[dict[str, str]]:
    """Return one measure in the paper's layout: a row per method and object, shares in columns."""
    (column,) = (column for column in COLUMNS if column.field == name)
    return [
        {
            "method": method,
            "object": label,
            **{f"{100 * one.share:g} %": column.text(one.rows[method][label]) for one in measured},
        }
        for method in measured[0].rows
        for label in _objects(measured, method)
    ]


def _records(measured: Sequence[ShadedRows], fields: Sequence[str]) -> list[dict[str, object]]:
    """Return the rows of the CSV file: shares in [0, 1], n/a empty."""
    return [
        {
            "method": method,
            "object": label,
            "share": one.share,
            "share_reached": 0.0 if one.share == 0 else one.mean_reached,
            "num_outside_tolerance": one.num_outside,
            "num_instances": one.rows[method][label].num_instances,
            **{name: getattr(one.rows[method][label], name) for name in fields},
        }
        for method in measured[0].rows
        for label in _objects(measured, method)
        for one in measured
    ]


def _notes(measured: Sequence[ShadedRows]) -> list[str]:
    """Say where the share was not reached."""
    return [
        f"At {100 * one.share:g} %, {one.num_outside} of {len(one.reached)} instances are not "
        f"within {100 * TOLERANCE:g} points of it: no mask, or no background to cover them with."
        for one in measured
        if one.num_outside
    ]


def _panels(
    measured: Sequence[ShadedRows], rates: Sequence[PassRate]
) -> dict[str, dict[str, RateCurve]]:
    """Return a panel per object and rate, all methods in each."""
    labels = dict.fromkeys(label for method in measured[0].rows.values() for label in method)
    labels.pop(MEAN)
    panels = {}
    for label in labels:
        for rate in rates:
            title = f"{label}: {rate.heading.removesuffix(' %')}"
            panels[title] = {
                method: _curve(measured, method, label, rate)
                for method, rows in measured[0].rows.items()
                if label in rows and rows[label].num_instances
            }
    return panels


def _curve(measured: Sequence[ShadedRows], method: str, label: str, rate: PassRate) -> RateCurve:
    """Return one method's rate on one object over the share."""
    points = []
    for one in measured:
        row = one.rows[method][label]
        value = getattr(row, rate.field)
        interval = wilson_interval(round(value * row.num_instances), row.num_instances)
        points.append((100 * one.share, value, *interval))
    return RateCurve(*np.array(points, np.float64).T)
