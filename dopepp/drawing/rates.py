"""Rates with their confidence intervals, over a quantity that makes a task harder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

_PANEL_INCHES: Final = (5.2, 4.0)


@dataclass(frozen=True)
class RateCurve:
    """One line: rates in [0, 1] at ascending values of a quantity.

    Attributes:
        x: The quantity.
        rate: The rate there.
        low: Lower end of its confidence interval.
        high: Upper end.
    """

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
    """Draw panels row by row, each with a line and a band of confidence for every method.

    Args:
        panels: By title, then by method; at least one.
        x_label: The quantity with its unit.
        columns: Panels in a row.
        edges: Where bins end, marked on the axis; None for none.
        ratio: Whether the quantity is a ratio: its axis is logarithmic, marked where it was
            measured.

    Raises:
        ValueError: There is no panel or no column.
    """
    if not panels or columns < 1:
        raise ValueError(f"rates need panels and columns, got {len(panels)} and {columns}")
    rows = -(-len(panels) // columns)
    width, height = _PANEL_INCHES
    figure = Figure(figsize=(columns * width, rows * height), dpi=120, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes, (title, curves) in zip(grid.flat, panels.items(), strict=False):
        _draw_panel(axes, title, curves, x_label, edges)
        if ratio:
            measured = sorted({float(x) for curve in curves.values() for x in curve.x})
            axes.set_xscale("log")
            axes.set_xticks(measured, [f"{x:g}" for x in measured])
            axes.minorticks_off()
    for axes in grid.flat[len(panels) :]:
        axes.set_axis_off()
    return figure


def _draw_panel(
    axes: Axes,
    title: str,
    curves: Mapping[str, RateCurve],
    x_label: str,
    edges: Float[np.ndarray, "edges"] | None,
) -> None:
    for name, curve in curves.items():
        (line,) = axes.plot(curve.x, 100 * curve.rate, marker="o", markersize=4, label=name)
        axes.fill_between(
            curve.x, 100 * curve.low, 100 * curve.high, color=line.get_color(), alpha=0.15, lw=0
        )
        # A band needs two points, and a bar says which points are measured.
        axes.vlines(curve.x, 100 * curve.low, 100 * curve.high, line.get_color(), alpha=0.5, lw=1)
    for edge in () if edges is None else edges:
        axes.axvline(float(edge), color="0.8", linewidth=0.8, zorder=0)
    axes.set_title(title)
    axes.set_xlabel(x_label)
    axes.set_ylabel("share of instances and 95 % interval (%)")
    axes.set_ylim(-2, 102)
    axes.grid(visible=True, axis="y", alpha=0.3)
    if curves:
        axes.legend(loc="best")
