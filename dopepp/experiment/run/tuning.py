"""Tune the factors, scores and thresholds of a checkpoint on validation images.

- Distance factor: median ratio of true to estimated distances.
- Covariance factors: make the covariances match the errors of correct poses. Network poses and
  refined poses have separate factors.
- Score: probability that ADD(-S) is below a tenth of the diameter. The score of refined poses is a
  recalibration of the verification.
- Thresholds: the lowest scores with at most the permitted rate of false positives on images
  without the objects.

The old factors are kept if the new ones rank the validation poses worse. The result is measured on
test images and written to a new checkpoint.
"""

from __future__ import annotations

import copy
import hashlib
import logging
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import accumulate, compress
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float

from dopepp.core.errors import UserError
from dopepp.data.sample import Instance, Sample, SampleSource
from dopepp.experiment.assembly.build_sources import held_out_source
from dopepp.experiment.assembly.negative_frames import LOOKALIKES, negative_frames
from dopepp.experiment.config.data_config import DataConfig
from dopepp.experiment.config.run_config import FalsePositiveTarget
from dopepp.geometry.camera import make_transform, project
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.refinement.region.shared_errors import SCALE_ERROR
from dopepp.inference.runtimes import Runtime
from dopepp.metrics.functional import (
    add,
    add_s,
    average_precision,
    expected_calibration_error,
    mahalanobis,
)
from dopepp.metrics.pose import assign, is_evaluated
from dopepp.metrics.row import symmetry_transforms
from dopepp.models.checkpoint import Checkpoint
from dopepp.models.heads import Stage
from dopepp.models.network import Images
from dopepp.models.storage import write_atomic
from dopepp.parts.part import Part, Parts
from dopepp.recovery.detection import (
    FEATURES,
    PASSING,
    PROBABLE,
    REFINED_FEATURES,
    Detection,
    RecoveryOptions,
    detection_features,
    fit_covariance_factor,
    fit_distance_factor,
    fit_weights,
    refined_features,
    score,
)

MIN_REFINED_SCORE: Final = 0.1
"""Lowest threshold of refined poses. Poses that are far more likely incorrect than correct are
never reported, even if the images without the objects permit a lower threshold."""

MIN_REFINED_FACTOR: Final = 0.5
"""Smallest covariance factor of refined poses. Smaller factors fit renders at the network's
input size, and make covariances too small on larger images and on real images."""

MIN_REFINED: Final = 20  # smallest number of correct poses that determine a covariance factor

MAX_INSTANCES: Final = 500
"""Number of instances per part on which tuning fits and measures: heaps need only few images."""

MAX_LOST: Final = 0.01
"""Largest share of correct poses that a threshold above :data:`~.detection.PROBABLE` may reject."""

MAX_PRECISION_LOSS: Final = 0.005  # largest decrease of the average precision with fitted factors

HELD_OUT: Final[tuple[Literal["val"], Literal["test"]]] = ("val", "test")

MAX_BYTES: Final = 2**30
"""Size of the cache, bytes: 1,400 images of 400×400 pixels with the maps of one part."""

_WEIGHTS: Final = ("score_", "refined_")

_log = logging.getLogger(__name__)

Made = TypeVar("Made")


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


@dataclass(frozen=True)
class Tuning:
    """Tuned recovery options, and their effect on test images."""

    options: dict[str, float]  # changed RecoveryOptions
    before: DetectionQuality  # network with the old options, without refinement
    after: DetectionQuality  # estimator with the tuned options
    num_images: tuple[int, int]  # test images with and without objects
    kept: str = ""  # why the old factors were kept; empty if they were replaced


