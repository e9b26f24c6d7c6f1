"""Measure methods under conditions that make the test set harder or easier: shading and scale.

Shading (paper Table 3) covers an increasing share of every object. Scale (paper Fig. 11) moves the
camera nearer or farther. To add a condition, describe it as a :class:`Condition` and write a
function that measures a list of :class:`Level`; :func:`record_condition` writes the result.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.core.files import write_csv, write_file, write_png
from dopepp.data.sample import Sample, SampleSource
from dopepp.data.transforms.shading_protocol import TOLERANCE, ShadedSample, shade
from dopepp.drawing.curves import figure_image, rates_figure
from dopepp.drawing.sheet import Tile, contact_sheet
from dopepp.experiment.results import display
from dopepp.experiment.results.frame import (
    PassRate,
    Row,
    Value,
    heading,
    markdown,
    pivot,
    rate_curves,
    row_values,
    shown_rows,
)
from dopepp.experiment.results.measurement import (
    Measured,
    Method,
    accumulators,
    image_id,
    measure,
    reported_candidates,
)
from dopepp.experiment.results.report import Report
from dopepp.metrics.pose import MEAN, MIN_VISIBLE_FRACTION, PoseMetrics
from dopepp.metrics.row import PoseRow

_log = logging.getLogger(__name__)

MAX_EXAMPLES: Final = 4  # images on the sheet of examples; each appears once per level

# Measures to report in addition to the pass rates.
_FIELDS: Final = (
    "auc_10cm", "median_rotation_deg", "miss_rate", "precision", "false_per_frame",
    "average_precision", "coverage",
)  # fmt: skip
_LABELS: Final = ("method", "object")
_MARGIN: Final = 0.3  # around shaded objects on the sheet of examples, share of their extent


@dataclass(frozen=True)
class Condition:
    """A quantity that changes from level to level, and how to display its levels."""

    name: str  # of the option and of the files
    axis: str  # quantity with its unit, for axes and titles
    level: str  # column of the levels in the CSV file
    form: str  # format of a level in the unit of the axis
    introduction: str  # beginning of the page
    per_unit: float = 1.0  # converts a level to the unit of the axis
    ratio: bool = False  # levels are ratios, which need a logarithmic axis

    def heading(self, level: float) -> str:
        """Return the column heading of a level, such as ``40 %``."""
        return self.form.format(self.per_unit * level)


SHADING: Final = Condition(
    name="shading",
    axis="share of the visible area covered (%)",
    level="share",
    form="{:g} %",
    introduction="""# Shading

Columns: the share of every object's visible pixels that is covered by patches of the image's
background (paper Table 3). Instances are selected before the shading.""",
    per_unit=100,
)

SCALE: Final = Condition(
    name="scale",
    axis="apparent size of the parts, relative to the test set",
    level="scale",
    form="×{:g}",
    introduction="""# Scale

