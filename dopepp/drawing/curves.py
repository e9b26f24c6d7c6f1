"""Curves: share of poses below a threshold.

Figures are objects (:class:`matplotlib.figure.Figure`), never pyplot's global state, so threads
and tests cannot see each other's. ``figure_image`` turns one into pixels.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dopepp.drawing.png import figure_image, write_png, write_whole

MAX_THRESHOLD: Final = 0.1
"""Where accuracy-threshold curves end, metres (paper Fig. 4)."""

_NUM_STEPS: Final = 200
"""Steps of a curve: 0.5 mm each up to 0.1 m."""


def accuracy_curve(
    errors: Float[np.ndarray, "n"], max_threshold: float = MAX_THRESHOLD
) -> tuple[Float[np.ndarray, "steps"], Float[np.ndarray, "steps"]]:
    """Return thresholds from 0 to ``max_threshold`` and the share of errors strictly below each.

    NaN and infinite errors are misses; without errors every share is 0.
    """
    thresholds = np.linspace(0.0, max_threshold, _NUM_STEPS + 1)
    errors = np.asarray(errors, np.float64)
    # NaN sorts last, behind infinity; searchsorted on the left counts what is strictly below.
    below = np.searchsorted(np.sort(errors), thresholds, side="left")
    return thresholds, below / max(len(errors), 1)


def accuracy_figure(
    curves: Mapping[str, Float[np.ndarray, "n"]],
    max_threshold: float = MAX_THRESHOLD,
    title: str = "",
    colours: Mapping[str, str] | None = None,
) -> Figure:
    """Draw accuracy-threshold curves of several methods, their exact AUC in the legend.

    Args:
        curves: Errors in metres by name; a miss is infinite.
        max_threshold: End of the curves, metres.
        title: Title of the figure.
        colours: Matplotlib's names of colours by method; its own order by default.
    """
    figure, axes = figure_with_axes("error threshold (m)", "share of instances below (%)", title)
    for name, errors in curves.items():
        thresholds, accuracy = accuracy_curve(errors, max_threshold)
        area = 100 * _area(np.asarray(errors, np.float64), max_threshold)
        colour = None if colours is None else colours[name]
        axes.plot(thresholds, 100 * accuracy, label=f"{name} (AUC {area:.1f} %)", color=colour)
    axes.set_xlim(0, max_threshold)
    axes.set_ylim(0, 101)
    if curves:
        axes.legend(loc="lower right", fontsize="small")
    return figure


def save_accuracy_curves(
    path: Path | str,
    curves: Mapping[str, Float[np.ndarray, "n"]],
    max_threshold: float = MAX_THRESHOLD,
    title: str = "",
) -> Figure:
    """Write the curves as ``<path>.png`` and ``<path>.csv`` and return the figure.

    The CSV has a column ``threshold_m`` and one per method with the share below, in [0, 1].
    """
    path = Path(path)
    thresholds = np.linspace(0.0, max_threshold, _NUM_STEPS + 1)
    shares = [accuracy_curve(errors, max_threshold)[1] for errors in curves.values()]
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["threshold_m", *curves])
    for threshold, *row in zip(thresholds, *shares, strict=True):
        writer.writerow([f"{threshold:.6g}", *(f"{share:.6g}" for share in row)])
    write_whole(path.with_name(path.name + ".csv"), text.getvalue().encode())
    figure = accuracy_figure(curves, max_threshold, title)
    write_png(path.with_name(path.name + ".png"), figure_image(figure))
    return figure


def figure_with_axes(x_label: str, y_label: str, title: str = "") -> tuple[Figure, Axes]:
    """Return an empty figure with labelled axes."""
    figure = Figure(figsize=(6.4, 4.4), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.set_title(title)
    axes.grid(visible=True, alpha=0.3)
    return figure, axes


def _area(errors: Float[np.ndarray, "n"], max_threshold: float) -> float:
    """Exact area under the curve; metrics stand above drawing, which may not import ``auc``."""
    if len(errors) == 0:
        return 0.0
    # fmin passes NaN over, which makes it the miss it is.
    return float(np.mean(1 - np.fmin(errors, max_threshold) / max_threshold))
