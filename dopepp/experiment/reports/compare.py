"""Comparing methods: ``compare.csv``, ``compare.md`` and ``compare_auc.{png,csv}``.

Of run folders, ``compare.png`` has curves of training and test pictures as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.core.files import write_png, write_whole
from dopepp.drawing.curves import accuracy_figure, figure_image, save_accuracy_curves
from dopepp.drawing.panels import grid, lines_figure
from dopepp.drawing.pictures import Picture
from dopepp.drawing.sheet import contact_sheet
from dopepp.experiment.reports.differences import figures, full, headline, notes
from dopepp.experiment.reports.entries import BASELINE, Entry, Run, find_runs, group, ordered
from dopepp.experiment.reports.paper_table import PaperTable, write_paper_table
from dopepp.experiment.reports.pictures import NUM_PICTURES, picture_tiles, training_lines
from dopepp.experiment.reports.report import Report
from dopepp.experiment.reports.tables import Row, csv_text, markdown_text
from dopepp.experiment.runs import display

TABLE_FILE: Final = "compare.csv"
TEXT_FILE: Final = "compare.md"
CURVES_FILE: Final = "compare_auc.png"
PANELS_FILE: Final = "compare.png"
LOSS_FILE: Final = "compare_loss.png"
PICTURES_FILE: Final = "compare_pictures.png"

_MIN_COLUMNS: Final = 3
"""Tiles of fewer methods than this would be larger than anybody needs."""
_PANEL_PX: Final = 768
"""Width of a panel, where there is none to take it from."""
_GAP_PX: Final = 12
"""Room between tiles."""
_TOO_WIDE: Final = ("Δ rotation °", "parameters", "GMACs")
"""What a terminal has no room for."""


def compare_reports(reports: Sequence[Report], folder: Path, baseline: str) -> None:
    """Compare methods that were measured together; the baseline is the one of this name."""
    entries = [Entry(report.name, [report], [None]) for report in reports]
    write_comparison(ordered(entries, baseline), folder)


def write_comparison(entries: Sequence[Entry], folder: Path) -> str:
    """Print and write table and AUC curves; returns the text of ``compare.md``."""
    table = figures(entries)
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


def compare_paths(
    paths: Sequence[Path],
    out: Path | None = None,
    baseline: str | None = None,
    num_pictures: int = NUM_PICTURES,
    table: Path | None = None,
) -> Path:
    """Compare run folders and return the folder with the comparison.

    Paths are folders of trainings, evaluations and multiruns; ``out`` is a new folder under
    ``outputs/compare`` by default. Δ is against the method called ``baseline``: ``dope`` by
    default, else the first one. ``num_pictures`` test images are shown through every model. The
    methods are laid out as in the experiment's file ``table`` as well. A :class:`UserError`: a path
    holds no run, the baseline is none of the methods, the experiment has no table, or ``out`` holds
    a comparison already.
    """
    layout = None if table is None else PaperTable.read(table)
    runs = find_runs(paths)
    if out is None:
        out = Path("outputs", "compare", datetime.now().strftime("%Y-%m-%d_%H-%M-%S-%f"))
    elif (out / TABLE_FILE).exists():
        raise UserError(
            f"{out}, which holds {TABLE_FILE}", "a folder without a comparison", "choose another"
        )
    entries = compare_runs(runs, out, baseline, num_pictures)
    if layout is not None:
        write_paper_table(layout, entries, out)
    return out


def compare_runs(
    runs: Sequence[Run], folder: Path, baseline: str | None = None, num_pictures: int = NUM_PICTURES
) -> list[Entry]:
    """Print and write a comparison of runs into a folder; returns its methods.

    The table is written first, so that it is there whatever befalls curves and pictures. A
    :class:`UserError`: the baseline is none of the methods.
    """
    entries = group(runs)
    names = [entry.name for entry in entries]
    if baseline is not None and baseline not in names:
        raise UserError(f"baseline {baseline!r}", ", ".join(names), "choose one of them")
    entries = ordered(entries, baseline or BASELINE)
    text = write_comparison(entries, folder)
    panels = _panels(entries, folder)
    shown = num_pictures if any(entry.reports for entry in entries) else 0
    tiles, note = picture_tiles(entries, shown) if shown else ([], "")
    if tiles:
        write_png(folder / PICTURES_FILE, contact_sheet(tiles, len(entries)))
        width = 2 * max([one.shape[1] for one in panels], default=_PANEL_PX)
        columns = max(_MIN_COLUMNS, len(entries))
        panels = [*([grid(panels, 2)] if panels else []),
                  contact_sheet(tiles, len(entries), width // columns - _GAP_PX)]  # fmt: skip
    if panels:
        write_png(folder / PANELS_FILE, grid(panels, 1 if tiles else 2))
        text += f"\n![training, accuracy and pictures]({PANELS_FILE})\n"
    if note:
        display.console.print(note)
        text += f"\n{note}\n"
    text += f"\n{markdown_text(_origins(entries))}"
    write_whole(folder / TEXT_FILE, text.encode())
    return entries


def _origins(entries: Sequence[Entry]) -> list[Row]:
    """Return where every result comes from: all overrides and the folder."""
    return [
        {
            "method": entry.name,
            "seed": "" if run.seed is None else str(run.seed),
            "overrides": " ".join(run.overrides),
            "folder": str(run.folder),
        }
        for entry in entries
        for run in entry.runs
    ]


def _panels(entries: Sequence[Entry], folder: Path) -> list[Picture]:
    """Draw what there is of loss, validation and accuracy curves; a method has one colour."""
    colours = {entry.name: f"C{number % 10}" for number, entry in enumerate(entries)}
    panels = []
    for column, label, scale, log_y in (
        ("train/loss", "training loss", 1, True),
        ("val/loss", "validation loss", 1, True),
        ("val/add_01d", "validation ADD-0.1d (%)", 100, False),
    ):
        lines = training_lines(entries, column, colours, scale)
        if lines:
            panels.append(figure_image(lines_figure(lines, "step", label, log_y)))
    if panels:
        write_png(folder / LOSS_FILE, grid(panels, len(panels)))
    curves = accuracy_curves(entries)
    if curves:
        figure = accuracy_figure(curves, title="ADD on test images", colours=colours)
        panels.append(figure_image(figure))
    return panels
