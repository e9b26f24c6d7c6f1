"""Compare methods and write ``compare.csv``, ``compare.md`` and ``compare_auc.{png,csv}``.

For run folders, ``compare.png`` also shows the logged training curves (paper Fig. 12) and the
predictions of every model on the same test images (paper Fig. 14).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.core.files import read_csv, write_csv, write_png
from dopepp.data.sample import Sample
from dopepp.drawing.curves import (
    PlotLine,
    accuracy_figure,
    figure_image,
    lines_figure,
    save_accuracy_curves,
)
from dopepp.drawing.overlay import BLUE, GREEN, MIN_WIDTH_PX, YELLOW, Wireframe, overlay
from dopepp.drawing.pictures import RGBImage
from dopepp.drawing.sheet import Tile, contact_sheet, grid, message_image
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.build_sources import held_out_source
from dopepp.experiment.config.data_config import evaluation_data, stored_config
from dopepp.experiment.results import display
from dopepp.experiment.results.compared_runs import (
    BASELINE,
    TABLE_FILE,
    Entry,
    Run,
    baseline_first,
    find_runs,
    group,
    with_refined,
)
from dopepp.experiment.results.differences import (
    compact_table,
    comparison_values,
    full_table,
    notes,
)
from dopepp.experiment.results.frame import header_of, markdown
from dopepp.experiment.results.pages import write_page
from dopepp.experiment.results.paper import PaperTable, write_paper_table
from dopepp.experiment.results.report import Report
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.network_estimator import NetworkEstimator
from dopepp.models.checkpoint import find
from dopepp.recovery.detection import Detection

TEXT_FILE: Final = "compare.md"
CURVES_FILE: Final = "compare_auc.png"
PANELS_FILE: Final = "compare.png"
LOSS_FILE: Final = "compare_loss.png"
IMAGES_FILE: Final = "compare_pictures.png"
LOG_FILE: Final = "metrics.csv"

NUM_SHOWN: Final = 3  # number of shown test images: the first, for an unbiased selection

# Columns of a log to draw: label, factor, and whether the axis is logarithmic.
_LOGGED: Final = {
    "train/loss": ("training loss", 1, True),
    "val/loss": ("validation loss", 1, True),
    "val/add_01d": ("validation ADD-0.1d (%)", 100, False),
}
# Columns that are omitted in the terminal.
_TOO_WIDE: Final = frozenset({
    "ADD<5cm %", "ADD<10cm %", "Δ rotation °", "rotation-S °", "parameters", "GMACs",
})  # fmt: skip


def compare_reports(reports: Sequence[Report], folder: Path) -> None:
    """Write the comparison of methods measured together; Δ refers to the first method."""
    write_comparison([Entry(report.name, [report], [None]) for report in reports], folder)


def write_comparison(entries: Sequence[Entry], folder: Path) -> dict[str, Any]:
    """Print and write the comparison table and accuracy curves; return ``compare.md``'s content."""
    values = comparison_values(entries)
    means = [report.mean for entry in entries for report in entry.reports]
    compact = compact_table(values, any(row.num_symmetries > 1 for row in means))
    sentences, rows = notes(entries, values), full_table(values)
    narrow_rows = [{key: row[key] for key in row if key not in _TOO_WIDE} for row in compact]
    display.show_table("comparison", narrow_rows, num_labels=2)
    for sentence in sentences:
        display.console.print(sentence)
    write_csv(folder / TABLE_FILE, rows, header_of(rows))
    page = {"table": markdown(compact), "notes": sentences}
    write_page(folder / TEXT_FILE, "compare", **page)
    if curves := accuracy_curves(entries):
        path = (folder / CURVES_FILE).with_suffix("")
        save_accuracy_curves(path, curves, title="ADD, all objects")
    return page


def accuracy_curves(entries: Sequence[Entry]) -> dict[str, np.ndarray]:
    """Return, by method, the ADD errors of all instances of all objects and seeds, metres."""
    return {
        entry.name: np.concatenate([e for report in entry.reports for e in report.errors.values()])
        for entry in entries
        if entry.reports
    }


