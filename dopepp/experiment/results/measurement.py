"""Measure methods on a test set.

A method is an estimator or a file with poses. To measure something else, write a class with the
methods of :class:`Method`.
"""

from __future__ import annotations

import logging
import re
import statistics
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Final, Protocol

import numpy as np
import torch
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.data.formats.bop.bop_models import parts_by_id, read_models
from dopepp.data.formats.bop.bop_results import BopResult, read_results
from dopepp.data.formats.ycb_video import read_classes
from dopepp.data.sample import Sample
from dopepp.drawing.overlay import BLUE, GREEN, YELLOW, Wireframe, overlay
from dopepp.drawing.pictures import DepthMap, Size
from dopepp.drawing.sheet import Tile
from dopepp.experiment.config.data_config import DataConfig
from dopepp.experiment.results.report import Cost, Fingerprint, Report
from dopepp.geometry.camera import CameraMatrix, Transform, project_keypoints
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.network_estimator import NetworkEstimator
from dopepp.inference.runtimes import ExportedNetwork
from dopepp.metrics.localisation import BopScores, Draw, Localisation
from dopepp.metrics.pose import PoseMetrics, PredictedPose
from dopepp.models.network import build_network, network_cost
from dopepp.parts.part import Part, Parts
from dopepp.recovery.reasons import Reason, main_reasons
from dopepp.virtual.renderers.raster.visibility import draw_alone, project_object
from dopepp.virtual.scene import SceneObject
from dopepp.virtual.surface import Surface, make_surface

_log = logging.getLogger(__name__)

ImageId = tuple[int, int]  # BOP's scene_id and im_id

_WARM_UP_FRAMES: Final = 3  # untimed, because they allocate memory and select kernels

_BOP_KEY: Final = re.compile(r"(\d{1,9})[/_](\d{1,9})", re.ASCII)
_NUMBERED_SOURCES: Final = ("bop", "webdataset", "ycb_video")


class ScoredPose(PredictedPose, Protocol):
    """Predicted pose with the projection of its cuboid, which drawings need."""

    @property
    def keypoints(self) -> Float[np.ndarray, "9 2"]:
        """Projected corners and centroid of the cuboid, pixels."""


class Method(Protocol):
    """Source of poses for the images of a test set."""

    parts: Parts  # objects to measure, as defined by the test set
    min_score: float  # smallest score of a reported candidate

    def detect(self, sample: Sample, image: ImageId) -> tuple[Sequence[ScoredPose], float | None]:
        """Return all candidates in an image, and the time in seconds, or None if unknown."""

    def cost(self, seconds: Sequence[float]) -> Cost:
        """Return the cost of the method, given the known seconds of the images in order."""


def reported_candidates(method: Method, candidates: Sequence[ScoredPose]) -> list[ScoredPose]:
    """Return the candidates with a score of at least ``method.min_score``."""
    return [candidate for candidate in candidates if candidate.score >= method.min_score]


class EstimatorMethod:
    """Estimator that runs on images at native size; only objects that it detects are measured."""

    def __init__(self, estimator: PoseEstimator, parts: Parts) -> None:
        names = {part.name for part in estimator.parts}
        self.estimator, self.min_score = estimator, estimator.min_score
        self.parts: Parts = [part for part in parts if part.name in names]
        self._names = {part.name for part in self.parts}

    def detect(self, sample: Sample, image: ImageId) -> tuple[Sequence[ScoredPose], float | None]:
        """Run the estimator and return the candidates of measured objects."""
        start = time.perf_counter()
        candidates = self.estimator.candidates(
            sample.image, sample.K, depth=sample.depth, cropped=True
        )
        seconds = time.perf_counter() - start
        return [candidate for candidate in candidates if candidate.object in self._names], seconds

    def rejection(self, sample: Sample) -> Reason | None:
        """Return why the best candidate in an image without detections was rejected, if any."""
        reasons = main_reasons(
            self.estimator.explain(sample.image, sample.K, sample.depth, cropped=True)
        )
        return next((reason for reason in reversed(reasons) if reason.object in self._names), None)

    def cost(self, seconds: Sequence[float]) -> Cost:
        """Return the number of parameters, the operations and the median time per frame."""
        milliseconds = _median_ms(seconds[_WARM_UP_FRAMES:] or seconds)
        if not isinstance(self.estimator, NetworkEstimator):
            return Cost(ms_per_frame=milliseconds)
        checkpoint, network = self.estimator.checkpoint, self.estimator.network
        if isinstance(network, ExportedNetwork):  # an export has no modules to count
            parameters, gmacs = network.export.parameters, network.export.gmacs
        else:
            with torch.device("meta"):  # the trained layout: the estimator folds batch norm
                trained = build_network(checkpoint.spec)
            parameters, gmacs = network_cost(trained, checkpoint.input_size)
        return Cost(parameters, gmacs, milliseconds)


