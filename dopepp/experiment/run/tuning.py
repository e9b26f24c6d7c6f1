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

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.data.sample import SampleSource
from dopepp.experiment.assembly.build_sources import held_out_source
from dopepp.experiment.assembly.negative_frames import negative_frames
from dopepp.experiment.config.data_config import DataConfig
from dopepp.experiment.config.run_config import FalsePositiveTarget
from dopepp.experiment.run.calibration_fits import fit_weights
from dopepp.experiment.run.scored_detections import (
    DetectionQuality,
    ScoredDetections,
    matched_poses,
    measure_quality,
    score_images,
)
from dopepp.experiment.run.tuned_factors import WrongFocalLengths, fit_factors, fit_refined_factor
from dopepp.experiment.run.tuning_cache import TuningCache
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.network_estimator import NetworkEstimator
from dopepp.models.checkpoint import Checkpoint
from dopepp.models.storage import write_atomic
from dopepp.parts.part import Parts
from dopepp.recovery.detection import (
    FEATURES,
    PROBABLE,
    REFINED_FEATURES,
    RecoveryOptions,
    score,
)

MIN_REFINED_SCORE: Final = 0.1
"""Lowest threshold of refined poses. Poses that are far more likely incorrect than correct are
never reported, even if the images without the objects permit a lower threshold."""

MAX_INSTANCES: Final = 500
"""Number of instances per part on which tuning fits and measures: heaps need only few images."""

MAX_LOST: Final = 0.01
"""Largest share of correct poses that a threshold above :data:`~.detection.PROBABLE` may reject."""

MAX_PRECISION_LOSS: Final = 0.005  # largest decrease of the average precision with fitted factors

HELD_OUT: Final[tuple[Literal["val"], Literal["test"]]] = ("val", "test")

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Tuning:
    """Tuned recovery options, and their effect on test images."""

    options: dict[str, float]  # changed RecoveryOptions
    before: DetectionQuality  # network with the old options, without refinement
    after: DetectionQuality  # estimator with the tuned options
    num_images: tuple[int, int]  # test images with and without objects
    kept: str = ""  # why the old factors were kept; empty if they were replaced


def tune(
    estimator: NetworkEstimator, data: DataConfig, parts: Parts, target: FalsePositiveTarget
) -> Tuning:
    """Choose factors, weights and thresholds on validation images and measure them on test images.

    The score of network poses is tuned first, then the score of refined poses.

    Raises:
        UserError: There are no detections, all detections are correct, all are incorrect, or a
            covariance factor is outside the range of :func:`fit_covariance_factor`.
    """
    cache = TuningCache()
    estimator = cache.with_cached_maps(estimator)
    count, rate = target.num_empty, target.false_positive_rate
    most = MAX_INSTANCES * len(parts)
    validation, test = (cache.of(held_out_source(data, parts, split), most) for split in HELD_OUT)
    empty, empty_test = (cache.of(negative_frames(data, parts, split, count)) for split in HELD_OUT)
    _log.info("tuning: measuring on %d test images and %d without objects", len(test), count)
    before = measure_quality(estimator.refining(None), parts, test, empty_test)
    _log.info("tuning: fitting factors and scores on %d validation images", len(validation))
    new, shown, kept = _chosen_factors(estimator, parts, validation, empty, rate)
    if estimator.refiner is not None and estimator.refiner.verifies:
        estimator.recovery = new
        _log.info("tuning: fitting the score and covariances of refined poses")
        without = score_images(estimator, parts, empty)
        factor = fit_refined_factor(estimator, parts, WrongFocalLengths(validation))
        new = replace(new, **choose(shown, without, rate, refined=True))  # type: ignore[arg-type]
        new = replace(new, refined_covariance_factor=factor)
    _log.info("tuning: measuring with the new options")
    estimator.recovery = new
    after = measure_quality(estimator, parts, test, empty_test)
    endings, beginnings = ("_factor", "min_score"), ("score_", "refined_")
    options = {
        name: value
        for name, value in vars(new).items()
        if name.endswith(endings) or name.startswith(beginnings)
    }
    return Tuning(options, before, after, (len(test), count), kept)


def _chosen_factors(
    estimator: PoseEstimator,
    parts: Parts,
    validation: SampleSource,
    empty: SampleSource,
    rate: float,
) -> tuple[RecoveryOptions, ScoredDetections, str]:
    """Fit distance and covariance factor, unless they lower AP by over ``MAX_PRECISION_LOSS``.

    AP is measured on the estimator's final poses, because a wrong covariance of the network's poses
    misleads the refinement. The score of network poses is fitted for both.

    Returns:
        Options, the detections with these options on the validation images, and why the old factors
        were kept (an empty string if the factors were replaced).
    """
    old, plain = estimator.recovery, estimator.refining(None)
    plain.recovery = replace(old, distance_factor=1.0, covariance_factor=1.0)
    factors = fit_factors(matched_poses(plain, parts, validation))
    results: list[tuple[RecoveryOptions, ScoredDetections, float]] = []
    for base in (replace(old, **factors), old):  # type: ignore[arg-type]
        plain.recovery = base
        with_objects, without = (
            score_images(plain, parts, source) for source in (validation, empty)
        )
        chosen = choose(with_objects, without, rate)
        # Undo former tuning of refined poses: their score is fitted to the untuned verification.
        estimator.recovery = replace(base.unrefined(), **chosen)  # type: ignore[arg-type]
        shown = score_images(estimator, parts, validation)
        results.append((estimator.recovery, shown, shown.average_precision(shown.scores)))
    (new, shown_new, fitted), (same, shown_same, former) = results
    if fitted >= former - MAX_PRECISION_LOSS:
        return new, shown_new, ""
    text = ", ".join(f"{name}={value:.3g}" for name, value in factors.items())
    kept = f"AP {former:.3f} on validation images with the old factors, {fitted:.3f} with {text}"
    return same, shown_same, kept


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


def write_tuned(checkpoint: Checkpoint, path: Path, options: Mapping[str, float]) -> Path:
    """Write a checkpoint with changed recovery options as ``NAME_tuned.ckpt``; return its path."""
    recovery = replace(RecoveryOptions.of(checkpoint.recovery), **options)  # type: ignore[arg-type]
    tuned = replace(checkpoint, recovery=vars(recovery))
    target = path.with_name(f"{path.stem}_tuned.ckpt")
    write_atomic(tuned.to_file(), target)
    return target