def compare_paths(
    paths: Sequence[Path],
    out: Path | None = None,
    baseline: str | None = None,
    num_shown: int = NUM_SHOWN,
    table: Path | None = None,
) -> Path:
    """Compare run folders and return the folder with the comparison.

    The arguments are those of ``dopepp compare``.
    """
    layout = None if table is None else PaperTable.read(table)
    runs = find_runs(paths)
    if out is None:
        out = Path("outputs", "compare", datetime.now().strftime("%Y-%m-%d_%H-%M-%S-%f"))
    elif (out / TABLE_FILE).exists():
        raise UserError(
            f"{out}, which holds {TABLE_FILE}",
            "a folder without a comparison",
            "pass another folder with --out",
        )
    entries = compare_runs(runs, out, baseline, num_shown)
    if layout is not None:
        write_paper_table(layout, entries, out)
    return out


def compare_runs(
    runs: Sequence[Run], folder: Path, baseline: str | None = None, num_shown: int = NUM_SHOWN
) -> list[Entry]:
    """Compare runs, print and write the comparison, and return the methods.

    A method that was also measured with refinement counts as two methods. Test images and training
    curves show the networks without refinement. The table is written before all images.
    """
    networks = group(runs)
    names = [entry.name for entry in networks]
    if baseline is not None and baseline not in names:
        fix = "pass --baseline with one of these names"
        raise UserError(f"baseline {baseline!r}", ", ".join(names), fix)
    networks = baseline_first(networks, baseline or BASELINE)
    entries = with_refined(networks)
    page = write_comparison(entries, folder)
    panels = _panels(entries, folder)
    tiles, missing = image_tiles(networks, num_shown)
    if tiles:
        write_png(folder / IMAGES_FILE, contact_sheet(tiles, len(networks)))
        width = 2 * max([panel.shape[1] for panel in panels], default=768)
        # Fewer than three columns would make the tiles too large; the gap is 12 pixels.
        sheet = contact_sheet(tiles, len(networks), width // max(3, len(networks)) - 12)
        panels = [*([grid(panels, 2)] if panels else []), sheet]
    if panels:
        write_png(folder / PANELS_FILE, grid(panels, 1 if tiles else 2))
        page["image"] = PANELS_FILE
    if missing:
        display.console.print(missing)
    origins = [
        {
            "method": entry.name,
            "seed": "" if run.seed is None else str(run.seed),
            "overrides": " ".join(run.overrides),
            "folder": str(run.folder),
        }
        for entry in networks
        for run in entry.runs
    ]
    write_page(folder / TEXT_FILE, "compare", **page, missing=missing, origins=markdown(origins))
    return entries


def _panels(entries: Sequence[Entry], folder: Path) -> list[RGBImage]:
    """Draw the available loss, validation and accuracy curves, with one colour per method."""
    colours = {entry.name: f"C{number % 10}" for number, entry in enumerate(entries)}
    panels = []
    for column, (label, scale, log_y) in _LOGGED.items():
        lines = []
        for entry in (entry for entry in entries if not entry.refine):
            logs = [read_log_column(run.folder / LOG_FILE, column) for run in entry.runs]
            series = [log for log in logs if log]  # by step; a line has the steps of all seeds
            steps = sorted(set(series[0]).intersection(*series[1:])) if series else []
            if steps:
                values = scale * np.array([[log[step] for step in steps] for log in series])
                line = (np.array(steps, float), values, colours[entry.name])
                lines.append(PlotLine(entry.name, *line))
        if lines:
            panels.append(figure_image(lines_figure(lines, "step", label, log_y)))
    if panels:
        write_png(folder / LOSS_FILE, grid(panels, len(panels)))
    if curves := accuracy_curves(entries):
        figure = accuracy_figure(curves, title="ADD on test images", colours=colours)
        panels.append(figure_image(figure))
    return panels


def read_log_column(path: Path, column: str) -> dict[int, float]:
    """Return the finite numbers of a column of a log, by step."""
    numbers = {}
    for row in read_csv(path):
        with suppress(KeyError, TypeError, ValueError):
            numbers[int(row["step"])] = float(row[column])
    return {step: number for step, number in numbers.items() if math.isfinite(number)}


def image_tiles(entries: Sequence[Entry], num: int) -> tuple[list[Tile], str]:
    """Draw the predictions of all methods on the first ``num`` test images.

    The images are from the first method whose test set can be opened. The first seed of each method
    is shown. Networks of different parts have separate rows.

    Returns:
        Tiles row by row (one row per image, one tile per method), and why images are missing.
    """
    measured = [run for entry in entries for run in entry.runs if run.report]
    kinds = list(dict.fromkeys(map(_parts, measured)))[:num]
    tiles, notes = [], []
    for number, parts in enumerate(kinds):
        share = num // len(kinds) + (number < num % len(kinds))
        rows, note = _rows([_Model(entry, parts) for entry in entries], share)
        tiles += rows
        notes += [note] if note else []
    return tiles, " ".join(notes)


def _parts(run: Run) -> tuple[str, ...]:
    """Return the sorted names of the parts on which a run was measured; empty without a result."""
    return tuple(sorted(run.report.errors)) if run.report is not None else ()


class _Model:
    """The network of a method's first run on some parts, or the reason why it cannot be loaded."""

    def __init__(self, entry: Entry, parts: tuple[str, ...]) -> None:
        self.name, self.reason = entry.name, entry.failure
        self.estimator: NetworkEstimator | None = None
        self.run = next((run for run in entry.runs if _parts(run) == parts), entry.runs[0])
        path = self.run.checkpoint
        try:
            if find(path).exists():  # a file, a released network or the folder of an export
                self.estimator, self.reason = PoseEstimator.load(path), ""
            elif self.run.config.get("ckpt_path", path) is None:
                self.reason = entry.failure or "measured without a checkpoint"
            else:
                self.reason = entry.failure or f"no file {path}"
        except UserError as error:
            self.reason = str(error)

    def test_images(self, num: int) -> list[Sample]:
        """Return the first ``num`` images on which the run was measured."""
        assert self.estimator is not None
        stored, config = stored_config(self.estimator.checkpoint.data), self.run.config
        # Only the config of an evaluation contains changes to the data of the checkpoint.
        given = config if "ckpt_path" in config else {}
        path = str(self.run.checkpoint)
        data = evaluation_data(given.get("data"), given.get("virtual"), stored, path)
        if data.root is not None:
            data = replace(data, objects=tuple(part.name for part in self.estimator.parts))
        source = held_out_source(data, build_parts(data), "test")
        return [source.sample(index, 0) for index in range(min(num, len(source)))]

    def tile(self, sample: Sample, colour: tuple[int, int, int]) -> Tile:
        """Draw the predictions on an image, or the reason for their absence."""
        reason = self.reason
        poses: Sequence[Detection] = []
        if self.estimator is not None:
            try:
                poses = self.estimator.predict(
                    sample.image, sample.K, depth=sample.depth, cropped=True
                )
            except UserError as error:
                reason = str(error)
        if self.estimator is None or reason:
            width, height = sample.size
            factor = max(1, -(-MIN_WIDTH_PX // width))
            return Tile(message_image(width * factor, height * factor, reason), self.name)
        names = {part.name for part in self.estimator.parts}
        truths = [instance for instance in sample.instances if instance.label in names]
        wireframes = [Wireframe(truth.keypoints, GREEN, "true") for truth in truths]
        wireframes += [Wireframe(pose.keypoints, colour, "predicted") for pose in poses]
        missed = "" if poses else ": no detection"
        return Tile(overlay(sample.image, wireframes), f"{self.name}{missed} ({sample.key})")


def _rows(models: Sequence[_Model], num: int) -> tuple[list[Tile], str]:
    """Draw a tile per image and method; return the tiles, and the reason if there are none."""
    loaded = [model for model in models if model.estimator is not None]
    samples: list[Sample] = []
    reasons = [] if loaded else [f"{model.name}: {model.reason}" for model in models]
    for model in loaded:
        try:
            samples = model.test_images(num)
            break
        except UserError as error:
            reasons.append(f"{model.name}: {error}")
    if not samples:
        return [], f"Predictions cannot be displayed. {'; '.join(reasons)}"
    return [
        model.tile(sample, BLUE if model is loaded[0] and len(models) > 1 else YELLOW)
        for sample in samples
        for model in models
    ], ""
