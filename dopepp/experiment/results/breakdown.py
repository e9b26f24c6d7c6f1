"""Break pass rates down by bins of a quantity, such as the distance, to show where methods fail.

To add a quantity, write a function of the instances of one object and add it to :data:`QUANTITIES`
and in :data:`dopepp.experiment.config.run_config.QuantityName`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

import cv2
import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from dopepp.core.files import write_csv, write_png
from dopepp.drawing.curves import figure_image, rates_figure
from dopepp.experiment.config.run_config import QuantityName
from dopepp.experiment.results import display
from dopepp.experiment.results.frame import PassRate, Row, Value, interval, pivot, rate_curves
from dopepp.geometry.camera import project_keypoints
from dopepp.geometry.cuboid import CENTROID
from dopepp.metrics.pose import MEAN, EvaluatedInstances, PoseMetrics

_log = logging.getLogger(__name__)

Numbers = Float[np.ndarray, "n"]  # one number per instance


class Quantity(NamedTuple):
    """Quantity to bin instances by."""

    heading: str  # with unit
    of: Callable[[EvaluatedInstances], Numbers]
    decimals: int  # in tables


def sizes(instances: EvaluatedInstances) -> Numbers:
    """Return the square root of the area of the projected cuboid, in pixels of the original image.

    Hidden regions count. Unlike the distance, the size reveals a flat part that is seen edge-on.
    """
    areas = []
    for T, K in zip(instances.T_gt.numpy(), instances.K.numpy(), strict=True):
        corners = project_keypoints(instances.part.cuboid, T, K)[:CENTROID]
        # Corners behind the camera have no projection.
        corners = corners[np.isfinite(corners).all(axis=1)].astype(np.float32)
        areas.append(cv2.contourArea(cv2.convexHull(corners)) if len(corners) > 2 else 0.0)
    return np.sqrt(np.array(areas, np.float64))


def view_angles(instances: EvaluatedInstances) -> Numbers:
    """Return the angle between the object's +z axis and the direction to the camera, degrees."""
    towards_camera, axes = -_centres(instances), instances.T_gt.numpy()[:, :3, 2]
    across = np.linalg.norm(np.cross(axes, towards_camera), axis=1)
    return np.asarray(np.degrees(np.arctan2(across, (axes * towards_camera).sum(axis=1))))


def _centres(instances: EvaluatedInstances) -> Float[np.ndarray, "n 3"]:
    """Return the centres of the cuboids in the camera frame, metres."""
    T = instances.T_gt.numpy()
    return np.asarray(T[:, :3, :3] @ instances.part.cuboid[CENTROID] + T[:, :3, 3])


QUANTITIES: Final[dict[QuantityName, Quantity]] = {
    "distance": Quantity("distance (m)", lambda poses: np.linalg.norm(_centres(poses), axis=1), 3),
    "visibility": Quantity("visible fraction", lambda poses: poses.visible_fractions.numpy(), 3),
    "size": Quantity("apparent size (px)", sizes, 1),
    "rotation": Quantity("view angle (°)", view_angles, 1),
}
"""Quantities by which rates can be broken down."""


def bin_numbers(numbers: Numbers, num_bins: int) -> Int[np.ndarray, "n"]:
    """Assign numbers to bins of equal counts, numbered from 0; equal numbers share a bin.

    The mean rank of a number determines its bin, so a large group of equal numbers does not pull
    other numbers into its bin. Empty bins are omitted.
    """
    middles = pd.Series(numbers, dtype=float).rank() - 0.5
    bins = np.floor(middles * num_bins / max(len(numbers), 1))
    return np.asarray(bins.rank(method="dense").astype(int) - 1)


class Bin(NamedTuple):
    """Range of a quantity; ``middle`` is the median of its instances."""

    low: float
    high: float
    middle: float