Columns: the apparent size of the parts relative to the test set (paper Fig. 11). The camera moves
along its ray to the parts and divides their distance by this factor; the scenes are unchanged.
Instances with at least 10 % visible from the moved camera are evaluated.""",
    ratio=True,
)


@dataclass(frozen=True)
class Level:
    """Measurement at one level of a condition, such as 40 % shading."""

    value: float  # covered share or scale
    rows: Mapping[str, Mapping[str, PoseRow]]  # by method and object, with the mean
    facts: Mapping[str, float] = field(default_factory=dict)  # further columns of the CSV file
    note: str = ""  # for the reader


def record_condition(
    run_dir: Path,
    condition: Condition,
    levels: Sequence[Level],
    tiles: Sequence[Tile],
    rates: Sequence[PassRate],
) -> None:
    """Print the table and write ``NAME.csv``, ``.md``, ``.png`` and ``NAME_examples.png``.

    Levels are in ascending order; ``tiles`` show examples, image by image, each at all levels.
    """
    rows = [row for rows in levels[0].rows.values() for row in rows.values()]
    extra = ["median_rotation_s_deg"] if any(row.num_symmetries > 1 for row in rows) else []
    fields = [*(rate.field for rate in rates), *_FIELDS, *extra]
    values = list(_values(levels, fields, rates))

    def cells(value: Value) -> Row:
        return {**value.names, condition.heading(value.condition): value.text}

    def csv_cells(value: Value) -> dict[str, object]:
        return {**value.names, condition.level: value.condition, value.measure: value.plain}

    tables = {
        heading(field): pivot([v for v in values if v.measure == field], _LABELS, cells)
        for field in fields
    }
    printed = [{"measure": title, **row} for title, table in tables.items() for row in table]
    display.show_table(f"{condition.name}: {condition.axis}", printed, num_labels=3)
    notes = [level.note for level in levels if level.note]
    for line in notes:
        _log.warning("%s", line)
    path = run_dir / f"{condition.name}.md"
    write_csv(path.with_suffix(".csv"), pivot(values, (*_LABELS, "condition"), csv_cells))
    sections = [f"## {title}\n\n{markdown(table)}" for title, table in tables.items()]
    text = "\n".join([f"{condition.introduction}\n", *(f"{line}\n" for line in notes), *sections])
    write_file(path, text.encode())
    panels = {}  # one panel per object and rate, with one curve per method
    for name in dict.fromkeys(value.object for value in values if value.object != MEAN):
        for rate in rates:
            shown = [v for v in values if (v.object, v.measure) == (name, rate.field)]
            curves = rate_curves(shown, condition.per_unit)
            drawn = {method: curve for method, curve in curves.items() if len(curve.x)}
            panels[f"{name}: {rate.title}"] = drawn
    figure = rates_figure(panels, condition.axis, len(rates), ratio=condition.ratio)
    write_png(path.with_suffix(".png"), figure_image(figure))
    if tiles:
        sheet = contact_sheet(tiles, columns=len(levels))
        write_png(run_dir / f"{condition.name}_examples.png", sheet)


def _values(
    levels: Sequence[Level], fields: Sequence[str], rates: Sequence[PassRate]
) -> Iterator[Value]:
    """Yield ``Level.facts``, counts and ``fields``, ordered by method, object and level."""
    rated = [rate.field for rate in rates]
    for method, rows in levels[0].rows.items():
        for name in shown_rows(rows):
            for level in levels:
                for fact, number in level.facts.items():
                    yield Value(method, name, fact, number, condition=level.value)
                row = level.rows[method][name]
                yield from row_values(row, ["num_instances", *fields], rated, level.value)


def check_masks(source: SampleSource) -> None:
    """Check, before anything is measured, that some image has an instance mask."""
    samples = (source.sample(index) for index in range(len(source)))
    masks = (instance.mask for sample in samples for instance in sample.instances)
    if not any(mask is not None and mask.any() for mask in masks):
        raise UserError(
            f"shading on {source.name}, {len(source):,} images without an instance mask",
            "images with masks: renders, label images of YCB-Video, mask_visib of BOP",
            "evaluate on images with masks, or leave out shading",
        )


def measure_shading(
    methods: Mapping[str, Method],
    source: SampleSource,
    shares: Sequence[float],
    seed: int,
    unmasked: Sequence[Report],
    num_examples: int = MAX_EXAMPLES,
) -> tuple[list[Level], list[Tile]]:
    """Measure every method with ``shares`` of the visible area of every instance covered.

    Instances are selected by the visible fraction before the shading, because heavily shaded
    instances would otherwise be excluded. ``unmasked`` are the reports without
    shading, of these methods and perhaps others.

    Returns:
        The levels, beginning with 0, and the examples, image by image.
    """
    metrics = {share: accumulators(methods) for share in shares}
    reached: dict[float, list[float]] = {share: [] for share in shares}
    tiles: list[Tile] = []
    for index in range(len(source)):
        sample = source.sample(index)
        counts = [truth.visible_fraction >= MIN_VISIBLE_FRACTION for truth in sample.instances]
        shaded = shade(sample, shares, seed, index)
        for variant in shaded:
            shares_reached = [np.nan if share is None else share for share in variant.reached]
            reached[variant.share] += compress(shares_reached, counts)
            for name, method in methods.items():
                candidates, _ = method.detect(variant.sample, image_id(sample, index))
                accumulator = metrics[variant.share][name]
                poses = reported_candidates(method, candidates)
                accumulator.update(poses, sample.instances, sample.K, sample.size[0])
        num_shown = len(tiles) // (len(shares) + 1)
        if num_shown < min(num_examples, MAX_EXAMPLES) and any(counts):
            tiles += _examples(sample, shaded)
    rows = {report.name: report.rows for report in unmasked if report.name in methods}
    unshaded = Level(0.0, rows, {"share_reached": 0.0, "num_outside_tolerance": 0})
    return [unshaded, *(_shaded(share, metrics[share], reached[share]) for share in shares)], tiles


def _shaded(share: float, metrics: Mapping[str, PoseMetrics], reached: Sequence[float]) -> Level:
    """Summarise a covered share, with a note if instances miss it by more than the tolerance."""
    # The negated comparison also counts unknown shares (NaN).
    num_outside = sum(not abs(covered - share) <= TOLERANCE for covered in reached)
    finite = [covered for covered in reached if np.isfinite(covered)]
    mean = float(np.mean(finite)) if finite else math.nan
    note = (
        f"At {SHADING.heading(share)}, the covered share of {num_outside} of {len(reached)} "
        f"instances is off by over {100 * TOLERANCE:g} points: no mask, or too little background."
    )
    rows = {name: accumulator.compute() for name, accumulator in metrics.items()}
    facts = {"share_reached": mean, "num_outside_tolerance": num_outside}
    return Level(share, rows, facts, note if num_outside else "")


def _examples(sample: Sample, shaded: Sequence[ShadedSample]) -> list[Tile]:
    """Return tiles of an image's objects: without shading, and at every share."""
    window = _around_masks(sample)
    tiles = [Tile(sample.image[window], f"{sample.key}: unmasked")]
    for variant in shaded:
        reached = sorted(share for share in variant.reached if share is not None)
        ends = [f"{100 * share:.1f}" for share in (*reached[:1], *reached[-1:])]
        covered = " … ".join(dict.fromkeys(ends)) or "nothing"
        caption = f"{SHADING.heading(variant.share)} (reached {covered})"
        tiles.append(Tile(variant.sample.image[window], caption))
    return tiles


