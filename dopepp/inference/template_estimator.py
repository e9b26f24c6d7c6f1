"""Estimator without a network: its start poses come from templates of a mesh.

The steps after the start poses are the same as in :class:`PoseEstimator`: refinement, verification
and score.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final, Literal

import numpy as np
import torch
from scipy.ndimage import maximum_filter

from dopepp.core.errors import UserError
from dopepp.core.pool import map_in_threads
from dopepp.core.validation import Range, check
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix, step_between
from dopepp.geometry.rotation import rotation_angle
from dopepp.inference.estimator import PoseEstimator, SeenMaps
from dopepp.inference.input_image import METRES, Depth, Distances, Region, check_region
from dopepp.inference.network_input import are_same, merge_scales
from dopepp.inference.refinement.refiner import Refine, refine_terms
from dopepp.inference.refinement.verification import MIN_DIFFERENCE, Verifier
from dopepp.inference.templates.background_level import background_log_odds
from dopepp.inference.templates.detector import TemplateDetector, distinct_poses
from dopepp.inference.templates.ranking import learned_ranking
from dopepp.parts.catalogue import load_part
from dopepp.parts.part import Part, check_name
from dopepp.parts.symmetry_finder import cached_symmetries
from dopepp.recovery.detection import (
    Detection,
    RecoveryOptions,
    log_odds,
    recalibrate,
    to_probability,
)
from dopepp.recovery.reasons import Reason

NUM_REFINED: Final = 20  # number of start poses of each part that are refined
NUM_REPEATED: Final = 6  # number of distinct poses that are refined again, the most probable
REPEATS: Final = 2  # number of further refinements
MAX_DIFFERENCE: Final = 2.0  # difference of log odds below which look-alikes are compared
NEIGHBOURS: Final = 7  # number of adjacent turns, of which the one with the best response counts
MIN_TURN: Final = math.radians(45.0)  # smallest rotation between the poses of look-alikes

# Limits of the working distance, diameters. A nearer part surrounds the camera. A farther part is
# too small at any usual focal length.
MIN_DIAMETERS: Final = 0.5
MAX_DIAMETERS: Final = 300.0

SCALE_ERROR: Final = 0.001
"""Default of ``scale_error``. It is small, so that refinement corrects the distance, because
templates determine the distance only roughly."""

RefineOnce = Callable[[Sequence[Detection]], list[Detection]]
"""Returns detections after a single refinement on the image."""


class TemplateEstimator(PoseEstimator):
    """Estimates the poses of parts from their meshes alone.

    Args:
        detectors: A detector for each part.
        distances: Nearest and farthest depth of the parts, metres.
        refine: See :class:`PoseEstimator`; must include ``region``.
        max_ms: See :class:`PoseEstimator`.
        scale_error: See :class:`PoseEstimator` (default: 0.001).

    Raises:
        UserError: The refinement is unknown or does not include ``region``.
    """

    def __init__(
        self,
        detectors: Sequence[TemplateDetector],
        distances: tuple[float, float],
        refine: Refine = "region",
        max_ms: float | None = None,
        scale_error: float | None = None,
    ) -> None:
        self.detectors, self.distances = tuple(detectors), distances
        self._detector_of = {detector.part.name: detector for detector in detectors}
        self.levels: dict[str, float] = {}
        """Log odds of ``Detection.probability`` at which a pose has the score 0.5, by part name."""
        recovery, cpu = RecoveryOptions.of(learned_ranking().score), torch.device("cpu")
        scale_error = SCALE_ERROR if scale_error is None else scale_error
        super().__init__(recovery, cpu, refine, self.parts, max_ms, scale_error)

    @classmethod
    def of_parts(
        cls,
        parts: Sequence[Part],
        distances: tuple[float, float] | None,
        tilt_deg: float = 180.0,
        refine: Refine = "region",
        max_ms: float | None = None,
        scale_error: float | None = None,
    ) -> TemplateEstimator:
        """Make an estimator of several parts; see :meth:`PoseEstimator.from_mesh`.

        Raises:
            UserError: A part has no mesh, or an option is invalid or missing.
        """
        if distances is None:
            raise UserError(
                "a mesh without a working distance",
                "the nearest and farthest distance of the part from the camera, metres",
                "state it: --working-distance 0.3,0.5 (working_distance=(0.3, 0.5) in Python)",
            )
        checked = check("working_distance", distances, tuple[float, float], METRES)
        for part in parts:
            _check_size(part, checked)
        tilt = check("tilt_deg", tilt_deg, float, Range(0, 180, "degrees"))
        detectors = [TemplateDetector(part, checked, tilt) for part in parts]
        estimator = cls(detectors, checked, refine, max_ms, scale_error)
        for detector in detectors:
            measure = partial(_largest_log_odds, detector, checked)
            level = background_log_odds(detector.part, checked, tilt, measure)
            estimator.levels[detector.part.name] = level
        return estimator

    def _refine_by(self, refine: Refine | None, parts: Sequence[Part]) -> None:
        """Set the refinement, which must include ``region``."""
        if "region" not in refine_terms(refine):
            fix = "leave out refine, or set it to one of these"
            raise UserError(f"templates with refine={refine}", "region, or region and depth", fix)
        super()._refine_by(refine, parts)

    @property
    def parts(self) -> Sequence[Part]:
        """Detected parts."""
        return tuple(detector.part for detector in self.detectors)

    def depth_range(self, name: str) -> tuple[float, float] | None:
        """Return the working distance, metres."""
        return self.distances

    @property
    def _detector(self) -> str:
        return "templates of meshes"

    def start_detections(
        self,
        image: RGBImage,
        K: CameraMatrix,
        distances: Distances | None,
        roi: Region | None,
        reasons: list[Reason] | None = None,
    ) -> tuple[list[Detection], list[SeenMaps]]:
        """Return start poses of all parts, best score first, and no maps."""
        with self.timed("decode"):
            roi, depths = check_region(roi, image), self._range(distances)
            starts = [
                start
                for detector in self.detectors
                for start in detector.detect(image, K, depths, roi)
            ]
        if reasons is not None:
            text = f"no view of the part fits the image at {depths[0]:.2g} – {depths[1]:.2g} m"
            detected = {start.object for start in starts}
            names = [part.name for part in self.parts if part.name not in detected]
            reasons += [Reason(name, "empty", 0.0, text) for name in names]
        return sorted(starts, key=lambda detection: -detection.score), []

    def refined(
        self,
        detections: Sequence[Detection],
        image: RGBImage,
        K: CameraMatrix,
        depth: Depth | None = None,
        followed: bool = False,
    ) -> list[Detection]:
        """Refine detections; the most probable results are refined again.

        Of each part's start poses, only those with the best scores and those whose outlines fit
        best after the coarse round are refined. Start poses are so inaccurate that a single
        refinement may stop too early. Half turns often have nearly the same outline, so the best
        pose is also refined after half turns. A nearly round part is turned about its axis. Tracked
        poses are refined only once. Under a time limit, all poses are refined once, until the time
        is spent.
        """
        if followed:
            return super().refined(detections, image, K, depth, followed)
        refine = partial(self._refined_once, image=image, K=K, depth=depth)
        if self.max_ms is not None:
            return refine(detections)
        ends: list[Detection] = []
        for detector in self.detectors:
            again = partial(_refined_again, detector, K=K, refine=refine)
            starts = [start for start in detections if start.object == detector.part.name]
            poses = refine(self._most_promising(starts, image, K))
            poses.sort(key=_probability, reverse=True)
            chosen = distinct_poses([pose.T_cam_obj for pose in poses], detector.part)
            group = [poses[number] for number in chosen]
            if not group:
                continue
            group[:NUM_REPEATED] = map(again, group[:NUM_REPEATED])
            best = max(group, key=_probability)
            turned = detector.half_turned(best.T_cam_obj)
            starts = [detector.start(T_cam_obj, best.score, K) for T_cam_obj in turned]
            group += map(again, refine(starts))
            turn = partial(self._in_best_turn, image=image, K=K, refine=refine)
            least = self.levels.get(detector.part.name, 0.0)  # score 0.5
            found: list[Detection] = []  # best first
            for end in self._without_look_alikes(group, image, K):
                if not any(are_same(end, better) for better in found):
                    is_probable = log_odds(_probability(end)) > least
                    found.append(turn(end) if is_probable else end)
            ends += found
        return ends

    def _refined_once(
        self,
        detections: Sequence[Detection],
        image: RGBImage,
        K: CameraMatrix,
        depth: Depth | None,
    ) -> list[Detection]:
        """Refine detections, and lower the probabilities of poses with small silhouettes.

        Small silhouettes resemble many objects: a plate seen edge-on fits every stick, and a part
        that is cut off by the border of the image fits many corners.
        """
        ends = super().refined(detections, image, K, depth)
        areas = [self._detector_of[end.object].silhouette(end.T_cam_obj, image, K) for end in ends]
        return [
            replace(end, probability=to_probability(log_odds(_probability(end)) + math.log(area)))
            for end, area in zip(ends, areas, strict=True)
        ]

    def _most_promising(
        self, starts: list[Detection], image: RGBImage, K: CameraMatrix
    ) -> list[Detection]:
        """Return the start poses with the best scores or outlines, both in equal numbers.

        Scores rank poses in clutter better, outlines rank poses in plain surroundings better.
        """
        if len(starts) <= NUM_REFINED:
            return starts
        assert self.refiner is not None  # templates are always refined
        with self.timed("refine"):
            fits = map_in_threads(partial(self.refiner.coarse_fit, image=image, K=K), starts)
        by_score = np.argsort([-start.score for start in starts], kind="stable")
        by_fit = np.argsort(-np.array(fits), kind="stable")
        order = dict.fromkeys(np.column_stack([by_score, by_fit]).ravel().tolist())
        return [starts[index] for index in list(order)[:NUM_REFINED]]

    def _without_look_alikes(
        self, ends: list[Detection], image: RGBImage, K: CameraMatrix
    ) -> list[Detection]:
        """Remove poses of the best pose's instance, except the one whose distinctive lines fit.

        Poses are compared if they belong to one instance, and have similar probabilities and very
        different rotations, e.g. half turns. See :meth:`Verifier.margins`.
        """
        ends = sorted(ends, key=_probability, reverse=True)
        best, least = ends[0], log_odds(_probability(ends[0])) - MAX_DIFFERENCE
        same = [end for end in ends if are_same(end, best)]
        others = [end for end in ends if not are_same(end, best)]
        for end in same:
            turn = rotation_angle(end.T_cam_obj[:3, :3].T @ best.T_cam_obj[:3, :3])
            is_close = log_odds(_probability(end)) > least and turn > MIN_TURN
            if is_close:
                poses = [end.T_cam_obj, best.T_cam_obj]
                margin = self._verifier(best).margins(image, K, poses)[0, 1]
                best = end if margin > MIN_DIFFERENCE else best
        return [best, *others]

    def _in_best_turn(
        self, end: Detection, image: RGBImage, K: CameraMatrix, refine: RefineOnce
    ) -> Detection:
        """Turn a nearly round part about its axis so that its distinguishing lines fit.

        Turns at which the lines fit as well enlarge the covariance. See
        :func:`~dopepp.inference.templates.turns.nearly_round_turns`.
        """
        detector, verifier = self._detector_of[end.object], self._verifier(end)
        poses = [end.T_cam_obj]
        with self.timed("refine"):
            turned = detector.turned(end.T_cam_obj)
            responses = [verifier.responses(image, K, ring) for ring in turned]
            for ring, values in zip(turned, responses, strict=True):
                is_peak = values >= maximum_filter(values, NEIGHBOURS, mode="wrap")
                is_peak &= values > max(map(np.max, responses)) - MIN_DIFFERENCE / 2
                best_turns = [ring[index] for index in np.flatnonzero(is_peak)]
                poses += [turn for turn in best_turns if not np.allclose(turn, end.T_cam_obj)]
            if len(poses) == 1:
                return end
            margins = verifier.margins(image, K, poses)
        np.fill_diagonal(margins, math.inf)
        chosen = int(margins.min(axis=1).argmax())
        if chosen > 0:
            start = detector.start(poses[chosen], end.score, K)
            (new,) = refine([replace(start, covariance=end.covariance)])
            end = replace(new, kept="")  # the pose was refined before the turn
        rivals = [poses[index] for index in np.flatnonzero(margins[chosen] < MIN_DIFFERENCE)]
        steps = np.array([step_between(end.T_cam_obj, rival) for rival in rivals]).reshape(-1, 6)
        return replace(end, covariance=end.covariance + steps.T @ steps / (len(steps) + 1))

    def _verifier(self, detection: Detection) -> Verifier:
        """Return the verifier of a detection's part."""
        assert self.refiner is not None  # templates are always refined
        return self.refiner.verifier(detection.object)

    def _recalibrated(self, refined: Sequence[Detection], by_depth: bool) -> list[Detection]:
        """Return the best refined detection of each instance, best first."""
        slope, scored = self.recovery.refined_verification, []
        for detection in refined:
            bias = -slope * self.levels.get(detection.object, 0.0)
            options = replace(self.recovery, refined_bias=bias)
            scored += recalibrate([detection], options, by_depth)
        return merge_scales([[detection] for detection in scored])

    def _range(self, distances: Distances | None) -> tuple[float, float]:
        """Return the depths to search: ``distances`` or, by default, the working distance."""
        if distances is None or distances == "any":
            return self.distances
        return check("distances", distances, tuple[float, float], METRES)