class ViewsMethod(EstimatorMethod):
    """Estimator that runs on several images of a static scene; poses in the first camera frame."""

    def detect(self, sample: Sample, image: ImageId) -> tuple[Sequence[ScoredPose], float | None]:
        """Run the estimator on all images and return the candidates of measured objects."""
        views = [sample, *sample.others]
        poses = [view.T_world_cam for view in views if view.T_world_cam is not None]
        depths = [view.depth for view in views if view.depth is not None]
        images, cameras = [view.image for view in views], [view.K for view in views]
        start = time.perf_counter()
        result = self.estimator.predict_views(
            images, cameras, poses, depths if len(depths) == len(views) else None
        )
        seconds = time.perf_counter() - start
        # Poses that the views contradict keep their scores, and are not reported.
        weaker = [item for item in result.weaker if item.score < self.min_score]
        candidates = [
            replace(item.evidence[0].detection, score=item.score)
            for item in (*result.detections, *weaker)
            if item.object in self._names and item.evidence[0].status != "outside"
        ]
        return candidates, seconds


@dataclass(frozen=True)
class FilePose:
    """Pose from a file; see :class:`ScoredPose`."""

    object: str
    score: float
    T_cam_obj: Transform
    keypoints: Float[np.ndarray, "9 2"]
    covariance: None = None


class FileMethod:
    """Poses of another program, read from a BOP challenge CSV with BOP's ``numbers`` of objects.

    Poses of other objects than ``parts`` are ignored. All poses with a score of at least 0 count
    as detections.
    """

    min_score = 0.0

    def __init__(self, path: Path, parts: Parts, numbers: Mapping[str, int]) -> None:
        self._path = path
        self.parts: Parts = list(parts)
        self._parts = {numbers[part.name]: part for part in parts}
        self._unused: dict[ImageId, list[BopResult]] = {}
        self._used: dict[ImageId, list[BopResult]] = {}
        for row in read_results(path, numbers.values()):
            self._unused.setdefault((row.scene_id, row.im_id), []).append(row)

    def detect(self, sample: Sample, image: ImageId) -> tuple[Sequence[ScoredPose], float | None]:
        """Return an image's poses, and the largest time of its lines in seconds or None."""
        rows = self._used.setdefault(image, self._unused.pop(image, []))
        poses = []
        for row in rows:
            if (part := self._parts.get(row.obj_id)) is not None:
                keypoints = project_keypoints(part.cuboid, row.T_cam_obj, sample.K)
                poses.append(FilePose(part.name, row.score, row.T_cam_obj, keypoints))
        seconds = max((row.seconds for row in rows), default=-1.0)
        return poses, seconds if seconds >= 0 else None

    def cost(self, seconds: Sequence[float]) -> Cost:
        """Return a cost with the median time per image that the file states."""
        return Cost(ms_per_frame=_median_ms(seconds))

    def check_used(self) -> None:
        """Check, after all images, that poses were used; log how many were not."""
        used = [row for rows in self._used.values() for row in rows]
        unused = [row for rows in self._unused.values() for row in rows]
        if unused and not used:
            raise UserError(
                f"{self._path}, whose {len(unused):,} poses are all on images outside the "
                f"test set, e.g. scene {unused[0].scene_id}, image {unused[0].im_id}",
                f"images of the test set, e.g. scene and image {next(iter(self._used), 'none')}",
                "select the images of the file, e.g. with data.image_sets.test",
            )
        others = sum(row.obj_id not in self._parts for row in used)
        if unused or others:
            _log.warning(
                f"{self._path}: ignoring {len(unused):,} poses on images outside the test set and "
                f"{others:,} poses of other objects"
            )


def object_numbers(data: DataConfig, parts: Parts) -> dict[str, int]:
    """Return BOP's ``obj_id`` of each object, by name.

    Parts of other data sets than BOP and YCB-Video are numbered from 1.
    """
    root = data.root
    if root is not None and data.format in ("bop", "webdataset"):
        numbers = {info.name: number for number, info in read_models(root).items()}
        return numbers or {part.name: number for number, part in parts_by_id(root, parts).items()}
    if root is not None and data.format == "ycb_video":
        return {name: number for number, name in enumerate(read_classes(root), 1)}
    return {part.name: number for number, part in enumerate(parts, 1)}


def image_id(sample: Sample, index: int) -> ImageId:
    """Return the BOP scene and image number of an image, from its key, such as ``000001/000017``.

    Data sets other than BOP and YCB-Video have scene 0 and the index in the test set.
    """
    match = _BOP_KEY.fullmatch(sample.key)
    if match is None or sample.source.partition("/")[0] not in _NUMBERED_SOURCES:
        return 0, index
    return int(match[1]), int(match[2])


