"""Measuring methods on a test set: one loop, one accumulator, for every kind of comparison."""

from __future__ import annotations

import hashlib
import json
import statistics
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float

from dopepp.data.sample import Sample
from dopepp.drawing.overlay import BLUE, GREEN, YELLOW, Wireframe, overlay
from dopepp.drawing.pictures import DepthMap, Size
from dopepp.drawing.sheet import Tile
from dopepp.experiment.results.evaluators import Cost, MeasuredPose, Method, image_id
from dopepp.experiment.results.tables import shown_rows
from dopepp.geometry.camera import CameraMatrix, Transform
from dopepp.metrics.localisation import BopScores, Localisation
from dopepp.metrics.pose import MEAN, MIN_VISIBLE_FRACTION, PoseMetrics
from dopepp.metrics.row import PoseRow, mean_row
from dopepp.models.network import build_network, network_cost
from dopepp.parts.part import Part, Parts
from dopepp.virtual.renderers.raster.visibility import draw_alone, project_object
from dopepp.virtual.scene import SceneObject
from dopepp.virtual.surface import Surface, make_surface

FULL_SIZE_COST: Final = "full_size_cost"
"""Key of the details that holds what a narrowed network costs at full width and size."""

BOP: Final = "bop"
"""Key of the details that holds BOP's scores."""

_DECIMALS: Final = 6
"""Of pixels and metres: machines differ in the last digits of what they compute."""

_REFINED: Final = "refined"
"""Key of a record that holds that of the same poses refined."""


@dataclass
class Report:
    """One method's result on one test set, whose fingerprint is empty where that is not known.

    ``rows`` are of every object, then their mean, ``references`` the same by reference. By object,
    ``errors`` are the ADD, metres, and ``rotation_deg`` the rotation error of every instance,
    infinite where missed; ``diameters`` are metres. ``details`` are further plain facts,
    ``refined`` is the result of the same poses refined, where they were.
    """

    name: str
    rows: dict[str, PoseRow]
    references: dict[str, dict[str, PoseRow]]
    errors: dict[str, Float[np.ndarray, "instances"]]
    cost: Cost
    num_images: int
    details: dict[str, Any] = field(default_factory=dict)
    rotation_deg: dict[str, Float[np.ndarray, "instances"]] = field(default_factory=dict)
    diameters: dict[str, float] = field(default_factory=dict)
    test_set: str = ""
    refined: Report | None = None

    @property
    def mean(self) -> PoseRow:
        """The mean over objects."""
        return self.rows[MEAN]

    @property
    def tables(self) -> dict[str, list[PoseRow]]:
        """Of every object, and the mean of several, the row and the reference rows beside it."""
        return {
            name: [row, *(rows[name] for rows in self.references.values())]
            for name, row in shown_rows(self.rows).items()
        }

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
            "add": _listed(self.errors),
            "rotation_deg": _listed(self.rotation_deg),
            "diameters": self.diameters,
            "test_set": self.test_set,
            "cost": vars(self.cost),
            **({} if self.refined is None else {_REFINED: self.refined.to_record()}),
            **self.details,
        }

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Report:
        """Read ``metrics.json`` back; files of earlier versions lack the optional fields."""
        report = cls(
            name=record["name"],
            rows={name: PoseRow(**row) for name, row in record["objects"].items()},
            references={
                reference: {name: PoseRow(**row) for name, row in rows.items()}
                for reference, rows in record["references"].items()
            },
            errors=_unlisted(record["add"]),
            cost=Cost(**record["cost"]),
            num_images=record["num_images"],
            rotation_deg=_unlisted(record.get("rotation_deg", {})),
            diameters=dict(record.get("diameters", {})),
            test_set=record.get("test_set", ""),
            refined=cls.from_record(record[_REFINED]) if _REFINED in record else None,
        )
        known = report.to_record()
        report.details = {key: value for key, value in record.items() if key not in known}
        return report

    @classmethod
    def joined(cls, reports: Sequence[Report]) -> Report:
        """Return the results of networks that differ in nothing but their parts as one method's."""
        reports = sorted(reports, key=lambda report: list(report.rows))
        first = reports[0]
        known = [time for report in reports if (time := report.cost.ms_per_frame) is not None]
        refined = [report.refined for report in reports if report.refined is not None]
        return replace(
            first,
            rows=_joined_rows([report.rows for report in reports]),
            references={
                reference: _joined_rows([report.references[reference] for report in reports])
                for reference in first.references
            },
            errors={name: e for report in reports for name, e in report.errors.items()},
            cost=replace(first.cost, ms_per_frame=statistics.mean(known) if known else None),
            num_images=sum(report.num_images for report in reports),
            rotation_deg={name: e for one in reports for name, e in one.rotation_deg.items()},
            diameters={name: d for report in reports for name, d in report.diameters.items()},
            test_set=" ".join(report.test_set for report in reports),
            refined=cls.joined(refined) if len(refined) == len(reports) else None,
        )