def tune(
    estimator: PoseEstimator, data: DataConfig, parts: Parts, target: FalsePositiveTarget
) -> Tuning:
    """Choose factors, weights and thresholds on validation images and measure them on test images.

    The score of network poses is tuned first, then the score of refined poses.

    Args:
        estimator: Estimator of the checkpoint.
        data: Config of the validation and test images.
        parts: Parts of the checkpoint.
        target: Number of images without objects, and permitted rate of false positives.

    Raises:
        UserError: There are no detections, all detections are correct, all are incorrect, or a
            covariance factor is outside the range of :func:`fit_covariance_factor`.
    """
    old, cache = estimator.recovery, TuningCache()
    estimator = cache.with_cached_maps(estimator)
    count, rate = target.num_empty, target.false_positive_rate
    most = MAX_INSTANCES * len(parts)
    validation, test = (cache.of(held_out_source(data, parts, split), most) for split in HELD_OUT)
    empty, empty_test = (cache.of(negative_frames(data, parts, split, count)) for split in HELD_OUT)
    plain = _without_refinement(estimator)
    _log.info("tuning: measuring on %d test images and %d without objects", len(test), count)
    before = _measured(plain, parts, test, empty_test, old)
    _log.info("tuning: fitting factors and scores on %d validation images", len(validation))
    new, shown, kept = _chosen_factors(estimator, parts, validation, empty, rate, old)
    if estimator.refiner is not None and estimator.refiner.verifies:
        estimator.recovery = _without_thresholds(new)
        _log.info("tuning: fitting the score and covariances of refined poses")
        without = score_images(estimator, parts, empty)
        factor = fit_refined_factor(estimator, parts, WrongFocalLengths(validation))
        new = replace(new, **choose(shown, without, rate, refined=True))  # type: ignore[arg-type]
        new = replace(new, refined_covariance_factor=factor)
    _log.info("tuning: measuring with the new options")
    after = _measured(estimator, parts, test, empty_test, new)
    options = {
        field.name: getattr(new, field.name)
        for field in fields(RecoveryOptions)
        if field.name.endswith(("_factor", "min_score")) or field.name.startswith(_WEIGHTS)
    }
    return Tuning(options, before, after, (len(test), count), kept)


def _chosen_factors(
    estimator: PoseEstimator,
    parts: Parts,
    validation: SampleSource,
    empty: SampleSource,
    rate: float,
    old: RecoveryOptions,
) -> tuple[RecoveryOptions, ScoredDetections, str]:
    """Fit distance and covariance factor, unless they lower AP by over ``MAX_PRECISION_LOSS``.

    AP is measured on the estimator's final poses, because a wrong covariance of the network's poses
    misleads the refinement. The score of network poses is fitted for both.

    Returns:
        Options, the detections with these options on the validation images, and why the old factors
        were kept (an empty string if the factors were replaced).
    """
    plain = _without_refinement(estimator)
    plain.recovery = replace(_without_thresholds(old), distance_factor=1.0, covariance_factor=1.0)
    factors = fit_factors(matched_poses(plain, parts, validation))
    results: list[tuple[RecoveryOptions, ScoredDetections, float]] = []
    for base in (replace(old, **factors), old):  # type: ignore[arg-type]
        plain.recovery = _without_thresholds(base)
        with_objects, without = (
            score_images(plain, parts, source) for source in (validation, empty)
        )
        # Undo former tuning of refined poses: their score is fitted to the untuned verification.
        options = replace(base.unrefined(), **choose(with_objects, without, rate))  # type: ignore[arg-type]
        estimator.recovery = _without_thresholds(options)
        shown = score_images(estimator, parts, validation)
        results.append((options, shown, shown.average_precision(shown.scores)))
    (new, shown_new, fitted), (same, shown_same, former) = results
    if fitted >= former - MAX_PRECISION_LOSS:
        return new, shown_new, ""
    text = ", ".join(f"{name}={value:.3g}" for name, value in factors.items())
    kept = f"AP {former:.3f} on validation images with the old factors, {fitted:.3f} with {text}"
    return same, shown_same, kept


def _without_thresholds(options: RecoveryOptions) -> RecoveryOptions:
    """Return options without thresholds, under which every detection is reported."""
    return replace(options, min_score=0.0, refined_min_score=0.0)


def _measured(
    estimator: PoseEstimator,
    parts: Parts,
    test: SampleSource,
    empty: SampleSource,
    options: RecoveryOptions,
) -> DetectionQuality:
    """Measure the detection quality of an estimator with ``options`` on test images."""
    estimator.recovery = _without_thresholds(options)
    shown, without = (score_images(estimator, parts, source) for source in (test, empty))
    estimator.recovery = options
    return _quality(shown, without, estimator.min_score)


def _without_refinement(estimator: PoseEstimator) -> PoseEstimator:
    """Return a copy of an estimator that does not refine the network's poses."""
    plain = copy.copy(estimator)
    plain.refiner = None
    return plain


