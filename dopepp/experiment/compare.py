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
from dopepp.experiment import display
from dopepp.experiment.methods import Cost
from dopepp.experiment.report import FULL_SIZE_COST, Report
from dopepp.metrics.pose import MEAN
from dopepp.metrics.row import COLUMNS, NOT_AVAILABLE, PoseRow

BASELINE: Final = "dope"
"""A method of this name stands first, and every other one's Δ is against it."""

_WITH_DELTA: Final = ("add_01d", "auc_10cm")

_SHOWN: Final = (
    "method", "object", "ADD-0.1d %", "Δ ADD-0.1d %", "ADD<5cm %", "ADD<10cm %", "AUC[0,10cm] %",
    "Δ AUC[0,10cm] %", "rotation °", "missed %", "parameters", "GMACs", "ms/frame",
)  # fmt: skip
"""What the terminal has room for; the files hold everything."""


@dataclass
class Failure:
    """A job that gave no result.

    Attributes:
        name: The method's name.
        reason: Why, in one line.
    """

    name: str
    reason: str


def compare(
    results: Sequence[Report | Failure], folder: Path, note: str = "", baseline: str = BASELINE
) -> None:
    """Print and write ``compare.csv``, ``compare.md`` and ``compare_auc.{png,csv}`` into a folder.

    Args:
        results: One per method.
        folder: Where the files go.
        note: A line below the table, e.g. that both networks were narrowed.
        baseline: The method of this name, else the first one, is the baseline.
    """
    ordered = sorted(results, key=lambda r: baseline not in (r.name, r.name.split(" ")[0]))
    table = comparison_table(ordered)
    display.show_comparison([{key: row[key] for key in _SHOWN if key in row} for row in table])
    write_whole(folder / "compare.csv", _csv(table).encode())
    write_whole(folder / "compare.md", _markdown(table, note).encode())
    curves = {
        result.name: np.concatenate(list(result.errors.values()))
        for result in ordered
        if isinstance(result, Report)
    }
    if curves:
        save_accuracy_curves(folder / "compare_auc", curves, title="ADD, all objects")


def comparison_table(results: Sequence[Report | Failure]) -> list[dict[str, str]]:
    """Return a row per method and object, heading to text; the first result is the baseline.

    The reference rows of the test set stand at the end.
    """
    baseline = next((result for result in results if isinstance(result, Report)), None)
    table: list[dict[str, str]] = []
    for result in results:
        if isinstance(result, Failure):
            table.append({"method": result.name, "object": f"failed: {result.reason}"})
            continue
        for name, row in result.rows.items():
            if name == MEAN and len(result.rows) == 2:
                continue
            other = None if result is baseline or baseline is None else baseline.rows.get(name)
            measures = _measures(row, other)
            table.append({"method": result.name, "object": name, **measures, **_costs(result)})
    if baseline is not None:
        for reference, by_object in baseline.references.items():
            row = by_object[MEAN] if len(by_object) > 2 else next(iter(by_object.values()))
            table.append({"method": reference, "object": row.object, **_measures(row, None)})
    return table


def _measures(row: PoseRow, baseline: PoseRow | None) -> dict[str, str]:
    """Return a row's measures, the headline ones followed by their difference to the baseline."""
    texts = {}
    for column in COLUMNS:
        texts[column.heading] = column.text(row)
        if column.field not in _WITH_DELTA:
            continue
        mine = getattr(row, column.field)
        base = None if baseline is None else getattr(baseline, column.field)
        if baseline is None:
            difference = ""
        elif mine is None or base is None:
            difference = NOT_AVAILABLE
        else:
            difference = f"{(mine - base) * column.scale:+.{column.decimals}f}"
        texts[f"Δ {column.heading}"] = difference
    return texts


def _costs(report: Report) -> dict[str, str]:
    """Return the cost in this run and, of a narrowed network, at full size beside it."""
    texts = _cost(report.cost, "")
    full = report.details.get(FULL_SIZE_COST)
    return texts if full is None else {**texts, **_cost(Cost(**full), "full-size ")}


def _cost(cost: Cost, prefix: str) -> dict[str, str]:
    """Return what is known of a cost."""
    facts = {"parameters": (cost.parameters, ","), "GMACs": (cost.gmacs, ".3f"),
             "ms/frame": (cost.ms_per_frame, ".1f")}  # fmt: skip
    return {
        f"{prefix}{heading}": NOT_AVAILABLE if value is None else format(value, form)
        for heading, (value, form) in facts.items()
    }


def _header(table: Sequence[dict[str, str]]) -> list[str]:
    """Return all headings in the order of the fullest row."""
    fullest = max(table, key=len)
    return list(fullest)


def _csv(table: Sequence[dict[str, str]]) -> str:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, _header(table), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    return text.getvalue()


def _markdown(table: Sequence[dict[str, str]], note: str) -> str:
    header = _header(table)
    lines = [
        header,
        ["---"] * len(header),
        *([row.get(key, "") for key in header] for row in table),
    ]
    text = "\n".join("| " + " | ".join(_escaped(cell) for cell in line) + " |" for line in lines)
    return f"{text}\n\n{note}\n" if note else f"{text}\n"


def _escaped(cell: str) -> str:
    return cell.replace("|", "\\|")
