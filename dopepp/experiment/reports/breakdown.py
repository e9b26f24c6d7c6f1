"""Rates per bin of a quantity: where does a method fail?

What instances can be sorted by: distance, visibility, apparent size, view angle.

To add a quantity, write a function of the instances of one object and name it in
:data:`QUANTITIES`; what the state lacks for it goes into
:class:`~dopepp.metrics.pose.PoseMetrics`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int

from dopepp.core.files import write_png, write_whole
from dopepp.drawing.curves import RateCurve, figure_image, rates_figure
from dopepp.experiment.reports.tables import PassRate, csv_text
from dopepp.experiment.runs import display
from dopepp.geometry.camera import project_keypoints
from dopepp.geometry.cuboid import CENTROID
from dopepp.metrics.functional import wilson_interval
from dopepp.metrics.pose import Gathered, PoseMetrics
from dopepp.metrics.row import NOT_AVAILABLE, finite_median


@dataclass(frozen=True)
class Quantity:
    """What instances are sorted by.

    Attributes:
        heading: Name and unit, for tables and axes.
        of: Its value for every instance of an object.
        decimals: Digits after the point in tables.
    """

    heading: str
    of: Callable[[Gathered], Float[np.ndarray, "n"]]
    decimals: int


def distances(instances: Gathered) -> Float[np.ndarray, "n"]:
    """Return the distance from the camera to the centre of the cuboid, metres."""
    return np.asarray(np.linalg.norm(_centres(instances), axis=1))


def visible_fractions(instances: Gathered) -> Float[np.ndarray, "n"]:
    """Return the visible share of the silhouette, in [0, 1]."""
    return np.asarray(instances.visible_fractions.numpy())


def sizes(instances: Gathered) -> Float[np.ndarray, "n"]:
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


def view_angles(instances: Gathered) -> Float[np.ndarray, "n"]:
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


QUANTITIES: Final[dict[str, Quantity]] = {
    "distance": Quantity("distance (m)", distances, 3),
    "visibility": Quantity("visible fraction", visible_fractions, 3),
    "size": Quantity("apparent size (px)", sizes, 1),
    "rotation": Quantity("view angle (°)", view_angles, 1),
}
"""What rates can be broken down by."""


_log = logging.getLogger(__name__)


def bin_numbers(values: Float[np.ndarray, "n"], num_bins: int) -> Int[np.ndarray, "n"]:
    """Distribute values over bins of equal counts; equal values share a bin.

    A value falls where the middle of its ranks does, so that a bin of many equal values (objects
    that nothing hides) draws no others in. Bins that stay empty are left out.

    Returns:
        The bin of each value, counted from 0 in ascending order.
    """
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    middles = np.cumsum(counts) - counts / 2
    bins = np.floor(middles * num_bins / max(len(values), 1)).astype(int)
    return np.asarray(np.unique(bins, return_inverse=True)[1][place])


@dataclass(frozen=True)
class BinnedRates:
    """One method in one bin.

    Attributes:
        method: The method's name.
        low: Smallest value of the quantity in the bin, over the whole test set.
        high: Largest value.
        middle: Median value.
        num_instances: The method's instances in it.
        rates: Each rate with its 95 % interval: (rate, low, high), by field; None where there is
            no instance.
        median_rotation_deg: Over the matched ones, to the nearest symmetry, degrees; None where
            there is none.
        miss_rate: Share without a prediction; None where there is no instance.
    """

    method: str
    low: float
    high: float
    middle: float
    num_instances: int
    rates: dict[str, tuple[float, float, float] | None]
    median_rotation_deg: float | None
    miss_rate: float | None

    def to_record(self) -> dict[str, object]:
        """Return a row of the CSV file."""
        record: dict[str, object] = {
            "method": self.method, "from": self.low, "to": self.high, "median": self.middle,
            "num_instances": self.num_instances,
        }  # fmt: skip
        for field, rate in self.rates.items():
            values = (None, None, None) if rate is None else rate
            record |= dict(zip((field, f"{field}_low", f"{field}_high"), values, strict=True))
        return {
            **record, "median_rotation_deg": self.median_rotation_deg, "miss_rate": self.miss_rate
        }  # fmt: skip


def break_down(
    metrics: Mapping[str, PoseMetrics], quantity: str, num_bins: int, rates: Sequence[PassRate]
) -> list[list[BinnedRates]]:
    """Measure rates per bin, over the instances of all objects together.

    Args:
        metrics: The accumulator of each method on one test set; the last one scores all objects,
            and its instances decide the bins.
        quantity: A key of :data:`QUANTITIES`.
        num_bins: How many bins of equal counts.
        rates: Which rates.

    Returns:
        For each bin, in ascending order, an entry per method.
    """
    tables = {name: _table(one, quantity, rates) for name, one in metrics.items()}
    values = next(reversed(tables.values())).values
    numbers = bin_numbers(values, num_bins)
    bins = [values[numbers == number] for number in range(int(numbers.max(initial=-1)) + 1)]
    return [
        [table.in_bin(name, inside, rates) for name, table in tables.items()] for inside in bins
    ]


@dataclass(frozen=True)
class _Table:
    """A method's instances of all objects: the quantity, what passed, and errors."""

    values: Float[np.ndarray, "n"]
    passed: dict[str, torch.Tensor]
    rotations: torch.Tensor

    def in_bin(
        self, method: str, inside: Float[np.ndarray, "m"], rates: Sequence[PassRate]
    ) -> BinnedRates:
        low, high = float(inside.min()), float(inside.max())
        chosen = torch.from_numpy((self.values >= low) & (self.values <= high))
        num = int(chosen.sum())
        measured: dict[str, tuple[float, float, float] | None] = {}
        for rate in rates:
            passed = int(self.passed[rate.field][chosen].sum())
            interval = wilson_interval(passed, num)
            measured[rate.field] = (passed / num, *interval) if num else None
        rotations = self.rotations[chosen]
        return BinnedRates(
            method, low, high, float(np.median(inside)), num, measured, finite_median(rotations),
            float((~rotations.isfinite()).double().mean()) if num else None,
        )  # fmt: skip