def fit_factors(
    pairs: Sequence[tuple[Detection, Float[np.ndarray, "equivalents 4 4"]]],
) -> dict[str, float]:
    """Fit distance and covariance factor to :func:`matched_poses` estimated with factors of 1."""
    estimated = np.reshape([detection.T_cam_obj for detection, _ in pairs], (-1, 4, 4))
    true = np.reshape([equivalents[0] for _, equivalents in pairs], (-1, 4, 4))
    distance = fit_distance_factor(estimated, true)
    covariance = fit_covariance_factor(squared_distances(pairs, distance))
    return {"distance_factor": distance, "covariance_factor": covariance}


class WrongFocalLengths:
    """Images of a source with simulated calibration errors of the camera matrix.

    The relative error of the focal length is uniformly distributed up to the scale error that
    refinement assumes. With exact cameras, covariances would be fitted to errors smaller than those
    of any real camera. The principal point moves too, so that the line of sight to the first object
    is unchanged. The other objects are rotated about the camera onto their lines of sight. The
    error then changes only the objects' distances, like an error of their size.
    """

    def __init__(self, source: SampleSource) -> None:
        self._source, self.name = source, source.name

    def __len__(self) -> int:
        return len(self._source)

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Return an image with an erroneous focal length; ``index`` determines the error."""
        sample = self._source.sample(index, epoch)
        error = np.random.default_rng(index).uniform(-SCALE_ERROR, SCALE_ERROR)
        K = sample.K.copy()
        K[[0, 1], [0, 1]] *= 1.0 + error
        if not sample.instances:
            return replace(sample, K=K)
        centres = np.array([instance.T_cam_obj[:3, 3] for instance in sample.instances])
        pixels = project(centres, sample.K)
        K[:2, 2] -= error * (pixels[0] - sample.K[:2, 2])
        instances = [sample.instances[0]]
        for instance, centre, pixel in zip(
            sample.instances[1:], centres[1:], pixels[1:], strict=True
        ):
            ray = np.linalg.solve(K, [*pixel, 1.0])
            # The angle is so small that it equals its sine.
            turn = np.cross(centre, ray) / (np.linalg.norm(centre) * np.linalg.norm(ray))
            rotation = make_transform(rotation_vector_to_matrix(turn), np.zeros(3))
            instances.append(replace(instance, T_cam_obj=rotation @ instance.T_cam_obj))
        return replace(sample, K=K, instances=instances)


def fit_refined_factor(estimator: PoseEstimator, parts: Parts, source: SampleSource) -> float:
    """Fit the factor on the covariances of refined poses to the errors of correct poses.

    Returns:
        The factor, at least :data:`MIN_REFINED_FACTOR`; 1 if there are fewer than
        :data:`MIN_REFINED` correct poses.

    Raises:
        UserError: The factor is outside the range of :func:`fit_covariance_factor`.
    """
    matches = matched_poses(estimator, parts, source, only_right=True)
    pairs = [match for match in matches if match[0].agreement is not None]
    if len(pairs) < MIN_REFINED:
        text = "covariances of refined poses keep a factor of 1: %d correct poses, fewer than %d"
        _log.warning(text, len(pairs), MIN_REFINED)
        return 1.0
    factor = fit_covariance_factor(squared_distances(pairs), refined=True)
    return max(factor, MIN_REFINED_FACTOR)


def squared_distances(
    pairs: Sequence[tuple[Detection, Float[np.ndarray, "equivalents 4 4"]]],
    distance_factor: float = 1.0,
) -> Float[np.ndarray, "n"]:
    """Return each match's squared Mahalanobis distance, the smallest over symmetric true poses.

    Estimated translations are multiplied by ``distance_factor`` first.
    """
    squared = []
    for detection, equivalents in pairs:
        stated = np.broadcast_to(detection.covariance, (len(equivalents), 6, 6)).copy()
        T_est = np.broadcast_to(detection.T_cam_obj, equivalents.shape).copy()
        T_est[:, :3, 3] *= distance_factor
        poses = T_est[:, :3, :3], T_est[:, :3, 3], equivalents[:, :3, :3], equivalents[:, :3, 3]
        distances = mahalanobis(*map(torch.from_numpy, (*poses, stated)))
        squared.append(float(distances.min()) ** 2)
    return np.array(squared)


def choose(
    shown: ScoredDetections,
    empty: ScoredDetections,
    false_positive_rate: float = FalsePositiveTarget.false_positive_rate,
    *,
    refined: bool = False,
) -> dict[str, float]:
    """Choose the weights and the threshold of a score.

    Detections on look-alikes contribute to the weights, but not to the threshold, which would
    otherwise exclude most poses of the objects.

    Args:
        shown: Detections on images with objects.
        empty: Detections on images without objects.
        false_positive_rate: Permitted share of the images without objects with a reported pose.
        refined: Whether the score of refined poses is chosen. The fewer refined poses there are,
            the closer its weights stay to the default weights, with which the score is
            ``Detection.probability``. The default weights are used if all poses are correct or all
            are incorrect.

    Returns:
        Values of :class:`RecoveryOptions` by field.

    Raises:
        UserError: There are no detections of the network, or all are correct or all are incorrect.
    """
    features = np.concatenate([shown.features, empty.features])
    correct = np.concatenate([shown.correct, empty.correct])
    defaults = np.array(RecoveryOptions().refined_weights) if refined else None
    if correct.any() and not correct.all():
        weights = fit_weights(features, correct, defaults)
    elif defaults is not None:
        weights = defaults
    else:
        kind = "correct" if correct.any() else "incorrect"
        raise UserError(
            f"{len(correct)} validation detections, all of them {kind}"
            if len(correct)
            else "no detection on any validation image",
            "correct and incorrect detections to learn from",
            "train longer, or raise data.num_val and num_empty",
        )
    best = empty.best_scores(score(empty.features, weights))[~empty.shows_lookalikes()]
    best = np.sort(best)[::-1]
    allowed = int(false_positive_rate * len(best))
    # A score equal to the threshold passes, so the threshold exceeds the first rejected score.
    threshold = float(np.nextafter(best[allowed], 1.0)) if allowed < len(best) else 0.0
    names = ["min_score", *(f"score_{feature}" for feature in FEATURES)]
    if refined:
        threshold = _refined_threshold(threshold, shown, weights) if allowed < len(best) else 0.0
        names = [f"refined_{name}" for name in ("min_score", *REFINED_FEATURES)]
    return dict(zip(names, [threshold, *map(float, weights)], strict=True))


def _refined_threshold(
    silent: float, shown: ScoredDetections, weights: Float[np.ndarray, "features"]
) -> float:
    """Return the smallest score of a reported refined pose.

    The threshold for the rate of false positives (``silent``) applies up to :data:`PROBABLE`: poses
    with lower scores are more likely incorrect than correct. Above, the threshold may reject only
    the share :data:`MAX_LOST` of the correct poses, because otherwise a single frame with a high
    score could cost most poses. The threshold is at least :data:`MIN_REFINED_SCORE`.
    """
    correct = score(shown.features, weights)[shown.correct]
    most = max(float(np.quantile(correct, MAX_LOST)), PROBABLE) if len(correct) else 1.0
    if silent > most:
        _log.warning(
            "poses on frames without the objects have scores up to %.2f; the threshold is %.2f, "
            "because a higher threshold would lose over %.0f %% of the correct poses",
            silent,
            most,
            100 * MAX_LOST,
        )
    return max(min(silent, most), MIN_REFINED_SCORE)


def score_images(
    estimator: PoseEstimator, parts: Parts, *sources: SampleSource
) -> ScoredDetections:
    """Run an estimator on all images, and compare every candidate with the ground truth."""
    refined = estimator.refiner is not None and estimator.refiner.verifies
    names = REFINED_FEATURES if refined else FEATURES
    rows: list[tuple[np.ndarray, float, bool, int]] = []
    num_instances, kinds = 0, {}
    for number, sample, part, detections, true in _by_object(estimator, parts, *sources):
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
) -> list[tuple[Detection, Float[np.ndarray, "equivalents 4 4"]]]:
    """Match candidates with instances by :func:`~dopepp.metrics.pose.assign`.

    ``only_right`` leaves out poses with ADD(-S) above a tenth of the diameter.

    Returns:
        Matched candidates, each with its instance's pose under every symmetry of the part.
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
    estimator: PoseEstimator, parts: Parts, *sources: SampleSource
) -> Iterator[tuple[int, Sample, Part, list[Detection], list[Instance]]]:
    """Yield image number, sample, part, candidates and instances for every image and part."""
    images = ((source, index) for source in sources for index in range(len(source)))
    for number, (source, index) in enumerate(images):
        sample = source.sample(index, 0)
        detections = estimator.candidates(sample.image, sample.K, cropped=True)
        for part in parts:
            of_part = [detection for detection in detections if detection.object == part.name]
            true = [instance for instance in sample.instances if instance.label == part.name]
            yield number, sample, part, of_part, true


