"""Measuring estimators on a test set: one loop, one accumulator, for every kind of comparison."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float

from dopepp.data.sample import Sample
from dopepp.drawing.overlay import BLUE, GREEN, YELLOW, Wireframe, overlay
from dopepp.drawing.sheet import Tile
from dopepp.inference.estimator import PoseEstimator
from dopepp.metrics.pose import MEAN, PoseMetrics
from dopepp.metrics.row import PoseRow
from dopepp.models.cost import network_cost
from dopepp.models.spec import build_network

FULL_SIZE_COST: Final = "full_size_cost"
"""Key of the details that holds what a narrowed network costs at full width and size."""

_WARM_UP_FRAMES: Final = 3
"""The first frames allocate memory and choose kernels; they are not timed."""


@dataclass(frozen=True)
class Cost:
    """What a network costs.

    Attributes:
        parameters: Number of trained numbers.
        gmacs: Multiply-accumulates of one image of the input size, 10⁹.
        ms_per_frame: Median time from image to poses in this run; None if nothing was timed.
    """

    parameters: int
    gmacs: float
    ms_per_frame: float | None = None


@dataclass
class Report:
    """One method's result on one test set.

    Attributes:
        name: The method's name.
        rows: A row per object, then the mean.
        references: The reference rows, by reference and object.
        errors: ADD of every instance, metres, infinite where missed, by object.
        cost: The network's cost.
        num_images: Size of the test set.
        details: Further plain facts, e.g. the range of poses.
    """

    name: str
    rows: dict[str, PoseRow]
    references: dict[str, dict[str, PoseRow]]
    errors: dict[str, Float[np.ndarray, "instances"]]
    cost: Cost
    num_images: int
    details: dict[str, Any] = field(default_factory=dict)

    @property
    def mean(self) -> PoseRow:
        """The mean over objects."""
        return self.rows[MEAN]

    def to_record(self) -> dict[str, Any]:
        """Return what ``metrics.json`` holds."""
        return {
            "name": self.name,
            "num_images": self.num_images,
            "objects": {name: row.to_record() for name, row in self.rows.items()},
            "references": {
                reference: {name: row.to_record() for name, row in rows.items()}
                for reference, rows in self.references.items()
            },
            "add": {
                name: [float(error) if np.isfinite(error) else None for error in errors]
                for name, errors in self.errors.items()
            },
            "cost": vars(self.cost),
            **self.details,
        }

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Report:
        """Read ``metrics.json`` back."""
        known = ("name", "num_images", "objects", "references", "add", "cost")
        return cls(
            name=record["name"],
            rows={name: PoseRow(**row) for name, row in record["objects"].items()},
            references={
                reference: {name: PoseRow(**row) for name, row in rows.items()}
                for reference, rows in record["references"].items()
            },
            errors={
                name: np.array([np.inf if error is None else error for error in errors])
                for name, errors in record["add"].items()
            },
            cost=Cost(**record["cost"]),
            num_images=record["num_images"],
            details={key: value for key, value in record.items() if key not in known},
        )


def measure(
    estimators: Mapping[str, PoseEstimator], samples: Iterable[Sample], num_pictures: int = 12
) -> tuple[list[Report], list[Tile]]:
    """Run estimators over the same images at native resolution.

    Args:
        estimators: By name, the baseline first where there is one.
        samples: The test set.
        num_pictures: How many of the first images are drawn.

    Returns:
        A report per estimator, and pictures with the truth in green and the predictions in yellow;
        of two estimators, the first in blue (paper Fig. 14).
    """
    colours = [YELLOW] if len(estimators) == 1 else [BLUE, YELLOW]
    # One process measures alone: after a distributed training the others have ended.
    metrics = {
        name: PoseMetrics(one.parts, name, sync_on_compute=False)
        for name, one in estimators.items()
    }
    times: dict[str, list[float]] = {name: [] for name in estimators}
    tiles: list[Tile] = []
    num_images = 0
    for sample in samples:
        num_images += 1
        wireframes = [Wireframe(one.keypoints, GREEN, "true") for one in sample.instances]
        for (name, estimator), colour in zip(estimators.items(), colours, strict=True):
            start = time.perf_counter()
            detections = estimator.predict(sample.image, sample.K)
            times[name].append(1000 * (time.perf_counter() - start))
            metrics[name].update(detections, sample.instances)
            wireframes += [Wireframe(one.keypoints, colour, name) for one in detections]
        if len(tiles) < num_pictures:
            tiles.append(Tile(overlay(sample.image, wireframes), sample.key))
    reports = [
        Report(
            name,
            metrics[name].compute(),
            metrics[name].references(),
            {part.name: metrics[name].errors(part.name) for part in estimator.parts},
            cost_of(estimator, times[name]),
            num_images,
        )
        for name, estimator in estimators.items()
    ]
    return reports, tiles


def cost_of(estimator: PoseEstimator, times_ms: Sequence[float] = ()) -> Cost:
    """Count a network's parameters and operations, and take the median of its timed frames."""
    parameters, gmacs = network_cost(estimator.network, estimator.checkpoint.input_size)
    timed = times_ms[_WARM_UP_FRAMES:] or times_ms
    return Cost(parameters, gmacs, statistics.median(timed) if timed else None)


def full_size_cost(spec: Mapping[str, Any], input_size: tuple[int, int], repeats: int = 3) -> Cost:
    """Measure the untrained network of a spec at width 1: what narrowing has saved.

    Args:
        spec: The narrowed network's spec.
        input_size: Input (width, height), pixels; the paper's is 416×416.
        repeats: Timed forward passes after one that is not; the median counts.
    """
    widened = {
        key: {**node, "width": 1.0} if isinstance(node, Mapping) and "width" in node else node
        for key, node in spec.items()
    }
    network = build_network(widened).eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    images = torch.zeros(1, 3, input_size[1], input_size[0], dtype=torch.uint8)
    times = []
    with torch.inference_mode():
        for _ in range(1 + repeats):
            start = time.perf_counter()
            network.maps(images)
            times.append(1000 * (time.perf_counter() - start))
    return Cost(*network_cost(network, input_size), statistics.median(times[1:]))