def _around_masks(sample: Sample) -> tuple[slice, slice]:
    """Return row and column slices around all masks of an image, with a margin."""
    masks = [instance.mask for instance in sample.instances if instance.mask is not None]
    shown = np.any(masks, axis=0) if masks else np.ones(sample.image.shape[:2], bool)
    left, top, width, height = cv2.boundingRect(np.uint8(shown if shown.any() else ~shown))

    def widened(first: int, size: int) -> slice:
        margin = round(_MARGIN * size)
        return slice(max(0, first - margin), first + size + margin)

    return widened(top, height), widened(left, width)


def measure_scales(
    methods: Mapping[str, Method],
    sources: Mapping[float, SampleSource],
    unmoved: Measured,
    num_examples: int = MAX_EXAMPLES,
) -> tuple[list[Level], list[Tile]]:
    """Measure every method at every scale, a factor on the apparent size of the parts.

    ``sources`` are the test sets by scale, except scale 1, whose measurement is ``unmoved``.

    Returns:
        The levels by ascending scale, and the examples, image by image.
    """
    num_examples = min(num_examples, MAX_EXAMPLES)
    measured = {1.0: unmoved}
    for scale, source in sources.items():
        samples = (source.sample(index) for index in range(len(source)))
        measured[scale] = measure(methods, samples, num_examples)
    in_order = dict(sorted(measured.items()))
    levels = [_scale_level(scale, level, unmoved) for scale, level in in_order.items()]
    scenes = zip(*(level.tiles[:num_examples] for level in in_order.values()), strict=True)
    tiles = [
        replace(tile, caption=f"{tile.caption}, {SCALE.heading(scale)}")
        for scene in scenes
        for scale, tile in zip(in_order, scene, strict=True)
    ]
    return levels, tiles


def _scale_level(scale: float, measured: Measured, unmoved: Measured) -> Level:
    """Summarise a scale, with a note if number or visibility of instances differ from scale 1."""
    rows = {report.name: report.rows for report in measured.reports}
    visible, reference = _visible_fractions(measured), _visible_fractions(unmoved)
    mean = float(visible.mean()) if len(visible) else math.nan
    note = (
        f"Evaluated instances at {SCALE.heading(scale)}: {_in_words(visible)}; "
        f"at {SCALE.heading(1)}: {_in_words(reference)}."
        if len(visible) != len(reference) or abs(mean - reference.mean()) > 0.05
        else ""
    )
    return Level(scale, rows, {"visible_fraction": mean}, note)


def _in_words(fractions: Float[np.ndarray, "n"]) -> str:
    share = f", {100 * fractions.mean():.0f} % visible on average"
    return f"{len(fractions)}{share}" if len(fractions) else "none"


def _visible_fractions(measured: Measured) -> Float[np.ndarray, "n"]:
    """Return each instance's visible fraction, from the last method, which has all objects."""
    metrics = next(reversed(measured.metrics.values()))
    return np.concatenate([metrics.instances(part).visible_fractions for part in metrics.parts])