def _table(metrics: PoseMetrics, quantity: str, rates: Sequence[PassRate]) -> _Table:
    gathered = [metrics.instances(name) for name in metrics.parts]
    return _Table(
        np.concatenate([QUANTITIES[quantity].of(one) for one in gathered]),
        {rate.field: torch.cat([rate.passed(one) for one in gathered]) for rate in rates},
        torch.cat([one.errors.rotation_s_deg for one in gathered]),
    )


def record_breakdown(
    run_dir: Path,
    metrics: Mapping[str, PoseMetrics],
    quantity: str,
    num_bins: int,
    rates: Sequence[PassRate],
) -> None:
    """Print a table and write ``by_QUANTITY.csv`` and ``by_QUANTITY.png``; see :func:`break_down`.

    A test set without an instance that counts gives a warning instead.
    """
    bins = break_down(metrics, quantity, num_bins, rates)
    if not bins:
        _log.warning("by=%s: the test set has no instance that counts, so no bin", quantity)
        return
    what = QUANTITIES[quantity]
    rows = [_shown(one, what, rates) for one in bins]
    display.show_table(f"by {quantity}: rates with 95 % intervals", rows)
    records = [one.to_record() for same in bins for one in same]
    path = run_dir / f"by_{quantity}"
    write_whole(path.with_suffix(".csv"), csv_text(records).encode())
    panels = {
        rate.heading.removesuffix(" %"): {
            one.method: _curve([same[number] for same in bins], rate.field)
            for number, one in enumerate(bins[0])
        }
        for rate in rates
    }
    # Between two bins lie no instances; the line stands in the middle of the gap.
    ends = [(a[0].high + b[0].low) / 2 for a, b in pairwise(bins)]
    edges = np.array([bins[0][0].low, *ends, bins[-1][0].high])
    write_png(
        path.with_suffix(".png"),
        figure_image(rates_figure(panels, what.heading, len(rates), edges)),
    )


def _shown(one: Sequence[BinnedRates], what: Quantity, rates: Sequence[PassRate]) -> dict[str, str]:
    """Return a bin's row in the terminal: a column per method and measure."""
    low, high = (f"{value:.{what.decimals}f}" for value in (one[0].low, one[0].high))
    row = {what.heading: low if low == high else f"{low} … {high}"}
    row["instances"] = str(one[-1].num_instances)
    for method in one:
        prefix = f"{method.method} " if len(one) > 1 else ""
        for rate in rates:
            row[f"{prefix}{rate.heading}"] = _percent(method.rates[rate.field])
        angle = method.median_rotation_deg
        row[f"{prefix}rotation °"] = NOT_AVAILABLE if angle is None else f"{angle:.1f}"
    return row


def _percent(rate: tuple[float, float, float] | None) -> str:
    if rate is None:
        return NOT_AVAILABLE
    value, low, high = (100 * one for one in rate)
    return f"{value:.1f} [{low:.0f}, {high:.0f}]"


def _curve(bins: Sequence[BinnedRates], field: str) -> RateCurve:
    """Return one method's rates over the bins in which it has instances."""
    known = [(one.middle, *rate) for one in bins if (rate := one.rates[field]) is not None]
    return RateCurve(*np.array(known, np.float64).reshape(-1, 4).T)
