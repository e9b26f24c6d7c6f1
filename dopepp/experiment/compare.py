"""Several results as one table (terminal, CSV, Markdown) and one figure (AUC curves overlaid)."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from dopepp.drawing.curves import save_accuracy_curves
from dopepp.drawing.png import write_whole
from dopepp.experiment.display import show_comparison
from dopepp.experiment.report import Report
from dopepp.metrics.pose import MEAN
from dopepp.metrics.row import COLUMNS, NOT_AVAILABLE, PoseRow

BASELINE: Final = "dope"
"""A method of this name stands first, and every other one's Δ is against it."""

_DELTAS: Final = ("add_01d", "auc_10cm")


@dataclass(frozen=True)
class Failure:
    """A job that gave no result.

    Attributes:
        name: The method's name.
        reason: Why, in one line.
    """

    name: str
    reason: str


def compare(results: Sequence[Report | Failure], folder: Path, note: str = "") -> None:
    """Print and write ``compare.csv``, ``compare.md`` and ``compare_auc.{png,csv}`` into a folder.

    Args:
        results: One per method; a method named ``dope``, else the first one, is the baseline.
        folder: Where the files go.
        note: A line below the table, e.g. that both networks were narrowed.
    """
    ordered = sorted(results, key=lambda result: result.name.split(" ")[0] != BASELINE)
    header, rows = comparison_table(ordered)
    show_comparison(header, rows)
    write_whole(folder / "compare.csv", _csv(header, rows).encode())
    write_whole(folder / "compare.md", _markdown(header, rows, note).encode())
    curves = {
        result.name: np.concatenate(list(result.errors.values()))
        for result in ordered
        if isinstance(result, Report)
    }
    if curves:
        save_accuracy_curves(folder / "compare_auc", curves, title="ADD, all objects")


def comparison_table(
    results: Sequence[Report | Failure],
) -> tuple[list[str], list[list[str]]]:
    """Return the header and a row per method and object; the first result is the baseline."""
    measures = [column.heading for column in COLUMNS]
    deltas = [f"Δ {column.heading}" for column in COLUMNS if column.field in _DELTAS]
    header = ["method", "object", *deltas, *measures, "parameters", "GMACs", "ms/frame"]
    baseline = next((result for result in results if isinstance(result, Report)), None)
    rows: list[list[str]] = []
    for result in results:
        if isinstance(result, Failure):
            rows.append([result.name, f"failed: {result.reason}", *[""] * (len(header) - 2)])
            continue
        for name, row in result.rows.items():
            if name == MEAN and len(result.rows) == 2:
                continue
            other = None if result is baseline or baseline is None else baseline.rows.get(name)
            rows.append([result.name, name, *_deltas(row, other), *_cells(row), *_cost(result)])
    if baseline is not None:
        for reference, by_object in baseline.references.items():
            row = by_object[MEAN] if len(by_object) > 2 else next(iter(by_object.values()))
            rows.append([reference, row.object, *[""] * len(deltas), *_cells(row), "", "", ""])
    return header, rows


def _cells(row: PoseRow) -> list[str]:
    return [column.text(row) for column in COLUMNS]


def _deltas(row: PoseRow, other: PoseRow | None) -> list[str]:
    """Return the differences to the baseline in percentage points; empty for itself."""
    texts = []
    for column in COLUMNS:
        if column.field not in _DELTAS:
            continue
        mine = getattr(row, column.field)
        base = None if other is None else getattr(other, column.field)
        if other is None:
            texts.append("")
        elif mine is None or base is None:
            texts.append(NOT_AVAILABLE)
        else:
            texts.append(f"{(mine - base) * column.scale:+.{column.decimals}f}")
    return texts


def _cost(report: Report) -> list[str]:
    cost = report.cost
    ms = NOT_AVAILABLE if cost.ms_per_frame is None else f"{cost.ms_per_frame:.1f}"
    return [f"{cost.parameters:,}", f"{cost.gmacs:.3f}", ms]


def _csv(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows([header, *rows])
    return text.getvalue()


def _markdown(header: Sequence[str], rows: Sequence[Sequence[str]], note: str) -> str:
    lines = [header, ["---"] * len(header), *rows]
    table = "\n".join("| " + " | ".join(_escaped(cell) for cell in line) + " |" for line in lines)
    return f"{table}\n\n{note}\n" if note else f"{table}\n"


def _escaped(cell: str) -> str:
    return cell.replace("|", "\\|")