def break_down(
    metrics: Mapping[str, PoseMetrics],
    quantity: QuantityName,
    num_bins: int,
    rates: Sequence[PassRate],
) -> tuple[list[Bin], list[Value]]:
    """Measure pass rates in bins of a quantity, over the instances of all objects.

    The last method is measured on all objects, so its instances determine the bins.

    Returns:
        The bins in ascending order, and the values of each method per bin, whose condition is the
        middle of the bin. Rotation errors are the smallest over the symmetries.
    """
    instances = {name: _instances(each, quantity, rates) for name, each in metrics.items()}
    quantities = next(reversed(instances.values()))["quantity"]
    printed = quantities.round(QUANTITIES[quantity].decimals)  # bins have distinct names
    ends = quantities.groupby(bin_numbers(printed, num_bins)).agg(["min", "max", "median"])
    bins = [Bin(*map(float, row)) for row in ends.itertuples(index=False)]
    values = [
        value
        for each in bins
        for name, table in instances.items()
        for value in _in_bin(
            name, each, table[table["quantity"].between(each.low, each.high)], rates
        )
    ]
    return bins, values


def _instances(
    metrics: PoseMetrics, quantity: QuantityName, rates: Sequence[PassRate]
) -> pd.DataFrame:
    """Return a table of all instances: quantity, rotation error (degrees), and passed rates."""
    tables = []
    for gathered in map(metrics.instances, metrics.parts):
        passed = {rate.field: rate.passed(gathered).numpy() for rate in rates}
        numbers = {"quantity": QUANTITIES[quantity].of(gathered), **passed}
        tables.append(pd.DataFrame({**numbers, "rotation": gathered.errors.rotation_s_deg.numpy()}))
    return pd.concat(tables, ignore_index=True)


def _in_bin(
    method: str, limits: Bin, table: pd.DataFrame, rates: Sequence[PassRate]
) -> Iterator[Value]:
    """Yield the values of one method in one bin; rates without instances are NaN."""
    value, num = Value(method, MEAN, condition=limits.middle), len(table)
    yield value._replace(measure="num_instances", value=num)
    for rate in rates:
        share = float(table[rate.field].mean())
        low, high = interval(share, num)
        yield value._replace(measure=rate.field, value=share, low=low, high=high)
    is_matched = np.isfinite(table["rotation"])
    median = float(table["rotation"][is_matched].median())
    yield value._replace(measure="median_rotation_deg", value=median)
    yield value._replace(measure="miss_rate", value=float((~is_matched).mean()))


def record_breakdown(
    run_dir: Path,
    metrics: Mapping[str, PoseMetrics],
    quantity: QuantityName,
    num_bins: int,
    rates: Sequence[PassRate],
) -> None:
    """Print a table of :func:`break_down` and write ``by_QUANTITY.csv`` and ``by_QUANTITY.png``."""
    bins, values = break_down(metrics, quantity, num_bins, rates)
    if not bins:
        _log.warning("by=%s: no bins, because the test set has no evaluated instance", quantity)
        return
    title, _, decimals = QUANTITIES[quantity]
    by_middle = {each.middle: each for each in bins}

    def cells(value: Value) -> Row:
        limits = by_middle[value.condition]
        ends = dict.fromkeys(f"{end:.{decimals}f}" for end in (limits.low, limits.high))
        row = {title: " … ".join(ends)}
        if value.measure == "num_instances":
            return {**row, value.heading: value.text}
        if value.measure == "miss_rate":
            return row
        prefix = f"{value.method} " if len(metrics) > 1 else ""
        span = f" [{100 * value.low:.0f}, {100 * value.high:.0f}]" if value.ends else ""
        return {**row, f"{prefix}{value.heading}": f"{value.text}{span}"}

    def csv_cells(value: Value) -> dict[str, object]:
        low, high, middle = by_middle[value.condition]
        row = {"method": value.method, "from": low, "to": high, "median": middle}
        ends = {"low": value.low, "high": value.high} if value.ends else {}
        named = {f"{value.measure}_{end}": number for end, number in ends.items()}
        return {**row, value.measure: value.plain, **named}

    rows = pivot(values, ["condition"], cells)
    display.show_table(f"by {quantity}: rates with 95 % intervals", rows)
    path = run_dir / f"by_{quantity}"
    write_csv(path.with_suffix(".csv"), pivot(values, ["condition", "method"], csv_cells))
    panels = {
        rate.title: rate_curves([value for value in values if value.measure == rate.field])
        for rate in rates
    }
    # There are no instances between two bins; the border is drawn in the middle of the gap.
    gaps = [(lower.high + upper.low) / 2 for lower, upper in pairwise(bins)]
    edges = np.array([bins[0].low, *gaps, bins[-1].high])
    figure = rates_figure(panels, title, len(rates), edges)
    write_png(path.with_suffix(".png"), figure_image(figure))
