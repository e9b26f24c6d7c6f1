"""Panels of a sheet: lines of several methods, an image's masks, depth and axes, a message."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from dopepp.drawing.curves import figure_with_axes
from dopepp.drawing.overlay import Colour, draw_line, draw_text
from dopepp.drawing.pictures import DepthMap, Mask, Picture

_SMOOTHING: Final = 50
"""A line of more points than this is drawn as a moving average over 1/50 of them, above its own
pale self."""

_WHITE: Final = 255
_GREY: Final = 225
_TEXT_SHARE: Final = 0.05
"""Height of a line of a message, as a share of the picture's width."""

_CHARACTER_SHARE: Final = 0.52
"""Mean width of a character, as a share of the line's height."""

COLOURS: Final[tuple[Colour, ...]] = (
    (230, 25, 75), (60, 180, 75), (255, 225, 25), (0, 130, 200), (245, 130, 48),
    (145, 30, 180), (70, 240, 240), (240, 50, 230), (210, 245, 60), (250, 190, 212),
)  # fmt: skip
"""Of the first, second, … instance; easy to tell apart, also with most colour blindness."""

AXIS_COLOURS: Final[tuple[Colour, ...]] = ((255, 60, 60), (60, 255, 60), (90, 140, 255))
"""x red, y green, z blue, as everywhere."""

_GROUND: Final = 0.35
"""Brightness of the image below the masks."""

_COVER: Final = 0.65
"""Opacity of a mask."""

_MARGIN: Final = 0.1
"""The colour scale is wider than the objects' depths by this share of their range at both ends."""


@dataclass(frozen=True)
class PlotLine:
    """One method's values over training, of one or several runs.

    Attributes:
        values: Of each run; NaN where there is none.
    """

    name: str
    x: Float[np.ndarray, "points"]
    values: Float[np.ndarray, "runs points"]
    colour: str
    dashed: bool = False


def lines_figure(
    lines: Sequence[PlotLine], x_label: str, y_label: str, log_y: bool = False
) -> Figure:
    """Draw lines; of several runs their mean, in a band from the lowest to the highest.

    ``y_label`` has its unit; ``log_y`` makes values logarithmic, where all are positive.
    """
    figure, axes = figure_with_axes(x_label, y_label)
    for line in lines:
        mean = line.values.mean(axis=0)
        if len(line.values) > 1:
            low, high = line.values.min(axis=0), line.values.max(axis=0)
            axes.fill_between(line.x, low, high, color=line.colour, alpha=0.2, linewidth=0)
        marker = "o" if len(mean) <= _SMOOTHING else ""
        if len(mean) > _SMOOTHING and len(line.values) == 1:
            axes.plot(line.x, mean, color=line.colour, alpha=0.2)
        axes.plot(line.x, smoothed(mean), "--" if line.dashed else "-", color=line.colour,
                  label=line.name, marker=marker, markersize=3)  # fmt: skip
    positive = [(line.values[np.isfinite(line.values)] > 0).all() for line in lines]
    if log_y and lines and all(positive):
        axes.set_yscale("log")
    if lines:
        axes.legend(fontsize="small")
    return figure


def smoothed(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return the moving average of a long line, of what there is near its ends."""
    width = max(1, len(values) // _SMOOTHING)
    if width == 1:
        return values
    window = np.ones(width)
    counted = np.convolve(np.ones(len(values)), window, mode="same")
    return np.asarray(np.convolve(values, window, mode="same") / counted)


def grid(pictures: Sequence[Picture], columns: int) -> Picture:
    """Put pictures side by side, row by row, on white; a ValueError, if there is none to put."""
    if not pictures or columns < 1:
        raise ValueError(f"a grid needs pictures and columns, got {len(pictures)} and {columns}")
    rows = [pictures[i : i + columns] for i in range(0, len(pictures), columns)]
    width = max(sum(one.shape[1] for one in row) for row in rows)
    bands = []
    for row in rows:
        band = np.full((max(one.shape[0] for one in row), width, 3), _WHITE, np.uint8)
        left = 0
        for one in row:
            band[: one.shape[0], left : left + one.shape[1]] = one
            left += one.shape[1]
        bands.append(band)
    return np.concatenate(bands)


def message_picture(width: int, height: int, text: str) -> Picture:
    """Return an empty picture that says why it is empty; lines beyond its height are cut."""
    picture = np.full((height, width, 3), _GREY, np.uint8)
    size = max(10, int(_TEXT_SHARE * width))
    per_line = max(10, int((width - 2 * size) / (_CHARACTER_SHARE * size)))
    for number, line in enumerate(textwrap.wrap(text, per_line)):
        top = size + number * (size + size // 4)
        if top + size > height:
            break
        draw_text(picture, line, (size, top), size, (255, 255, 255))
    return picture


def mask_panel(image: Picture, masks: Sequence[Mask | None]) -> Picture:
    """Paint each instance's visible pixels in its colour on the darkened, grey image."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None].repeat(3, axis=2)
    panel = _GROUND * grey.astype(np.float64)
    for number, mask in enumerate(masks):
        if mask is not None:
            colour = np.array(COLOURS[number % len(COLOURS)])
            panel[mask] = (1 - _COVER) * grey[mask] + _COVER * colour
    return np.asarray(np.rint(panel), np.uint8)


def depth_panel(depth: DepthMap, shown: Mask) -> tuple[Picture, str]:
    """Colour depth from near (red) to far (blue), unknown black; return the ends in words, too.

    The scale is for the ``shown`` pixels, the objects': a plane that reaches far behind them would
    leave them one colour.
    """
    known = depth > 0
    scale = depth[known & shown] if (known & shown).any() else depth[known]
    if not scale.size:
        return np.zeros((*depth.shape, 3), np.uint8), "no depth"
    near, far = float(scale.min()), float(scale.max())
    margin = max(_MARGIN * (far - near), 1e-3)  # at least a millimetre, also of a flat depth
    near, far = max(near - margin, 0.0), far + margin
    share = np.clip((far - depth) / (far - near), 0, 1)
    coloured = cv2.applyColorMap(np.rint(255 * share).astype(np.uint8), cv2.COLORMAP_TURBO)
    panel = cv2.cvtColor(coloured, cv2.COLOR_BGR2RGB)
    panel[~known] = 0
    return np.asarray(panel, np.uint8), f"depth: red {near:.3f} m to blue {far:.3f} m"


def draw_axes(image: Picture, ends: Float[np.ndarray, "4 2"], thickness: int = 2) -> None:
    """Draw the object frame's axes IN PLACE.

    ``ends`` is where the origin and the tips of x, y and z are seen, pixels; a line whose end is
    not finite or far outside is left out.
    """
    # A tip that far outside of the image belongs to an object beside the camera.
    bound = 10 * max(image.shape)
    for tip, colour in zip(ends[1:], AXIS_COLOURS, strict=True):
        if (np.abs([ends[0], tip]) < bound).all():
            draw_line(image, ends[0], tip, colour, thickness)