def _median_ms(seconds: Sequence[float]) -> float | None:
    return 1000 * statistics.median(seconds) if seconds else None


@dataclass
class Measured:
    """Result of measuring methods on a test set; dictionaries are by method."""

    reports: list[Report]
    tiles: list[Tile]  # drawings of the first images
    poses: dict[str, list[tuple[ImageId, ScoredPose, float | None]]]  # candidates, seconds
    metrics: dict[str, PoseMetrics]
    silent: dict[str, list[int]]  # images with instances in which a method detected nothing
    bop: dict[str, BopScores] = field(default_factory=dict)  # if requested and available


def measure(
    methods: Mapping[str, Method],
    samples: Iterable[Sample],
    num_shown: int = 12,
    *,
    bop: bool = False,
) -> Measured:
    """Run methods (the baseline first) over the same images at their native size.

    AP, BOP scores and files of poses include all candidates; every other measure includes the
    reported poses only. The ``num_shown`` tiles show the ground truth in green, predictions of
    the last method in yellow and predictions of other methods in blue (paper Fig. 14).
    """
    metrics, ranked = accumulators(methods), accumulators(methods)
    seconds: dict[str, list[float]] = {name: [] for name in methods}
    measured = Measured([], [], {name: [] for name in methods}, metrics, {n: [] for n in methods})
    draw = depth_drawer()
    localised = {name: Localisation(method.parts, draw) for name, method in methods.items() if bop}
    num_images = 0
    parts = {part.name: part for method in methods.values() for part in method.parts}
    seen = Fingerprint(list(parts.values()))
    for index, sample in enumerate(samples):
        num_images += 1
        seen.add(sample)
        image = image_id(sample, index)
        wireframes = [Wireframe(instance.keypoints, GREEN, "true") for instance in sample.instances]
        for number, (name, method) in enumerate(methods.items()):
            candidates, taken = method.detect(sample, image)
            poses, truths = reported_candidates(method, candidates), sample.instances
            seconds[name] += [] if taken is None else [taken]
            metrics[name].update(poses, truths, sample.K, sample.size[0])
            ranked[name].update(candidates, truths, sample.K, sample.size[0])
            if bop:
                localised[name].update(candidates, truths, sample.K, sample.size, sample.depth)
            if truths and not poses:
                measured.silent[name].append(index)
            measured.poses[name] += [(image, candidate, taken) for candidate in candidates]
            colour = BLUE if number < len(methods) - 1 else YELLOW
            wireframes += [Wireframe(pose.keypoints, colour, name) for pose in poses]
        if len(measured.tiles) < num_shown:
            measured.tiles.append(Tile(overlay(sample.image, wireframes), sample.key))
    scores = {name: localisation.scores() for name, localisation in localised.items()}
    measured.bop = {name: score for name, score in scores.items() if score is not None}
    for name, method in methods.items():
        reported, candidates_of = metrics[name], ranked[name].compute()
        rows = {
            part: replace(row, average_precision=candidates_of[part].average_precision)
            for part, row in reported.compute().items()
        }
        names = [part.name for part in method.parts]
        report = Report(
            name,
            rows,
            reported.references(),
            {part: reported.errors(part) for part in names},
            method.cost(seconds[name]),
            num_images,
            rotation_deg={part: reported.errors(part, "rotation_deg") for part in names},
            diameters={part.name: float(part.diameter) for part in method.parts},
            test_set=seen.hexdigest(),
            details={"bop": asdict(measured.bop[name])} if name in measured.bop else {},
        )
        measured.reports.append(report)
    return measured


def depth_drawer() -> Draw:
    """Return a function that renders the depth map of a single part in metres; 0 without depth."""
    surfaces: dict[str, Surface] = {}

    def draw(part: Part, T_cam_obj: Transform, K: CameraMatrix, size: Size) -> DepthMap:
        assert part.mesh is not None
        if part.name not in surfaces:
            surfaces[part.name] = make_surface(part.mesh)
        item = SceneObject(surfaces[part.name], T_cam_obj, part=part)
        inverse, _ = draw_alone(item, project_object(item, K).hom, (0, 0, *size))
        depth = np.zeros_like(inverse)
        np.divide(1, inverse, out=depth, where=inverse > 0)
        return depth

    return draw


def accumulators(methods: Mapping[str, Method]) -> dict[str, PoseMetrics]:
    """Return an empty accumulator of pose metrics for each method, by name."""
    # Only one process measures: after a distributed training the other processes have ended.
    return {
        name: PoseMetrics(method.parts, name, sync_on_compute=False)
        for name, method in methods.items()
    }
