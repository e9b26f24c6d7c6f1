"""Rates per bin of a quantity: where does a method fail?"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from dopepp.drawing.png import figure_image, write_png, write_whole
from dopepp.drawing.rates import RateCurve, rates_figure
from dopepp.experiment import display
from dopepp.experiment.pass_rates import PassRate
from dopepp.experiment.quantities import QUANTITIES, Quantity
from dopepp.experiment.tables import csv_text
from dopepp.metrics.functional import wilson_interval
from dopepp.metrics.pose import PoseMetrics
from dopepp.metrics.row import NOT_AVAILABLE, finite_median

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
