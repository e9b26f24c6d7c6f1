"""Comparison of an estimator's candidates with the ground truth of a set of images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np
import torch
from jaxtyping import Bool, Float

from dopepp.data.sample import Instance, Sample, SampleSource
from dopepp.experiment.assembly.negative_frames import LOOKALIKES
from dopepp.inference.estimator import PoseEstimator
from dopepp.metrics.functional import add, add_s, average_precision, expected_calibration_error
from dopepp.metrics.pose import assign, is_evaluated
from dopepp.metrics.row import symmetry_transforms
from dopepp.parts.part import Part, Parts
from dopepp.recovery.detection import (
    FEATURES,
    PASSING,
    REFINED_FEATURES,
    Detection,
    detection_features,
    refined_features,
)

Match = tuple[Detection, Float[np.ndarray, "equivalents 4 4"]]
"""A candidate, and the pose of its instance under every symmetry of the part."""


@dataclass(frozen=True)
class ScoredDetections:
    """Detections of an estimator on a set of images, compared with the ground truth."""

    features: Float[np.ndarray, "n features"]  # FEATURES or REFINED_FEATURES of each detection
    scores: Float[np.ndarray, "n"]  # scores with the estimator's present options
    correct: Bool[np.ndarray, "n"]  # whether ADD(-S) is below a tenth of the diameter
    image: np.ndarray  # (n,) index of each detection's image
    kinds: Sequence[str]  # source of each image
    num_instances: int  # evaluated instances on all images

    @property
    def num_images(self) -> int:
        """Number of images."""
        return len(self.kinds)

    def shows_lookalikes(self) -> Bool[np.ndarray, "images"]:
        """Return which images show objects that resemble the parts."""
        return np.array([kind == LOOKALIKES for kind in self.kinds], bool)

    def best_scores(self, scores: Float[np.ndarray, "n"]) -> Float[np.ndarray, "images"]:
        """Return each image's highest score, from a score per detection; 0 without a detection."""
        best = np.zeros(self.num_images)
        np.maximum.at(best, self.image, scores)
        return best

    def average_precision(self, scores: Float[np.ndarray, "n"]) -> float:
        """Return the average precision of the detections ranked by ``scores``."""
        ranked = torch.from_numpy(scores), torch.from_numpy(self.correct)
        return average_precision(*ranked, self.num_instances)


@dataclass(frozen=True)
class DetectionQuality:
    """Quality of an estimator's scores, and of its reported poses, on test images."""

    calibration_error: float  # expected calibration error of the scores
    false_positive_rate: float  # share of the images without objects on which a pose is reported
    lookalike_rate: float  # share of the images with look-alikes on which a pose is reported
    recall: float  # share of the instances with a correct reported pose
    precision: float  # share of the reported poses that are correct


def measure_quality(
    estimator: PoseEstimator, parts: Parts, shown: SampleSource, empty: SampleSource
) -> DetectionQuality:
    """Measure calibration, recall and precision on ``shown``, and false positives on ``empty``."""
    test, without = (score_images(estimator, parts, source) for source in (shown, empty))
    scores, correct = torch.from_numpy(test.scores), torch.from_numpy(test.correct)
    reported = test.scores >= estimator.min_score
    right = float((test.correct & reported).sum())
    loud = without.best_scores(np.where(without.scores >= estimator.min_score, 1.0, 0.0))
    alike = without.shows_lookalikes()
    unrelated, lookalike = (
        float(loud[kind].sum()) / max(kind.sum(), 1) for kind in (~alike, alike)
    )
    return DetectionQuality(
        expected_calibration_error(scores, correct),
        unrelated,
        lookalike,
        recall=right / max(test.num_instances, 1),
        precision=right / max(int(reported.sum()), 1),
    )


def score_images(estimator: PoseEstimator, parts: Parts, source: SampleSource) -> ScoredDetections:
    """Run an estimator on all images, and compare every candidate with the ground truth."""
    refined = estimator.refiner is not None and estimator.refiner.verifies
    names = REFINED_FEATURES if refined else FEATURES
    rows: list[tuple[np.ndarray, float, bool, int]] = []
    num_instances, kinds = 0, {}
    for number, sample, part, detections, true in _by_object(estimator, parts, source):
        kinds[number] = sample.source
        num_instances += sum(map(is_evaluated, true))
        right, judged = _judge(part, detections, true)
        for detection, is_right in zip(compress(detections, judged), right[judged], strict=True):
            if refined:
                features = refined_features(detection)
            else:
                features = detection_features(detection, part.cuboid, sample.K)
            rows.append((features, detection.score, bool(is_right), number))
    table, scores, correct, images = zip(*rows, strict=True) if rows else ((), (), (), ())
    return ScoredDetections(
        np.reshape(table, (-1, len(names))),
        np.array(scores, np.float64),
        np.array(correct, bool),
        np.array(images, np.int64),
        list(kinds.values()),
        num_instances,
    )


def matched_poses(
    estimator: PoseEstimator, parts: Parts, source: SampleSource, *, only_right: bool = False
) -> list[Match]:
    """Match candidates with instances by :func:`~dopepp.metrics.pose.assign`.

    ``only_right`` leaves out poses with ADD(-S) above a tenth of the diameter.
    """
    matches = []
    for _, _, part, detections, instances in _by_object(estimator, parts, source):
        group = symmetry_transforms(part).numpy()
        numbers = assign(part, detections, instances)
        chosen = np.ones(len(detections), bool)
        if only_right:
            chosen, _ = _judge(part, detections, instances)
        for detection, number, is_chosen in zip(detections, numbers, chosen, strict=True):
            if number >= 0 and is_evaluated(instances[number]) and is_chosen:
                matches.append((detection, instances[number].T_cam_obj @ group))
    return matches


def _by_object(
    estimator: PoseEstimator, parts: Parts, source: SampleSource
) -> Iterator[tuple[int, Sample, Part, list[Detection], list[Instance]]]:
    """Yield image number, sample, part, candidates and instances for every image and part."""
    for number in range(len(source)):
        sample = source.sample(number)
        detections = estimator.candidates(sample.image, sample.K, cropped=True)
        for part in parts:
            of_part = [detection for detection in detections if detection.object == part.name]
            true = [instance for instance in sample.instances if instance.label == part.name]
            yield number, sample, part, of_part, true


def _judge(
    part: Part, detections: Sequence[Detection], true: Sequence[Instance]
) -> tuple[Bool[np.ndarray, "found"], Bool[np.ndarray, "found"]]:
    """Return which detections are correct (ADD(-S) below 0.1 d), and which are evaluated."""
    # As in every evaluation, detections of heavily occluded instances do not count.
    numbers = assign(part, detections, true)
    counts = np.array([number < 0 or is_evaluated(true[number]) for number in numbers], bool)
    matched = np.flatnonzero(counts & (numbers >= 0)).tolist()
    right = np.zeros(len(detections), bool)
    if matched:
        T_est = torch.from_numpy(np.array([detections[k].T_cam_obj for k in matched]))
        T_gt = torch.from_numpy(np.array([true[numbers[k]].T_cam_obj for k in matched]))
        points = torch.from_numpy(np.asarray(part.points, np.float64))
        error = add_s if len(symmetry_transforms(part)) > 1 else add
        errors = error(T_est[:, :3, :3], T_est[:, :3, 3], T_gt[:, :3, :3], T_gt[:, :3, 3], points)
        right[matched] = (errors < PASSING * part.diameter).numpy()
    return right, counts
