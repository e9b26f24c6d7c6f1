"""Preview the first scenes of a render job on a contact sheet before rendering thousands."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from dopepp.core.files import check_target, write_png
from dopepp.data.render_job import RenderJob
from dopepp.data.rendered import rendered_sample
from dopepp.data.sample import Sample
from dopepp.drawing.overlay import Wireframe, overlay
from dopepp.drawing.pictures import RGBImage
from dopepp.drawing.sheet import (
    COLOURS,
    Tile,
    contact_sheet,
    depth_panel,
    draw_axes,
    mask_panel,
    text_line,
)
from dopepp.geometry.camera import project, resize_points, transform
from dopepp.parts.size import part_in_words
from dopepp.virtual.factory import Factory
from dopepp.virtual.scene import Rendered

NUM_SCENES: Final = 8
_PANELS: Final = 4
_MAX_LISTED: Final = 4  # visible fractions in a caption
_AXIS_LENGTH: Final = 0.5  # length of a drawn axis, diameters


def write_preview(job: RenderJob, out: Path) -> Path:
    """Write a contact sheet of the job's first scenes (:func:`preview_sheet`); return its path.

    ``out`` is a PNG file, or the data set's folder; the sheet is then ``FOLDER.preview.png``.

    Raises:
        UserError: The sheet cannot be written.
    """
    out = out.resolve()
    path = out if out.suffix.lower() == ".png" else out.parent / f"{out.name}.preview.png"
    check_target(path)
    write_png(path, preview_sheet(job.factory))
    return path


def preview_sheet(factory: Factory, num_scenes: int = NUM_SCENES) -> RGBImage:
    """Return a sheet with a row of :func:`scene_tiles` per scene, below a text line per part."""
    tiles: list[Tile] = []
    for index in range(num_scenes):
        tiles += scene_tiles(factory.render(0, index), f"image {index}")
    sheet = contact_sheet(tiles, columns=_PANELS)
    lines = [text_line(part_in_words(part), sheet.shape[1]) for part in factory.parts]
    return np.concatenate([*lines, sheet])


def scene_tiles(rendered: Rendered, name: str) -> Iterator[Tile]:
    """Yield four captioned tiles: the image, overlays of cuboids and masks, and the depth."""
    sample = rendered_sample(rendered, "virtual", name)
    width, height = sample.size
    scene = rendered.scene
    lights = f"{len(scene.lights)} lights" if len(scene.lights) != 1 else "1 light"
    others = len(scene.objects) - len(scene.targets)
    plane = ", on a plane" if scene.plane is not None else ""
    yield Tile(rendered.image, f"{name}: {width}×{height}, {lights}{plane}")
    counts = Counter(instance.label for instance in sample.instances)
    names = [label if count == 1 else f"{count} {label}" for label, count in counts.items()]
    yield Tile(_draw_poses(rendered, sample), ", ".join(names) or "no target")
    masks = [instance.mask for instance in sample.instances]
    percents = [round(100 * instance.visible_fraction) for instance in sample.instances]
    visible = f"visible: {', '.join(f'{percent} %' for percent in percents)}"
    if len(percents) > _MAX_LISTED:
        visible = f"visible: {min(percents)} to {max(percents)} % of {len(percents)} targets"
    elif not percents:
        visible = "no instance"
    yield Tile(mask_panel(rendered.image, masks), f"{visible}; distractors: {others}")
    yield Tile(*depth_panel(rendered.depth, rendered.instances >= 0))


def _draw_poses(rendered: Rendered, sample: Sample) -> RGBImage:
    """Return the image with cuboids in the masks' colours and the axes of the object frames."""
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
        # The object's origin and the ends of its axes.
        points = _AXIS_LENGTH * part.diameter * np.vstack([np.zeros(3), np.eye(3)])
        ends = project(transform(instance.T_cam_obj, points), sample.K)
        draw_axes(drawn, resize_points(ends, factor, factor))
    return drawn
