"""Factors on distances and covariances that match the errors of poses on validation images."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import torch
from jaxtyping import Float

from dopepp.data.sample import Sample, SampleSource
from dopepp.experiment.run.calibration_fits import fit_covariance_factor, fit_distance_factor
from dopepp.experiment.run.scored_detections import Match, matched_poses
from dopepp.geometry.camera import make_transform, project
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.refinement.region.shared_errors import SCALE_ERROR
from dopepp.metrics.functional import mahalanobis
from dopepp.parts.part import Parts

MIN_REFINED_FACTOR: Final = 0.5
"""Smallest covariance factor of refined poses. Smaller factors fit renders at the network's
input size, and make covariances too small on larger images and on real images."""

MIN_REFINED: Final = 20  # smallest number of correct poses that determine a covariance factor

_log = logging.getLogger(__name__)


def fit_factors(pairs: Sequence[Match]) -> dict[str, float]:
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
    pairs: Sequence[Match], distance_factor: float = 1.0
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