def _joined_rows(groups: Sequence[Mapping[str, PoseRow]]) -> dict[str, PoseRow]:
    """Put the rows of several tables into one and average them anew."""
    rows = {name: row for group in groups for name, row in group.items() if name != MEAN}
    return {**rows, MEAN: mean_row(list(rows.values()), groups[0][MEAN].method)}


def _listed(errors: Mapping[str, Float[np.ndarray, "instances"]]) -> dict[str, list[float | None]]:
    """Return errors as JSON has them, null where missed."""
    return {
        name: [float(error) if np.isfinite(error) else None for error in values]
        for name, values in errors.items()
    }


def _unlisted(
    record: Mapping[str, Sequence[float | None]],
) -> dict[str, Float[np.ndarray, "instances"]]:
    """Undo :func:`_listed`."""
    return {
        name: np.array([np.inf if error is None else error for error in values], np.float64)
        for name, values in record.items()
    }


@dataclass
class Measured:
    """What came out of measuring methods: a report each, and pictures of the first images.

    ``poses`` is every pose of each method, ``metrics`` the accumulator of each; ``silent`` are the
    numbers of the images with instances on which each found nothing, ``bop`` BOP's scores of each
    where they were asked for and there are targets.
    """

    reports: list[Report]
    tiles: list[Tile]
    poses: dict[str, list[MeasuredPose]]
    metrics: dict[str, PoseMetrics]
    silent: dict[str, list[int]]
    bop: dict[str, BopScores] = field(default_factory=dict)


def measure(
    methods: Mapping[str, Method],
    samples: Iterable[Sample],
    num_pictures: int = 12,
    *,
    bop: bool = False,
) -> Measured:
    """Run methods, the baseline first where there is one, over the same images at native size.

    ``bop`` asks for BOP's scores as well.

    Returns a report per method, and pictures with the truth in green, the last method's predictions
    in yellow and those of the methods before it in blue (paper Fig. 14).
    """
    metrics = accumulators(methods)
    seconds: dict[str, list[float]] = {name: [] for name in methods}
    poses_of: dict[str, list[MeasuredPose]] = {name: [] for name in methods}
    measured = Measured([], [], poses_of, metrics, {name: [] for name in methods})
    draw = DepthDrawer().draw
    localised = {name: Localisation(one.parts, draw) for name, one in methods.items() if bop}
    num_images = 0
    parts = {part.name: part for method in methods.values() for part in method.parts}
    seen = Fingerprint(list(parts.values()))
    for index, sample in enumerate(samples):
        num_images += 1
        seen.add(sample)
        image = image_id(sample, index)
        wireframes = [Wireframe(one.keypoints, GREEN, "true") for one in sample.instances]
        for number, (name, method) in enumerate(methods.items()):
            poses, taken = method.detect(sample, image)
            seconds[name] += [] if taken is None else [taken]
            metrics[name].update(poses, sample.instances, sample.K, sample.size[0])
            if bop:
                localised[name].update(poses, sample.instances, sample.K, sample.size, sample.depth)
            if sample.instances and not poses:
                measured.silent[name].append(index)
            measured.poses[name] += [MeasuredPose(image, one, taken) for one in poses]
            colour = BLUE if number < len(methods) - 1 else YELLOW
            wireframes += [Wireframe(one.keypoints, colour, name) for one in poses]
        if len(measured.tiles) < num_pictures:
            measured.tiles.append(Tile(overlay(sample.image, wireframes), sample.key))
    scores = {name: one.scores() for name, one in localised.items()}
    measured.bop = {name: one for name, one in scores.items() if one is not None}
    measured.reports = [
        Report(
            name,
            metrics[name].compute(),
            metrics[name].references(),
            {part.name: metrics[name].errors(part.name) for part in method.parts},
            method.cost(seconds[name]),
            num_images,
            rotation_deg={
                part.name: metrics[name].errors(part.name, "rotation_deg") for part in method.parts
            },
            diameters={part.name: float(part.diameter) for part in method.parts},
            test_set=seen.word(),
            details={BOP: measured.bop[name].to_record()} if name in measured.bop else {},
        )
        for name, method in methods.items()
    ]
    return measured


