"""Rates per bin of a quantity, such as the distance: they tell where a method fails.

To add a quantity, write a function of the instances of one object, name it in :data:`QUANTITIES`
and in :data:`dopepp.experiment.config.protocols.QuantityName`.
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
from dopepp.experiment.config.protocols import QuantityName
from dopepp.experiment.results import display
from dopepp.experiment.results.frame import PassRate, Row, Value, interval, pivot, rate_curves
from dopepp.geometry.camera import project_keypoints
from dopepp.geometry.cuboid import CENTROID
from dopepp.metrics.pose import MEAN, Gathered, PoseMetrics

_log = logging.getLogger(__name__)

Numbers = Float[np.ndarray, "n"]
"""A number of each of n instances."""


class Quantity(NamedTuple):
    """What instances are sorted by: its name and unit, its value of each, digits in tables."""

    heading: str
    of: Callable[[Gathered], Numbers]
    decimals: int


def sizes(instances: Gathered) -> Numbers:
    """Return the root of the area of the projected cuboid, pixels of the image as it came.

    The whole cuboid counts, with what is hidden or outside the image; unlike the distance it says
    when a flat part is seen from its edge.
    """
    areas = []
    for T, K in zip(instances.T_gt.numpy(), instances.K.numpy(), strict=True):
        corners = project_keypoints(instances.part.cuboid, T, K)[:CENTROID]
        # A corner behind the camera has no projection.
        corners = corners[np.isfinite(corners).all(axis=1)].astype(np.float32)
        areas.append(cv2.contourArea(cv2.convexHull(corners)) if len(corners) > 2 else 0.0)
    return np.sqrt(np.array(areas, np.float64))


def view_angles(instances: Gathered) -> Numbers:
    """Return the angle between the object's +z axis and the way from it to the camera, degrees.

    At 0° the +z face of the cuboid looks at the camera, at 90° it is seen from its edge.
    """
    towards_camera, axes = -_centres(instances), instances.T_gt.numpy()[:, :3, 2]
    across = np.linalg.norm(np.cross(axes, towards_camera), axis=1)
    return np.asarray(np.degrees(np.arctan2(across, (axes * towards_camera).sum(axis=1))))


def _centres(instances: Gathered) -> Float[np.ndarray, "n 3"]:
    """Return the centres of the cuboids in the camera frame, metres."""
    T = instances.T_gt.numpy()
    return np.asarray(T[:, :3, :3] @ instances.part.cuboid[CENTROID] + T[:, :3, 3])


QUANTITIES: Final[dict[QuantityName, Quantity]] = {
    "distance": Quantity("distance (m)", lambda poses: np.linalg.norm(_centres(poses), axis=1), 3),
    "visibility": Quantity("visible fraction", lambda poses: poses.visible_fractions.numpy(), 3),
    "size": Quantity("apparent size (px)", sizes, 1),
    "rotation": Quantity("view angle (°)", view_angles, 1),
}
"""What rates can be broken down by."""


def bin_numbers(numbers: Numbers, num_bins: int) -> Int[np.ndarray, "n"]:
    """Return each number's bin, counted from 0; bins have equal counts, equal numbers share one.

    A number falls where the middle of its ranks does, so that a bin of many equal numbers (objects
    that nothing hides) draws no others in. Bins that stay empty are left out.
    """
    middles = pd.Series(numbers, dtype=float).rank() - 0.5
    bins = np.floor(middles * num_bins / max(len(numbers), 1))
    return np.asarray(bins.rank(method="dense").astype(int) - 1)


class Bin(NamedTuple):
    """The instances between two values of a quantity; ``middle`` is their median."""

    low: float
    high: float
    middle: float


def break_down(
    metrics: Mapping[str, PoseMetrics],
    quantity: QuantityName,
    num_bins: int,
    rates: Sequence[PassRate],
) -> tuple[list[Bin], list[Value]]:
    """Measure rates per bin, over the instances of all objects together.

    Of the accumulators of the methods on one test set, the last one scores all objects, and its
    instances decide the bins.

    Returns:
        The bins, in ascending order, and bin by bin what each method reaches in them: how many
        instances, the rates, the median rotation of those that were matched (degrees, to the
        nearest symmetry) and the share that was missed. The condition is the middle of a bin.
    """
    instances = {name: _instances(each, quantity, rates) for name, each in metrics.items()}
    quantities = next(reversed(instances.values()))["quantity"]
    ends = quantities.groupby(bin_numbers(quantities, num_bins)).agg(["min", "max", "median"])
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
    """Return quantity, rotation error and what passed of every instance of every object."""
    tables = []
    for gathered in map(metrics.instances, metrics.parts):
        passed = {rate.field: rate.passed(gathered).numpy() for rate in rates}
        numbers = {"quantity": QUANTITIES[quantity].of(gathered), **passed}
        tables.append(pd.DataFrame({**numbers, "rotation": gathered.errors.rotation_s_deg.numpy()}))
    return pd.concat(tables, ignore_index=True)


def _in_bin(
    method: str, limits: Bin, table: pd.DataFrame, rates: Sequence[PassRate]
) -> Iterator[Value]:
    """Measure one method in one bin; a rate of no instance does not exist."""
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
    """Print a table and write ``by_QUANTITY.csv`` and ``by_QUANTITY.png``; see :func:`break_down`.

    A test set without an instance that counts gives a warning instead.
    """
    bins, values = break_down(metrics, quantity, num_bins, rates)
    if not bins:
        _log.warning("by=%s: the test set has no instance that counts, so no bin", quantity)
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

    def recorded(value: Value) -> dict[str, object]:
        low, high, middle = by_middle[value.condition]
        row = {"method": value.method, "from": low, "to": high, "median": middle}
        ends = {"low": value.low, "high": value.high} if value.ends else {}
        named = {f"{value.measure}_{end}": number for end, number in ends.items()}
        return {**row, value.measure: value.plain, **named}

    rows = pivot(values, ["condition"], cells)
    display.show_table(f"by {quantity}: rates with 95 % intervals", rows)
    path = run_dir / f"by_{quantity}"
    write_csv(path.with_suffix(".csv"), pivot(values, ["condition", "method"], recorded))
    panels = {
        rate.title: rate_curves([value for value in values if value.measure == rate.field])
        for rate in rates
    }
    # Between two bins lie no instances; the line stands in the middle of the gap.
    gaps = [(lower.high + upper.low) / 2 for lower, upper in pairwise(bins)]
    edges = np.array([bins[0].low, *gaps, bins[-1].high])
    figure = rates_figure(panels, title, len(rates), edges)
    write_png(path.with_suffix(".png"), figure_image(figure))
