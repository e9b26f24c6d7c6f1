"""The scale protocol (paper Fig. 11): pass rates as the camera is nearer or farther."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.data.sample import Source
from dopepp.drawing.sheet import Tile
from dopepp.experiment.reports.condition import MAX_EXAMPLES, Condition, Level
from dopepp.experiment.reports.evaluators import Method
from dopepp.experiment.reports.report import Measured, measure

SCALE: Final = Condition(
    name="scale",
    axis="how many times as large the parts appear",
    level="scale",
    form="×{:g}",
    introduction="""# Scale

Columns: how many times as large the parts appear as in the test set (paper Fig. 11). The scenes are
those of the test set; the camera moves along its ray to the parts and divides their distance by so
much. An instance counts by what is visible of it from there, at least 10 %.""",
    images="images from elsewhere",
    ratio=True,
)

_NOTABLE: Final = 0.05
"""A change of the mean visible fraction that is worth a line."""


def measure_scales(
    methods: Mapping[str, Method],
    sources: Mapping[float, Source],
    unmoved: Measured,
    num_examples: int = MAX_EXAMPLES,
) -> tuple[list[Level], list[Tile]]:
    """Measure every method at every scale.

    Args:
        methods: By name, the baseline first where there is one.
        sources: The test set at every scale but 1.
        unmoved: What was measured at 1.
        num_examples: How many images are shown.

    Returns:
        What was measured, by ascending scale, and the examples, image by image.
    """
    num_examples = min(num_examples, MAX_EXAMPLES)
    measured = {1.0: unmoved}
    for scale, source in sources.items():
        samples = (source.sample(index) for index in range(len(source)))
        measured[scale] = measure(methods, samples, num_examples)
    in_order = dict(sorted(measured.items()))
    levels = [_level(scale, one, unmoved) for scale, one in in_order.items()]
    pictures = zip(*(one.tiles[:num_examples] for one in in_order.values()), strict=True)
    tiles = [
        replace(tile, caption=f"{tile.caption}, {SCALE.heading(scale)}")
        for same_scene in pictures
        for scale, tile in zip(in_order, same_scene, strict=True)
    ]
    return levels, tiles


def _level(scale: float, measured: Measured, unmoved: Measured) -> Level:
    """Sum up, and say where the instances are not those of the test set or less is in sight."""
    rows = {report.name: report.rows for report in measured.reports}
    visible, usual = _visible_fractions(measured), _visible_fractions(unmoved)
    mean = float(visible.mean()) if len(visible) else None
    others = len(visible) != len(usual)
    note = (
        f"Instances that count at {SCALE.heading(scale)}: {_in_words(visible)}; "
        f"at {SCALE.heading(1)}: {_in_words(usual)}."
        if others or (mean is not None and abs(mean - usual.mean()) > _NOTABLE)
        else ""
    )
    return Level(scale, rows, {"visible_fraction": mean}, note)


def _in_words(visible_fractions: Float[np.ndarray, "n"]) -> str:
    number = len(visible_fractions)
    if not number:
        return "none"
    return f"{number}, of which {100 * visible_fractions.mean():.0f} % is in sight on average"


def _visible_fractions(measured: Measured) -> Float[np.ndarray, "n"]:
    """Return those of all instances that count; the last method scores all objects."""
    metrics = next(reversed(measured.metrics.values()))
    gathered = [metrics.instances(name).visible_fractions for name in metrics.parts]
    return np.concatenate([fractions.numpy() for fractions in gathered])