class Fingerprint:
    """A hash over a test set: its objects, and every image's name, camera and truth, in order.

    The pixels are not in it, because they may differ in a bit from machine to machine; the name of
    the source tells renderers apart, and the covered share shaded images.
    """

    def __init__(self, parts: Parts) -> None:
        self._hash = hashlib.sha256()
        self._add(sorted((part.name, part.mesh_hash) for part in parts))

    def add(self, sample: Sample) -> None:
        """Take the next image."""
        truths = []
        for one in sample.instances:
            counts = bool(one.visible_fraction >= MIN_VISIBLE_FRACTION)
            covered = round(one.masked_fraction, 2)
            truths.append([one.label, _rounded(one.T_cam_obj), counts, covered])
        self._add([sample.source, sample.key, sample.size, _rounded(sample.K), truths])

    def word(self) -> str:
        """Return the hash of what was taken so far."""
        return self._hash.hexdigest()

    def _add(self, facts: object) -> None:
        self._hash.update(json.dumps(facts).encode() + b"\n")


def _rounded(values: Float[np.ndarray, "rows columns"]) -> list[float]:
    """Return rounded numbers, of which none is a negative zero."""
    return [float(value) + 0.0 for value in np.round(values, _DECIMALS).ravel()]


class DepthDrawer:
    """Draws the depth of parts alone; each part's mesh is prepared once."""

    def __init__(self) -> None:
        self._surfaces: dict[str, Surface] = {}

    def draw(self, part: Part, T_cam_obj: Transform, K: CameraMatrix, size: Size) -> DepthMap:
        """Return metres along z at pixel centres, 0 beside the part."""
        assert part.mesh is not None
        if part.name not in self._surfaces:
            self._surfaces[part.name] = make_surface(part.mesh)
        item = SceneObject(self._surfaces[part.name], T_cam_obj, part=part)
        inverse, _ = draw_alone(item, project_object(item, K).hom, (0, 0, *size))
        depth = np.zeros_like(inverse)
        np.divide(1, inverse, out=depth, where=inverse > 0)
        return depth


def accumulators(methods: Mapping[str, Method]) -> dict[str, PoseMetrics]:
    """Return what scores each method's poses on its parts."""
    # One process measures alone: after a distributed training the others have ended.
    return {
        name: PoseMetrics(method.parts, name, sync_on_compute=False)
        for name, method in methods.items()
    }


def full_size_cost(spec: Mapping[str, Any], input_size: tuple[int, int]) -> Cost:
    """Measure the untrained network of a spec at width 1: what narrowing has saved.

    The input is (width, height), pixels (the paper's is 416×416). Of three timed forward passes
    after one that is not, the median counts.
    """
    widened = {
        key: {**node, "width": 1.0} if isinstance(node, Mapping) and "width" in node else node
        for key, node in spec.items()
    }
    network = build_network(widened).eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    images = torch.zeros(1, 3, input_size[1], input_size[0], dtype=torch.uint8)
    times = []
    with torch.inference_mode():
        for _ in range(4):
            start = time.perf_counter()
            network.maps(images)
            times.append(1000 * (time.perf_counter() - start))
    return Cost(*network_cost(network, input_size), statistics.median(times[1:]))