def write_tuned(checkpoint: Checkpoint, path: Path, options: Mapping[str, float]) -> Path:
    """Write a checkpoint with changed recovery options as ``NAME_tuned.ckpt``; return its path."""
    recovery = replace(RecoveryOptions.of(checkpoint.recovery), **options)  # type: ignore[arg-type]
    tuned = replace(checkpoint, recovery=vars(recovery))
    target = path.with_name(f"{path.stem}_tuned.ckpt")
    write_atomic(tuned.to_file(), target)
    return target


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


def _quality(test: ScoredDetections, empty: ScoredDetections, threshold: float) -> DetectionQuality:
    """Measure calibration, recall and precision on ``test``, and false positives on ``empty``."""
    scores, correct = torch.from_numpy(test.scores), torch.from_numpy(test.correct)
    error = expected_calibration_error(scores, correct)
    loud = empty.best_scores(np.where(empty.scores >= threshold, 1.0, 0.0))
    reported = test.scores >= threshold
    right = float((test.correct & reported).sum())
    recall, precision = right / max(test.num_instances, 1), right / max(int(reported.sum()), 1)
    alike = empty.shows_lookalikes()
    unrelated, lookalike = (
        float(loud[shown].sum()) / max(shown.sum(), 1) for shown in (~alike, alike)
    )
    return DetectionQuality(error, unrelated, lookalike, recall, precision)


