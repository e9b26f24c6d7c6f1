"""Lines of several methods in one figure, and figures beside each other as one picture."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure

from dopepp.drawing.curves import figure_with_axes
from dopepp.drawing.text import draw_text

_SMOOTHING: Final = 50
"""A line of more points than this is drawn as a moving average over 1/50 of them, above its own
pale self."""

_WHITE: Final = 255
_GREY: Final = 225
_TEXT_SHARE: Final = 0.05
"""Height of a line of a message, as a share of the picture's width."""
_CHARACTER_SHARE: Final = 0.52
"""Mean width of a character, as a share of the line's height."""


@dataclass(frozen=True)
class Line:
    """One method's values over training, of one or several runs.

    Attributes:
        name: Its entry in the legend.
        x: Progress, ascending.
        values: Of each run; NaN where there is none.
        colour: Matplotlib's name of a colour.
        dashed: Whether it is what another line is compared with.
    """

    name: str
    x: Float[np.ndarray, "points"]
    values: Float[np.ndarray, "runs points"]
    colour: str
    dashed: bool = False


def lines_figure(lines: Sequence[Line], x_label: str, y_label: str, log_y: bool = False) -> Figure:
    """Draw lines; of several runs their mean, in a band from the lowest to the highest.

    Args:
        lines: The methods.
        x_label: What counts the progress.
        y_label: What is drawn, with its unit.
        log_y: Logarithmic values, where all are positive.
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


def grid(
    pictures: Sequence[UInt8[np.ndarray, "height width 3"]], columns: int
) -> UInt8[np.ndarray, "height width 3"]:
    """Put pictures side by side, row by row, on white.

    Raises:
        ValueError: There are none, or fewer than one column.
    """
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


def message_picture(width: int, height: int, text: str) -> UInt8[np.ndarray, "height width 3"]:
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
