"""Plots: accuracy over error thresholds, rates over conditions, and values over training.

Figures are :class:`matplotlib.figure.Figure` objects without pyplot's global state.
:func:`figure_image` renders a figure to pixels.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from dopepp.core.files import write_csv, write_png
from dopepp.drawing.pictures import RGBImage

# On first use, matplotlib reports its list of fonts.
logging.getLogger("matplotlib.font_manager").setLevel(logging.WARNING)

MAX_THRESHOLD: Final = 0.1  # Largest threshold of accuracy-threshold curves, metres (paper Fig. 4)
_NUM_STEPS: Final = 200  # of a curve, 0.5 mm each

_SMOOTHING: Final = 50
"""Lines with more points are drawn pale, below their moving average over 1/50 of the points."""


def accuracy_curve(
    errors: Float[np.ndarray, "n"],
) -> tuple[Float[np.ndarray, "steps"], Float[np.ndarray, "steps"]]:
    """Return thresholds from 0 to 0.1 m, and the share of pose errors strictly below each.

    ``errors`` (e.g. ADD of each instance) are in metres; NaN and infinite errors are misses.
    Without errors, all shares are 0.
    """
    thresholds = np.linspace(0.0, MAX_THRESHOLD, _NUM_STEPS + 1)
    errors = np.asarray(errors, np.float64)
    # NaN sorts last, behind infinity; searchsorted on the left counts errors strictly below.
    below = np.searchsorted(np.sort(errors), thresholds, side="left")
    return thresholds, below / max(len(errors), 1)


def accuracy_figure(
    curves: Mapping[str, Float[np.ndarray, "n"]],
    title: str = "",
    colours: Mapping[str, str] | None = None,
) -> Figure:
    """Draw accuracy-threshold curves of several methods, with their exact AUC in the legend.

    ``curves`` are the pose errors of each instance by method, metres; infinite for a miss.
    ``colours`` are Matplotlib's by default.
    """
    figure, axes = figure_with_axes("error threshold (m)", "share of instances below (%)", title)
    for name, errors in curves.items():
        thresholds, accuracy = accuracy_curve(errors)
        area = 100 * _area(np.asarray(errors, np.float64))
        colour = None if colours is None else colours[name]
        axes.plot(thresholds, 100 * accuracy, label=f"{name} (AUC {area:.1f} %)", color=colour)
    axes.set(xlim=(0, MAX_THRESHOLD), ylim=(0, 101))
    if curves:
        axes.legend(loc="lower right", fontsize="small")
    return figure


def save_accuracy_curves(
    path: Path | str, curves: Mapping[str, Float[np.ndarray, "n"]], title: str = ""
) -> Figure:
    """Write :func:`accuracy_figure`'s curves to ``<path>.png`` and ``.csv``; return the figure.

    The CSV has a column ``threshold_m`` and, for each method, the share of smaller errors, 0 to 1.
    """
    path = Path(path)
    columns = {"threshold_m": accuracy_curve(np.zeros(0))[0]}
    columns |= {name: accuracy_curve(errors)[1] for name, errors in curves.items()}
    rows = [
        {name: f"{value:.6g}" for name, value in zip(columns, values, strict=True)}
        for values in zip(*columns.values(), strict=True)
    ]
    write_csv(path.with_name(path.name + ".csv"), rows)
    figure = accuracy_figure(curves, title)
    write_png(path.with_name(path.name + ".png"), figure_image(figure))
    return figure


def figure_with_axes(x_label: str, y_label: str, title: str = "") -> tuple[Figure, Axes]:
    """Return a figure with labelled axes, a grid and no data."""
    figure = Figure(figsize=(6.4, 4.4), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlabel=x_label, ylabel=y_label, title=title)
    axes.grid(visible=True, alpha=0.3)
    return figure, axes


def figure_image(figure: Figure) -> RGBImage:
    """Render a figure to an RGB image, without a window."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    return np.ascontiguousarray(pixels[..., :3])


def _area(errors: Float[np.ndarray, "n"]) -> float:
    """Return the area under the curve of :func:`accuracy_curve`, divided by 0.1 m, in [0, 1].

    ``metrics.auc`` belongs to a higher layer, which this module cannot import.
    """
    if len(errors) == 0:
        return 0.0
    # fmin ignores NaN, so NaN is a miss.
    return float(np.mean(1 - np.fmin(errors, MAX_THRESHOLD) / MAX_THRESHOLD))


