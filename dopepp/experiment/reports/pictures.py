"""What a comparison of runs shows beside its table: test images and curves of training.

The same test images go through every model (paper Fig. 14); what the runs logged while they trained
becomes lines in one figure (paper Fig. 12).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.data.sample import Sample
from dopepp.drawing.overlay import BLUE, GREEN, MIN_WIDTH_PX, YELLOW, Wireframe, overlay
from dopepp.drawing.panels import PlotLine, message_picture
from dopepp.drawing.sheet import Tile
from dopepp.experiment.build.sources import build_parts, build_test_source
from dopepp.experiment.config.data import chosen_data, trained_on
from dopepp.experiment.reports.entries import Entry, Run
from dopepp.experiment.reports.tables import read_csv
from dopepp.inference.estimator import PoseEstimator

LOG_FILE: Final = "metrics.csv"

Series = dict[int, float]
"""Step to value."""


def training_lines(
    entries: Sequence[Entry], column: str, colours: Mapping[str, str], scale: float = 1.0
) -> list[PlotLine]:
    """Return a line per method for a column of ``metrics.csv``, such as ``train/loss``.

    Runs that did not finish have one, too; several seeds are drawn at the steps that all of them
    have logged. Colours go by method; ``scale`` is a factor of the values.
    """
    lines = []
    for entry in entries:
        series = [one for run in entry.runs if (one := logged(run.folder / LOG_FILE, column))]
        steps = sorted(set(series[0]).intersection(*series[1:])) if series else []
        if steps:
            values = scale * np.array([[one[step] for step in steps] for one in series])
            lines.append(PlotLine(entry.name, np.array(steps, float), values, colours[entry.name]))
    return lines


def logged(path: Path, column: str) -> Series:
    """Return what a log holds in a column; empty where there is no such file or column."""
    cells = ((_number(row.get("step")), _number(row.get(column))) for row in read_csv(path))
    return {int(step): value for step, value in cells if step is not None and value is not None}


def _number(text: object) -> float | None:
    """Return a finite number, None for anything else that a log may hold."""
    try:
        number = float(str(text))
    except ValueError:
        return None
    return number if math.isfinite(number) else None


NUM_PICTURES: Final = 3
"""Test images, the first ones: nobody has chosen them."""


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
        estimator = PoseEstimator.load(run.checkpoint, refine=run.config.get("refine"))
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
    source = build_test_source(data, build_parts(data))
    return [source.sample(index, 0) for index in range(min(num, len(source)))]


def _tile(model: _Model, sample: Sample, colour: tuple[int, int, int]) -> Tile:
    """Draw one method's answer to one image."""
    width, height = sample.size
    factor = max(1, -(-MIN_WIDTH_PX // width))
    if model.estimator is None:
        return Tile(message_picture(width * factor, height * factor, model.reason), model.name)
    try:
        found = model.estimator.predict(sample.image, sample.K, depth=sample.depth)
    except UserError as error:
        return Tile(message_picture(width * factor, height * factor, str(error)), model.name)
    known = {part.name for part in model.estimator.parts}
    truths = [one for one in sample.instances if one.label in known]
    wireframes = [Wireframe(one.keypoints, GREEN, "true") for one in truths]
    wireframes += [Wireframe(one.keypoints, colour, "predicted") for one in found]
    missed = "" if found else ": finds nothing"
    return Tile(overlay(sample.image, wireframes), f"{model.name}{missed} ({sample.key})")
