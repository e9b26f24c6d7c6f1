"""What a condition's measurement leaves: a table, a CSV file, curves and examples.

A condition that makes a test set harder or easier, level by level: shading, scale.

To add one, write a module like :mod:`dopepp.experiment.reports.scale`: a :class:`Condition`, and a
function that measures a list of :class:`Level`. :func:`record_condition` writes it down.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.core.files import write_png, write_whole
from dopepp.drawing.curves import RateCurve, figure_image, rates_figure
from dopepp.drawing.sheet import Tile, contact_sheet
from dopepp.experiment.reports.evaluators import FileMethod, Method
from dopepp.experiment.reports.tables import PassRate, csv_text, heading, markdown_text
from dopepp.experiment.runs import display
from dopepp.metrics.functional import wilson_interval
from dopepp.metrics.pose import MEAN
from dopepp.metrics.row import COLUMNS, PoseRow

MAX_EXAMPLES: Final = 4
"""Images on the sheet of examples; each is shown once per level."""


@dataclass(frozen=True)
class Condition:
    """What changes from level to level, and how its levels are shown.

    Attributes:
        name: The option's name; the files are called after it.
        axis: What is changed, with the unit in which levels are shown.
        level: Name of the CSV file's column of levels.
        form: How a level is written in that unit, e.g. ``{:g} %``.
        introduction: What stands above the tables, Markdown.
        images: What the images of its levels are, of which a file has no poses.
        per_unit: By what a level is multiplied to have that unit.
        ratio: Whether levels are ratios, which a logarithmic axis spaces evenly.
    """

    name: str
    axis: str
    level: str
    form: str
    introduction: str
    images: str
    per_unit: float = 1.0
    ratio: bool = False

    @property
    def table_file(self) -> str:
        """Name of the CSV file."""
        return f"{self.name}.csv"

    def shown(self, level: float) -> float:
        """Return a level in the unit of the axis."""
        return self.per_unit * level

    def heading(self, level: float) -> str:
        """Return what stands above a level's column."""
        return self.form.format(self.shown(level))

    def check_methods(self, methods: Mapping[str, Method]) -> None:
        """Make sure that every method can be run on other images than it was run on.

        Raises:
            UserError: One of them is a file of poses.
        """
        for name, method in methods.items():
            if isinstance(method, FileMethod):
                raise UserError(
                    f"{self.name} with results of {name}, which has no poses on {self.images}",
                    "checkpoints (ckpt_path, baseline)", f"leave out {self.name} or results",
                )  # fmt: skip


@dataclass(frozen=True)
class Level:
    """What was measured at one level.

    Attributes:
        value: The level.
        rows: A row per object and their mean, by method.
        facts: Further columns of the CSV file, over all objects.
        note: What a reader must know of this level; empty for nothing.
    """

    value: float
    rows: Mapping[str, Mapping[str, PoseRow]]
    facts: Mapping[str, object] = field(default_factory=dict)
    note: str = ""


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