@dataclass(frozen=True)
class RateCurve:
    """A rate in [0, 1], e.g. accuracy, at ascending ``x``; 95 % limits ``low`` and ``high``."""

    x: Float[np.ndarray, "points"]
    rate: Float[np.ndarray, "points"]
    low: Float[np.ndarray, "points"]
    high: Float[np.ndarray, "points"]


def rates_figure(
    panels: Mapping[str, Mapping[str, RateCurve]],
    x_label: str,
    columns: int,
    edges: Float[np.ndarray, "edges"] | None = None,
    *,
    ratio: bool = False,
) -> Figure:
    """Draw panels row by row, with a line and a confidence band for each method.

    ``panels`` has the curves by title of the panel and name of the method. Vertical lines mark the
    ``edges``, values of x. With ``ratio``, the x axis is logarithmic, with ticks at the curves'
    values of x.
    """
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(columns * 5.2, rows * 4.0), dpi=120, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes, (title, curves) in zip(grid.flat, panels.items(), strict=False):
        for name, curve in curves.items():
            rate, low, high = 100 * curve.rate, 100 * curve.low, 100 * curve.high
            (line,) = axes.plot(curve.x, rate, marker="o", markersize=4, label=name)
            axes.fill_between(curve.x, low, high, color=line.get_color(), alpha=0.15, lw=0)
            # Bars mark the measured points; a band needs at least two.
            axes.vlines(curve.x, low, high, line.get_color(), alpha=0.5, lw=1)
        for edge in () if edges is None else edges:
            axes.axvline(float(edge), color="0.8", linewidth=0.8, zorder=0)
        axes.set(title=title, xlabel=x_label, ylim=(-2, 102))
        axes.set_ylabel("share of instances and 95 % interval (%)")
        axes.grid(visible=True, axis="y", alpha=0.3)
        if curves:
            axes.legend(loc="best")
        if ratio:
            measured = sorted({float(x) for curve in curves.values() for x in curve.x})
            axes.set_xscale("log")
            axes.set_xticks(measured, [f"{x:g}" for x in measured])
            axes.minorticks_off()
    for axes in grid.flat[len(panels) :]:
        axes.set_axis_off()
    return figure


def coverage_figure(curves: Mapping[str, RateCurve]) -> Figure:
    """Draw the observed (``rate``) against the nominal coverage (``x``) of pose covariances.

    Coverage is the share of true poses in the confidence region of a probability, 0 to 1.
    """
    percent = {name: replace(curve, x=100 * curve.x) for name, curve in curves.items()}
    figure = rates_figure({"coverage of the covariances": percent}, "nominal (%)", columns=1)
    axes = figure.axes[0]
    axes.plot([0, 100], [0, 100], "--", color="0.5", zorder=0)
    axes.set_ylabel("observed, and 95 % interval (%)")
    return figure


@dataclass(frozen=True)
class PlotLine:
    """Values of a method's training runs over a quantity ``x``, e.g. epochs; NaN if missing."""

    name: str
    x: Float[np.ndarray, "points"]
    values: Float[np.ndarray, "runs points"]
    colour: str
    dashed: bool = False


def lines_figure(
    lines: Sequence[PlotLine], x_label: str, y_label: str, log_y: bool = False
) -> Figure:
    """Draw the smoothed mean of each line's runs, in a band from the lowest to the highest run.

    ``log_y`` selects a logarithmic y axis if all finite values are positive.
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
        style = ("--" if line.dashed else "-") + marker
        axes.plot(
            line.x, moving_average(mean), style, color=line.colour, label=line.name, markersize=3
        )
    positive = [(line.values[np.isfinite(line.values)] > 0).all() for line in lines]
    if log_y and lines and all(positive):
        axes.set_yscale("log")
    if lines:
        axes.legend(fontsize="small")
    return figure


def moving_average(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return the moving average over windows of 1/50 of the points, which shrink at the ends."""
    width = max(1, len(values) // _SMOOTHING)
    if width == 1:
        return values
    window = np.ones(width)
    counts = np.convolve(np.ones(len(values)), window, mode="same")
    return np.asarray(np.convolve(values, window, mode="same") / counts)
