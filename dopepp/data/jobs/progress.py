"""The first images of a job on one sheet, to look at before rendering thousands.

How far a render job is: a bar in a terminal, a line now and then in a log.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Iterator
from types import TracebackType
from typing import Final

import numpy as np
from jaxtyping import Float, UInt8
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from dopepp.data.sample import Instance, Sample
from dopepp.data.sources.rendered import rendered_sample
from dopepp.drawing.overlay import Wireframe, overlay
from dopepp.drawing.panels import COLOURS, depth_panel, draw_axes, mask_panel
from dopepp.drawing.sheet import Tile, contact_sheet
from dopepp.geometry.camera import project, resize_points, transform
from dopepp.virtual.factory import Factory
from dopepp.virtual.scene import Rendered

_log = logging.getLogger(__name__)

_LINE_EVERY_S: Final = 30.0


class ProgressDisplay:
    """Shows counts of images while it is entered.

    It is called as a :data:`~dopepp.data.jobs.render_dataset.Progress`.

    Args:
        console: Where the bar goes; without a terminal, lines go to the log instead.
    """

    def __init__(self, console: Console) -> None:
        self._bar: Progress | None = None
        if console.is_terminal:
            self._bar = Progress(
                TextColumn("rendering"),
                BarColumn(),
                MofNCompleteColumn(),
                RateColumn(),
                TimeElapsedColumn(),
                TextColumn("left"),
                TimeRemainingColumn(),
                console=console,
            )
        self._task: TaskID | None = None
        self._first, self._start, self._last = 0, 0.0, 0.0

    def __enter__(self) -> ProgressDisplay:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` images are there."""
        if self._start == 0.0:
            # What an earlier run made is no part of this one's rate.
            self._first, self._start = done, time.monotonic()
            self._last = self._start
            if self._bar is not None:
                self._task = self._bar.add_task("", completed=done, total=total)
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done)
        else:
            self._log_line(done, total)

    def _log_line(self, done: int, total: int) -> None:
        now = time.monotonic()
        if now - self._last < _LINE_EVERY_S or done == self._first:
            return
        self._last = now
        rate = (done - self._first) / (now - self._start)
        left = (total - done) / rate / 60
        _log.info("%s of %s images, %.1f/s, %.0f min left", f"{done:,}", f"{total:,}", rate, left)


class RateColumn(ProgressColumn):
    """Images per second, of the last half minute."""

    def render(self, task: Task) -> Text:
        """Return the rate, or nothing while it is unknown."""
        speed = task.finished_speed or task.speed
        return Text(f"{speed:.1f}/s" if speed else "", style="progress.data.speed")


NUM_SCENES: Final = 8

_PANELS: Final = 4
_LISTED: Final = 4
"""Visible fractions in a caption, at most."""

_AXIS_LENGTH: Final = 0.5
"""Of the part's diameter."""


def preview_sheet(
    factory: Factory, num_scenes: int = NUM_SCENES
) -> UInt8[np.ndarray, "height width 3"]:
    """Render a job's first images and draw, in a row each, the image and its labels.

    Raises:
        UserError: The preset cannot show the part.
    """
    tiles: list[Tile] = []
    for index in range(num_scenes):
        tiles += scene_tiles(factory.render(0, index), f"image {index}")
    return contact_sheet(tiles, columns=_PANELS)


def scene_tiles(rendered: Rendered, name: str) -> Iterator[Tile]:
    """Yield an image, its cuboids and axes, its masks and its depth."""
    sample = rendered_sample(rendered, "virtual", name)
    width, height = sample.size
    scene = rendered.scene
    lights = f"{len(scene.lights)} lights" if len(scene.lights) != 1 else "1 light"
    others = len(scene.objects) - len(scene.targets)
    plane = ", on a plane" if scene.plane is not None else ""
    yield Tile(rendered.image, f"{name}: {width}×{height}, {lights}{plane}")
    counts = Counter(instance.label for instance in sample.instances)
    names = [label if count == 1 else f"{count} {label}" for label, count in counts.items()]
    yield Tile(_posed(rendered, sample), ", ".join(names) or "no target")
    masks = [instance.mask for instance in sample.instances]
    seen = _seen([round(100 * instance.visible_fraction) for instance in sample.instances])
    yield Tile(mask_panel(rendered.image, masks), f"{seen}; distractors: {others}")
    yield Tile(*depth_panel(rendered.depth, rendered.instances >= 0))


def _seen(percents: list[int]) -> str:
    """Say how much of each target is visible; of many, the least and the most."""
    if not percents:
        return "nothing to find"
    if len(percents) > _LISTED:
        return f"visible: {min(percents)} to {max(percents)} % of {len(percents)} targets"
    return f"visible: {', '.join(f'{percent} %' for percent in percents)}"


def _posed(rendered: Rendered, sample: Sample) -> UInt8[np.ndarray, "height width 3"]:
    """Draw cuboids in the masks' colours, and the object frames' axes."""
    frames = [
        Wireframe(instance.keypoints, COLOURS[number % len(COLOURS)])
        for number, instance in enumerate(sample.instances)
    ]
    drawn = overlay(sample.image, frames)
    factor = drawn.shape[1] / sample.size[0]
    objects = rendered.scene.objects
    for instance, number in zip(sample.instances, rendered.scene.targets, strict=True):
        part = objects[number].part
        assert part is not None
        ends = _axes(instance, sample.K, _AXIS_LENGTH * part.diameter)
        draw_axes(drawn, resize_points(ends, factor, factor))
    return drawn


def _axes(
    instance: Instance, K: Float[np.ndarray, "3 3"], length: float
) -> Float[np.ndarray, "4 2"]:
    """Return where the object's origin and the ends of its axes (metres long) are seen."""
    points = transform(instance.T_cam_obj, np.vstack([np.zeros(3), length * np.eye(3)]))
    return np.asarray(project(points, K))
