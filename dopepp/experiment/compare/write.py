"""Writing a comparison of results: ``compare.csv``, ``compare.md``, ``compare_auc.{png,csv}``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from dopepp.drawing.curves import save_accuracy_curves
from dopepp.drawing.png import write_whole
from dopepp.experiment import display
from dopepp.experiment.compare.entry import Entry, ordered
from dopepp.experiment.compare.notes import notes
from dopepp.experiment.compare.table import full, headline, lines
from dopepp.experiment.report import Report
from dopepp.experiment.tables import csv_text, markdown_text

TABLE_FILE: Final = "compare.csv"
TEXT_FILE: Final = "compare.md"
CURVES_FILE: Final = "compare_auc.png"

_TOO_WIDE: Final = ("Δ rotation °", "parameters", "GMACs")
"""What a terminal has no room for."""


def compare_reports(reports: Sequence[Report], folder: Path, baseline: str) -> None:
    """Compare methods that were measured together; the baseline is the one of this name."""
    entries = [Entry(report.name, [report], [None]) for report in reports]
    write_comparison(ordered(entries, baseline), folder)


def write_comparison(entries: Sequence[Entry], folder: Path) -> str:
    """Print and write table and AUC curves; returns the text of ``compare.md``.

    Args:
        entries: The methods, the baseline first.
        folder: Where the files go.
    """
    table = lines(entries)
    compact, said = headline(table), notes(entries, table)
    display.show_table(
        "comparison",
        [{key: text for key, text in row.items() if key not in _TOO_WIDE} for row in compact],
        num_labels=2,
    )
    for note in said:
        display.console.print(note)
    write_whole(folder / TABLE_FILE, csv_text(full(table)).encode())
    text = "\n".join([markdown_text(compact), *(f"- {note}" for note in said)]) + "\n"
    write_whole(folder / TEXT_FILE, text.encode())
    curves = accuracy_curves(entries)
    if curves:
        save_accuracy_curves(
            (folder / CURVES_FILE).with_suffix(""), curves, title="ADD, all objects"
        )
    return text


def accuracy_curves(entries: Sequence[Entry]) -> dict[str, np.ndarray]:
    """Return the ADD of every instance of every object and seed, by method."""
    return {
        entry.name: np.concatenate([e for one in entry.reports for e in one.errors.values()])
        for entry in entries
        if entry.reports
    }
