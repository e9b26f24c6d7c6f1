"""Comparing methods: ``compare.csv``, ``compare.md`` and ``compare_auc.{png,csv}``.

Of run folders, ``compare.png`` also has what they logged while they trained (paper Fig. 12), and
the same test images through every model (paper Fig. 14).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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
from dopepp.drawing.pictures import Picture
from dopepp.drawing.sheet import Tile, contact_sheet, grid, message_picture
from dopepp.experiment.assembly.parts import build_parts
from dopepp.experiment.assembly.sources import held_out_source
from dopepp.experiment.config.data import chosen_data, trained_on
from dopepp.experiment.results import display
from dopepp.experiment.results.differences import compared, full, headline, notes
from dopepp.experiment.results.entries import (
    BASELINE,
    Entry,
    Run,
    find_runs,
    group,
    ordered,
    with_refined,
)
from dopepp.experiment.results.frame import Row, header_of, markdown
from dopepp.experiment.results.pages import write_page
from dopepp.experiment.results.paper import PaperTable, write_paper_table
from dopepp.experiment.results.report import Report
from dopepp.inference.estimator import PoseEstimator

TABLE_FILE: Final = "compare.csv"
TEXT_FILE: Final = "compare.md"
CURVES_FILE: Final = "compare_auc.png"
PANELS_FILE: Final = "compare.png"
LOSS_FILE: Final = "compare_loss.png"
PICTURES_FILE: Final = "compare_pictures.png"
LOG_FILE: Final = "metrics.csv"

NUM_PICTURES: Final = 3
"""Test images, the first ones: nobody has chosen them."""

_MIN_COLUMNS: Final = 3
"""Tiles of fewer methods than this would be larger than anybody needs."""
_PANEL_PX: Final = 768
"""Width of a panel, where there is none to take it from."""
_GAP_PX: Final = 12
"""Room between tiles."""
_TOO_WIDE: Final = ("Δ rotation °", "rotation-S °", "parameters", "GMACs")
"""What a terminal has no room for."""


def compare_reports(reports: Sequence[Report], folder: Path, baseline: str) -> None:
    """Compare methods that were measured together; the baseline is the one of this name."""
    entries = [Entry(report.name, [report], [None]) for report in reports]
    write_comparison(ordered(entries, baseline), folder)


def write_comparison(entries: Sequence[Entry], folder: Path) -> dict[str, Any]:
    """Print and write table and AUC curves; return the content of ``compare.md``."""
    table = compared(entries)
    means = [report.mean for entry in entries for report in entry.reports]
    symmetric = any(row.num_symmetries > 1 for row in means)
    compact, said = headline(table, symmetric), notes(entries, table)
    display.show_table(
        "comparison",
        [{key: text for key, text in row.items() if key not in _TOO_WIDE} for row in compact],
        num_labels=2,
    )
    for note in said:
        display.console.print(note)
    rows = full(table)
    write_csv(folder / TABLE_FILE, rows, header_of(rows))
    page = {"table": markdown(compact), "notes": said, "picture": "", "missing": "", "origins": ""}
    write_page(folder / TEXT_FILE, "compare", **page)
    curves = accuracy_curves(entries)
    if curves:
        save_accuracy_curves(
            (folder / CURVES_FILE).with_suffix(""), curves, title="ADD, all objects"
        )
    return page


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

    A method measured refined as well is two, its network and behind it the same refined; pictures
    and curves of training are the networks'. The table is written first, so that it is there
    whatever befalls curves and pictures. A :class:`UserError`: the baseline is none of the methods.
    """
    entries = group(runs)
    names = [entry.name for entry in entries]
    if baseline is not None and baseline not in names:
        raise UserError(f"baseline {baseline!r}", ", ".join(names), "choose one of them")
    networks = ordered(entries, baseline or BASELINE)
    entries = with_refined(networks)
    page = write_comparison(entries, folder)
    panels = _panels(entries, folder)
    shown = num_pictures if any(entry.reports for entry in networks) else 0
    tiles, note = picture_tiles(networks, shown) if shown else ([], "")
    if tiles:
        write_png(folder / PICTURES_FILE, contact_sheet(tiles, len(networks)))
        width = 2 * max([one.shape[1] for one in panels], default=_PANEL_PX)
        columns = max(_MIN_COLUMNS, len(networks))
        panels = [*([grid(panels, 2)] if panels else []),
                  contact_sheet(tiles, len(networks), width // columns - _GAP_PX)]  # fmt: skip
    if panels:
        write_png(folder / PANELS_FILE, grid(panels, 1 if tiles else 2))
        page["picture"] = PANELS_FILE
    if note:
        display.console.print(note)
    page |= {"missing": note, "origins": markdown(_origins(networks))}
    write_page(folder / TEXT_FILE, "compare", **page)
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


def training_lines(
    entries: Sequence[Entry], column: str, colours: Mapping[str, str], scale: float = 1.0
) -> list[PlotLine]:
    """Return a line per method for a column of ``metrics.csv``, such as ``train/loss``.

    Runs that did not finish have one, too; several seeds are drawn at the steps that all of them
    have logged. Colours go by method; ``scale`` is a factor of the values.
    """
    lines = []
    for entry in (one for one in entries if not one.refine):
        series = [one for run in entry.runs if (one := logged(run.folder / LOG_FILE, column))]
        steps = sorted(set(series[0]).intersection(*series[1:])) if series else []
        if steps:
            values = scale * np.array([[one[step] for step in steps] for one in series])
            lines.append(PlotLine(entry.name, np.array(steps, float), values, colours[entry.name]))
    return lines


def logged(path: Path, column: str) -> dict[int, float]:
    """Return what a log holds in a column, by step; empty where there is no such file or column."""
    cells = ((_number(row.get("step")), _number(row.get(column))) for row in read_csv(path))
    return {int(step): value for step, value in cells if step is not None and value is not None}


def _number(text: object) -> float | None:
    """Return a finite number, None for anything else that a log may hold."""
    try:
        number = float(str(text))
    except ValueError:
        return None
    return number if math.isfinite(number) else None


@dataclass
class _Model:
    """A method's network, of its first run; or why there is none."""

    name: str
    run: Run | None = None
    estimator: PoseEstimator | None = None
    reason: str = ""


def picture_tiles(entries: Sequence[Entry], num: int = NUM_PICTURES) -> tuple[list[Tile], str]:
    """Predict on the first test images of the first method whose images can be opened.

    Of several seeds the first run is shown, of several networks, one a part, one after the other.
    Returns row by row the tiles of an image, one per method; and why some are missing.
    """
    measured = [run for entry in entries for run in entry.runs if run.report]
    kinds = list(dict.fromkeys(map(_parts, measured)))
    tiles, notes = [], []
    for number, parts in enumerate(kinds or [()]):
        share = num // max(1, len(kinds)) + (number < num % max(1, len(kinds)))
        rows, note = _rows([_load(entry, parts) for entry in entries], share)
        tiles += rows
        notes += [note] if note else []
    return tiles, " ".join(notes)


def _parts(run: Run) -> tuple[str, ...]:
    """Return the names of the parts that a run was measured on."""
    return tuple(sorted(run.report.errors)) if run.report is not None else ()


def _rows(models: Sequence[_Model], num: int) -> tuple[list[Tile], str]:
    """Return the tiles of some images, one per method; and why there are none."""
    samples, reasons = [], []
    for model in models:
        if model.run is None or model.estimator is None:
            continue
        try:
            samples = _test_images(model.run, model.estimator, num)
            break
        except UserError as error:
            reasons.append(f"{model.name}: {error}")
    if not samples:
        why = "; ".join(reasons or [f"{one.name}: {one.reason}" for one in models])
        return [], f"No pictures of the same test images. {why}" if num else ""
    first = next(model for model in models if model.estimator is not None)
    return [_tile(model, sample, BLUE if model is first and len(models) > 1 else YELLOW)
            for sample in samples for model in models], ""  # fmt: skip


def _load(entry: Entry, parts: tuple[str, ...]) -> _Model:
    """Load a method's checkpoint of some parts, or say why that cannot be."""
    if not entry.runs:
        return _Model(entry.name, reason="there is no checkpoint of it")
    run = next((one for one in entry.runs if _parts(one) == parts), entry.runs[0])
    if run.checkpoint is None or not run.checkpoint.is_file():
        return _Model(entry.name, run, reason=entry.failure or f"no file {run.checkpoint}")
    try:
        estimator = PoseEstimator.load(run.checkpoint)
    except UserError as error:
        return _Model(entry.name, run, reason=str(error))
    return _Model(entry.name, run, estimator)


def _test_images(run: Run, estimator: PoseEstimator, num: int) -> list[Sample]:
    """Open the images that a run was measured on."""
    stored = trained_on(estimator.checkpoint.data)
    # A training's config holds what its checkpoint stores; an evaluation's, what it changed.
    given = run.config if "ckpt_path" in run.config else {}
    data = chosen_data(given.get("data"), given.get("virtual"), stored, str(run.checkpoint))
    if data.root is not None:
        data = replace(data, objects=tuple(part.name for part in estimator.parts))
    source = held_out_source(data, build_parts(data), "test")
    return [source.sample(index, 0) for index in range(min(num, len(source)))]


def _tile(model: _Model, sample: Sample, colour: tuple[int, int, int]) -> Tile:
    """Draw one method's answer to one image."""
    width, height = sample.size
    factor = max(1, -(-MIN_WIDTH_PX // width))
    if model.estimator is None:
        return Tile(message_picture(width * factor, height * factor, model.reason), model.name)
    try:
        found = model.estimator.predict(sample.image, sample.K, depth=sample.depth, cropped=True)
    except UserError as error:
        return Tile(message_picture(width * factor, height * factor, str(error)), model.name)
    known = {part.name for part in model.estimator.parts}
    truths = [one for one in sample.instances if one.label in known]
    wireframes = [Wireframe(one.keypoints, GREEN, "true") for one in truths]
    wireframes += [Wireframe(one.keypoints, colour, "predicted") for one in found]
    missed = "" if found else ": finds nothing"
    return Tile(overlay(sample.image, wireframes), f"{model.name}{missed} ({sample.key})")
