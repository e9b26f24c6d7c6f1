"""The paper's tables: a sweep's runs in the paper's layout, beside what the paper printed.

A config names its table under ``table`` (see ``conf/experiment/``): a title, a kind, labels for the
overrides in which the runs differ, and the paper's figures where they are known. To add a kind,
write a function of table and runs that returns rows, and give it a line in :data:`KINDS`.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Final

import numpy as np

from dopepp.drawing.png import figure_image, write_png, write_whole
from dopepp.drawing.rates import RateCurve, rates_figure
from dopepp.errors import UserError
from dopepp.experiment import display, record
from dopepp.experiment.compare.entry import Entry
from dopepp.experiment.compare.table import Line, with_deviation
from dopepp.experiment.cost import COST_FILE, FRAMES_FILE, read_frames, save_frame_rates
from dopepp.experiment.pass_rates import ADD_5CM, ADD_10CM, heading
from dopepp.experiment.shading import SHADING
from dopepp.experiment.tables import Row, csv_text, markdown_text
from dopepp.experiment.yaml_file import read_yaml
from dopepp.metrics.functional import wilson_interval
from dopepp.metrics.pose import MEAN
from dopepp.metrics.row import COLUMNS

_PASS_FIELDS: Final = {rate.threshold: rate.field for rate in (ADD_5CM, ADD_10CM)}
_FIELDS: Final = ("auc_10cm", "add_01d", "median_rotation_deg")
"""What stands behind the paper's pass rate."""
_METHOD: Final = "method"


@dataclass(frozen=True)
class PaperTable:
    """How a sweep's table is laid out.

    Attributes:
        title: Its title, with the paper's number.
        kind: A key of :data:`KINDS`.
        threshold: Of the paper's pass rate: 0.05 m for parts, 0.1 m for YCB-Video.
        labels: Override to what the paper calls it; a run that has several gets all of them.
        paper: The paper's figures, by label and heading; what is not known is left out.
    """

    title: str
    kind: str = "poses"
    threshold: float = 0.05
    labels: Mapping[str, str] = field(default_factory=dict)
    paper: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> PaperTable:
        """Read the config's ``table``.

        Raises:
            UserError: A field or a value is unknown.
        """
        known = [entry.name for entry in fields(cls)]
        unknown = sorted(set(config) - set(known))
        if unknown:
            raise UserError(f"table.{unknown[0]}", ", ".join(known), "correct the table's field")
        if "title" not in config:
            raise UserError("a table without a title", "table.title", "name the table")
        table = cls(**config)
        if table.kind not in KINDS:
            raise UserError(f"table.kind={table.kind!r}", ", ".join(KINDS), "choose one of them")
        if table.threshold not in _PASS_FIELDS:
            allowed = ", ".join(f"{one:g}" for one in _PASS_FIELDS)
            raise UserError(f"table.threshold={table.threshold}", f"{allowed}, metres", "change it")
        return table

    @classmethod
    def read(cls, path: Path) -> PaperTable:
        """Read the ``table`` of an experiment's file, ``conf/experiment/NAME.yaml``.

        Raises:
            UserError: The file cannot be read, or its table is missing or wrong.
        """
        config = read_yaml(path)
        table = config.get("table") if isinstance(config, dict) else None
        if not isinstance(table, dict):
            raise UserError(
                f"{path}, which lays out no table", "an experiment with `table:`",
                "pass conf/experiment/table….yaml",
            )  # fmt: skip
        return cls.of(table)

    @property
    def pass_field(self) -> str:
        """Field of a row that holds the paper's pass rate."""
        return _PASS_FIELDS[self.threshold]

    def label(self, entry: Entry) -> str:
        """Return what the paper calls a method, or the method's own name."""
        overrides = entry.runs[0].overrides
        return " ".join(label for key, label in self.labels.items() if key in overrides) or (
            entry.name
        )


def write_paper_table(table: PaperTable, entries: Sequence[Entry], folder: Path) -> None:
    """Print and write ``table.md`` and ``table.csv``, and the figure of a kind that has one.

    Args:
        table: The layout.
        entries: The sweep's methods; one without a result is a row that says why.
        folder: Where the files go.
    """
    rows = KINDS[table.kind](table, entries, folder)
    rows += [
        {_METHOD: f"{label}, the paper", **{key: f"{value:,}" for key, value in figures.items()}}
        for label, figures in table.paper.items()
    ]
    display.show_table(table.title, rows)
    write_whole(folder / "table.csv", csv_text(rows).encode())
    notes = [f"- {note}" for note in _notes(table)]
    text = "\n".join([f"# {table.title}", "", markdown_text(rows), *notes])
    write_whole(folder / "table.md", f"{text}\n".encode())


def _notes(table: PaperTable) -> list[str]:
    notes = []
    if table.kind in ("poses", "shading"):
        notes.append(f"The paper's pass rate is ADD < {table.threshold:g} m.")
    if not table.paper:
        notes.append("The figures the paper prints in this table are not part of this project.")
    return notes