class TuningCache:
    """Cache in memory for images and network outputs, which tuning uses several times.

    Args:
        max_bytes: Size of the cache. Items that do not fit are computed each time.
    """

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self._free = max_bytes
        self._items: dict[Hashable, Any] = {}

    def get(self, key: Hashable, make: Callable[[], Made], size: Callable[[Made], int]) -> Made:
        """Return the cached item of a key, or make and cache it; ``size`` returns its bytes."""
        if key in self._items:
            return self._items[key]  # type: ignore[no-any-return]
        item = make()
        if size(item) <= self._free:
            self._free -= size(item)
            self._items[key] = item
        return item

    def of(self, source: SampleSource, max_instances: int | None = None) -> SampleSource:
        """Return a source that caches its items of epoch 0.

        The source ends with the image that reaches ``max_instances`` evaluated instances.
        """
        cached = _CachedSource(source, self, source.name, len(source))
        if max_instances is not None:
            counts = (
                sum(map(is_evaluated, cached.sample(index).instances))
                for index in range(len(source))
            )
            reached = (n for n, total in enumerate(accumulate(counts), 1) if total >= max_instances)
            cached.length = next(reached, len(source))
        return cached

    def with_cached_maps(self, estimator: PoseEstimator) -> PoseEstimator:
        """Return a copy of an estimator that caches the network's maps of each input."""
        network, cached = estimator.network, copy.copy(estimator)
        cached.network = _CachedNetwork(network, self, network.stride, network.size_multiple)
        return cached


@dataclass
class _CachedSource:
    """The first ``length`` items of a source, of which items of epoch 0 are cached."""

    source: SampleSource
    cache: TuningCache
    name: str
    length: int

    def __len__(self) -> int:
        return self.length

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Return an item; items of epoch 0 come from the cache if possible."""
        if epoch:
            return self.source.sample(index, epoch)
        return self.cache.get((id(self), index), lambda: self.source.sample(index), _num_bytes)


@dataclass
class _CachedNetwork:
    """Network whose output maps are cached, with a hash of the input's pixels as key."""

    network: Runtime
    cache: TuningCache
    stride: int
    size_multiple: int

    def maps(self, images: Images) -> Stage:
        """Return the network's maps of a batch of images, from the cache if possible."""
        pixels = images.permute(0, 2, 3, 1).contiguous().cpu().numpy()
        key = (id(self), pixels.shape, hashlib.blake2b(pixels.tobytes()).digest())
        return self.cache.get(
            key, lambda: self.network.maps(images), lambda maps: sum(part.nbytes for part in maps)
        )


def _num_bytes(sample: Sample) -> int:
    """Return the size of a sample's image, depth and masks in bytes."""
    arrays = [sample.image, sample.depth, *(instance.mask for instance in sample.instances)]
    return sum(array.nbytes for array in arrays if array is not None)