def _refined_again(
    detector: TemplateDetector, end: Detection, K: CameraMatrix, refine: RefineOnce
) -> Detection:
    """Refine a pose again while its probability increases, at most ``REPEATS`` times."""
    for _ in range(REPEATS):
        (new,) = refine([detector.start(end.T_cam_obj, end.score, K)])
        if new.kept or _probability(new) <= _probability(end):
            break
        end = new
    return end


def _check_size(part: Part, distances: tuple[float, float]) -> None:
    """Check that the unit of the mesh and that of the distances can both be correct.

    Raises:
        UserError: The distances are below or above the plausible multiples of the diameter.
    """
    nearest, farthest = (distance / part.diameter for distance in distances)
    if nearest > MAX_DIAMETERS or farthest < MIN_DIAMETERS:
        raise UserError(
            f"working_distance from {distances[0]:g} to {distances[1]:g} m and {part.name} of "
            f"{part.diameter:.3g} m",
            f"{MIN_DIAMETERS:g} to {MAX_DIAMETERS:g} diameters of the part",
            "state the distances in metres, and check the unit of the mesh",
        )


def _probability(detection: Detection) -> float:
    """Return the probability of a detection; 0 if it is not verified."""
    return detection.probability or 0.0


def _largest_log_odds(
    detector: TemplateDetector,
    distances: tuple[float, float],
    images: Iterable[RGBImage],
    K: CameraMatrix,
) -> list[float]:
    """Return the largest log odds of ``Detection.probability`` on each image.

    The searched depths are limited to a ratio of 4 around the geometric mean of ``distances``.
    """
    estimator = TemplateEstimator([detector], distances)
    near, far = distances
    middle = math.sqrt(near * far)
    depths = max(near, middle / 2), min(far, 2 * middle)

    def largest(image: RGBImage) -> float:
        ends = estimator.refined(detector.detect(image, K, depths), image, K)
        return max((log_odds(_probability(end)) for end in ends), default=0.0)

    return map_in_threads(largest, list(images))


def load_solid_part(
    mesh: str | Path, unit: str | None, name: str | None, symmetries: Literal["auto"] | None
) -> Part:
    """Load a part and find its symmetries; see :meth:`PoseEstimator.from_mesh`."""
    part = load_part(mesh, unit)
    part = part if name is None else replace(part, name=check_name(name))
    if symmetries is None or part.mesh is None:
        return part
    discrete, continuous = cached_symmetries(part.mesh)
    return replace(part, symmetries_discrete=discrete, symmetries_continuous=continuous)