def _pose_rows(table: PaperTable, entries: Sequence[Entry], folder: Path) -> list[Row]:
    """Return pass rate, AUC, ADD-0.1d and rotation of every object, then the reference rows."""
    columns = [column for column in COLUMNS if column.field in (table.pass_field, *_FIELDS)]
    measured = next((entry for entry in entries if entry.reports), None)
    rows = [
        _failed(table, entry)
        if not entry.reports
        else {
            _METHOD: table.label(entry),
            **{
                _of_object(column.heading, name, entry.objects): with_deviation(
                    Line(entry.name, name, entry, entry.row(name)), column
                )
                for name in entry.objects
                for column in columns
            },
        }
        for entry in entries
    ]
    if measured is None:
        return rows
    for reference, by_object in measured.reports[0].references.items():
        texts = {
            _of_object(column.heading, name, measured.objects): column.text(by_object[name])
            for name in measured.objects
            for column in columns
        }
        rows.append({_METHOD: reference, **texts})
    return rows


def _shading_rows(table: PaperTable, entries: Sequence[Entry], folder: Path) -> list[Row]:
    """Return two pass rates at every share, means over seeds, and draw them for all methods."""
    rows: list[Row] = []
    panels: dict[str, dict[str, RateCurve]] = {}
    for measure in (table.pass_field, "add_01d"):
        for entry in entries:
            curve = _shading_curve([run.folder / SHADING.table_file for run in entry.runs], measure)
            if curve is None:
                rows.append(_failed(table, entry))
                continue
            texts = {f"{x:g} %": f"{100 * y:.1f}" for x, y in zip(curve.x, curve.rate, strict=True)}
            rows.append({_METHOD: table.label(entry), "measure": heading(measure), **texts})
            panels.setdefault(heading(measure), {})[table.label(entry)] = curve
    if panels:
        figure = rates_figure(panels, SHADING.axis, len(panels))
        write_png(folder / "table_shading.png", figure_image(figure))
    return rows


def _shading_curve(paths: Sequence[Path], measure: str) -> RateCurve | None:
    """Return the mean rate of some runs against the share, with Wilson's interval; None without."""
    measured = [_read_shading(path, measure) for path in paths]
    if not all(measured):
        return None
    shares = list(measured[0])
    rates = np.array([[one[share][0] for share in shares] for one in measured]).mean(axis=0)
    counts = np.sum([[one[share][1] for share in shares] for one in measured], axis=0)
    intervals = [
        wilson_interval(round(rate * count), int(count))
        for rate, count in zip(rates, counts, strict=True)
    ]
    return RateCurve(100 * np.array(shares), rates, *np.array(intervals).T)


def _read_shading(path: Path, measure: str) -> dict[float, tuple[float, int]]:
    """Return rate and number of instances by share, over all objects; nothing without a file."""
    if not path.is_file():
        return {}
    with path.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    wanted = MEAN if any(row["object"] == MEAN for row in rows) else rows[0]["object"]
    return {
        float(row["share"]): (float(row[measure]), int(row["num_instances"]))
        for row in rows
        if row["object"] == wanted
    }


def _parameter_rows(table: PaperTable, entries: Sequence[Entry], folder: Path) -> list[Row]:
    """Return what was counted."""
    return [
        {
            _METHOD: table.label(entry),
            "backbone weights": f"{cost['backbone_weights']:,}",
            "parameters": f"{cost['parameters']:,}",
            "GMACs": f"{cost['gmacs']:.3f}",
        }
        for entry in entries
        if (cost := _read_cost(entry)) is not None
    ]


def _time_rows(table: PaperTable, entries: Sequence[Entry], folder: Path) -> list[Row]:
    """Return what was timed, and draw the frame rates (paper Fig. 13)."""
    rows, frames = [], {}
    for entry in entries:
        cost = _read_cost(entry)
        if cost is None:
            rows.append(_failed(table, entry))
            continue
        frames[table.label(entry)] = read_frames(entry.runs[0].folder / FRAMES_FILE)
        batch, (width, height) = cost["batch_size"], cost["input_size"]
        rows.append(
            {
                _METHOD: table.label(entry),
                "ms/frame": f"{cost['ms_per_frame']:.1f}",
                f"frames/s, batch {batch}": f"{cost['frames_per_s']:.1f}",
                "pixels": f"{width}×{height}",
                "on": f"{cost['device']}, {cost['threads']} threads",
            }
        )
    if frames:
        save_frame_rates(folder / "frame_rate.png", frames)
    return rows


KINDS: Final[Mapping[str, Callable[[PaperTable, Sequence[Entry], Path], list[Row]]]] = {
    "poses": _pose_rows,
    "shading": _shading_rows,
    "parameters": _parameter_rows,
    "time": _time_rows,
}


def _read_cost(entry: Entry) -> dict[str, Any] | None:
    path = entry.runs[0].folder / COST_FILE
    return record.read_json(path) if path.is_file() else None


def _failed(table: PaperTable, entry: Entry) -> Row:
    return {_METHOD: f"{table.label(entry)}: {entry.failure or 'no such measurement'}"}


def _of_object(text: str, name: str, objects: Sequence[str]) -> str:
    return text if len(objects) == 1 else f"{name} {text}"
