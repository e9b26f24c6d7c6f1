"""Rates per bin of a quantity, such as the distance: they tell where a method fails.

To add a quantity, write a function of the instances of one object, name it in :data:`QUANTITIES`
and in :data:`dopepp.experiment.config.protocols.QuantityName`.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import pandas as pd
import torch
from jaxtyping import Float, Int

from dopepp.core.files import write_csv, write_png
from dopepp.drawing.curves import figure_image, rates_figure
from dopepp.experiment.config.protocols import QuantityName
from dopepp.experiment.results import display
from dopepp.experiment.results.frame import PassRate, Row, Value, interval, pivot, rate_curves
from dopepp.geometry.camera import project_keypoints
from dopepp.geometry.cuboid import CENTROID
from dopepp.metrics.pose import MEAN, Gathered, PoseMetrics
from dopepp.metrics.row import finite_median

_log = logging.getLogger(__name__)

Numbers = Float[np.ndarray, "n"]
"""A number of each of n instances."""


@dataclass(frozen=True)
class Quantity:
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
    "distance": Quantity("distance (m)", lambda one: np.linalg.norm(_centres(one), axis=1), 3),
    "visibility": Quantity("visible fraction", lambda one: one.visible_fractions.numpy(), 3),
    "size": Quantity("apparent size (px)", sizes, 1),
    "rotation": Quantity("view angle (°)", view_angles, 1),
}
"""What rates can be broken down by."""


def bin_numbers(values: Numbers, num_bins: int) -> Int[np.ndarray, "n"]:
    """Return each value's bin, counted from 0; bins have equal counts, equal values share one.

    A value falls where the middle of its ranks does, so that a bin of many equal values (objects
    that nothing hides) draws no others in. Bins that stay empty are left out.
    """
    middles = pd.Series(values, dtype=float).rank() - 0.5
    bins = np.floor(middles * num_bins / max(len(values), 1))
    return np.asarray(bins.rank(method="dense").astype(int) - 1)


@dataclass(frozen=True)
class Bin:
    """The instances between two values of a quantity, over the whole test set.

    ``middle`` is their median, which no other bin has.
    """

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
    gathered = {name: [one.instances(part) for part in one.parts] for name, one in metrics.items()}
    numbers = {
        name: np.concatenate([QUANTITIES[quantity].of(one) for one in own])
        for name, own in gathered.items()
    }
    everything = next(reversed(numbers.values()))
    groups = pd.Series(everything, dtype=float).groupby(bin_numbers(everything, num_bins))
    ends = groups.agg(["min", "max", "median"]).itertuples(index=False)
    bins = [Bin(*map(float, one)) for one in ends]
    values = [
        value
        for one in bins
        for name, own in gathered.items()
        for value in _in_bin(one, name, numbers[name], own, rates)
    ]
    return bins, values


def _in_bin(
    one: Bin,
    method: str,
    numbers: Numbers,
    gathered: Sequence[Gathered],
    rates: Sequence[PassRate],
) -> Iterator[Value]:
    """Measure one method in one bin; a rate of no instance does not exist."""
    chosen = torch.from_numpy((numbers >= one.low) & (numbers <= one.high))
    rotations = torch.cat([own.errors.rotation_s_deg for own in gathered])[chosen]
    num = len(rotations)
    median = finite_median(rotations)
    value = Value(method, MEAN, condition=one.middle)
    yield value._replace(measure="num_instances", value=num)
    for rate in rates:
        passed = torch.cat([rate.passed(own) for own in gathered])[chosen]
        share = int(passed.sum()) / num if num else math.nan
        low, high = interval(share, num)
        yield value._replace(measure=rate.field, value=share, low=low, high=high)
    yield value._replace(
        measure="median_rotation_deg", value=math.nan if median is None else median
    )
    missed = float((~rotations.isfinite()).double().mean())
    yield value._replace(measure="miss_rate", value=missed)


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
    what = QUANTITIES[quantity]
    by_middle = {one.middle: one for one in bins}

    def shown(value: Value) -> Row:
        own = by_middle[value.condition]
        ends = dict.fromkeys(f"{end:.{what.decimals}f}" for end in (own.low, own.high))
        row = {what.heading: " … ".join(ends)}
        if value.measure == "num_instances":
            return {**row, value.heading: value.text}
        if value.measure == "miss_rate":
            return row
        prefix = f"{value.method} " if len(metrics) > 1 else ""
        span = f" [{100 * value.low:.0f}, {100 * value.high:.0f}]" if value.ends else ""
        return {**row, f"{prefix}{value.heading}": f"{value.text}{span}"}

    def recorded(value: Value) -> dict[str, object]:
        own = by_middle[value.condition]
        row = {"method": value.method, "from": own.low, "to": own.high, "median": own.middle}
        ends = {"low": value.low, "high": value.high} if value.ends else {}
        named = {f"{value.measure}_{end}": number for end, number in ends.items()}
        return {**row, value.measure: value.plain, **named}

    display.show_table(
        f"by {quantity}: rates with 95 % intervals", pivot(values, ["condition"], shown)
    )
    path = run_dir / f"by_{quantity}"
    write_csv(path.with_suffix(".csv"), pivot(values, ["condition", "method"], recorded))
    panels = {
        rate.title: rate_curves([value for value in values if value.measure == rate.field])
        for rate in rates
    }
    # Between two bins lie no instances; the line stands in the middle of the gap.
    gaps = [(one.high + following.low) / 2 for one, following in pairwise(bins)]
    edges = np.array([bins[0].low, *gaps, bins[-1].high])
    figure = rates_figure(panels, what.heading, len(rates), edges)
    write_png(path.with_suffix(".png"), figure_image(figure))
