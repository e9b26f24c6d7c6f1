"""Recover object poses from belief maps and vector fields.

Training, evaluation, estimators and exported runtimes all call :func:`recover` or
:func:`recover_batch`: find peaks, associate them to instances, solve PnP, score the detections.
:mod:`~dopepp.recovery.reasons` describes why an object, or one candidate of it, is not detected.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from jaxtyping import Float
from torch import Tensor

from dopepp.geometry.camera import CameraMatrix
from dopepp.geometry.cuboid import CENTROID, NUM_CORNERS, NUM_KEYPOINTS, Cuboid
from dopepp.geometry.pnp import PnPResult
from dopepp.maps.codec import Beliefs, Fields, MapGeometry, find_peaks
from dopepp.recovery.association import KeypointGroup, ObjectPeaks, select_peaks, solve_instances
from dopepp.recovery.detection import PROBABLE, Detection, RecoveryOptions, make_detection
from dopepp.recovery.reasons import Reason, no_centroid, rejected
from dopepp.recovery.search import MIN_BELIEF, Depths, PosedMaps, PoseSearch

Cuboids = Float[np.ndarray, "objects 9 3"]
Cameras = Float[np.ndarray, "batch 3 3"]
Belief = Float[Tensor, "beliefs height width"]
Field = Float[Tensor, "fields height width"]


def recover(
    belief: Belief,
    field: Field,
    cuboids: Cuboids,
    K: CameraMatrix,
    stride: int = 8,
    names: Sequence[str] | None = None,
    depths: Sequence[Depths | None] | None = None,
    **options: float,
) -> list[Detection]:
    """Recover the poses of all objects in one image from its maps.

    Args:
        belief: 9·C belief maps of C objects, channels as from :func:`~dopepp.maps.codec.encode`.
        field: 16·C vector-field maps.
        cuboids: Nine keypoints of each object, object frame, metres.
        K: Camera matrix of the network's input, pixels.
        stride: Pixels of the network's input per cell.
        names: Names of the objects (default: their indices).
        depths: Nearest and farthest depth of each object, metres. In this range, :mod:`~.search`
            searches a second pose of each instance with a clear centroid and a score below
            :data:`PROBABLE`. This pose becomes ``Detection.alternative``, or the detection itself
            if PnP gives no pose with the minimum score. None (the default): no search.
        **options: Fields of :class:`RecoveryOptions`.

    Returns:
        Detections of all objects, by descending score.

    Raises:
        ValueError: The shapes of maps, cuboids and K, or the number of names, disagree.
        UserError: An option is unknown or out of range.
    """
    camera = np.asarray(K)[None]
    return recover_batch(
        belief[None], field[None], cuboids, camera, stride, names, None, depths, **options
    )[0]


def recover_batch(
    belief: Beliefs,
    field: Fields,
    cuboids: Cuboids,
    K: Cameras,
    stride: int = 8,
    names: Sequence[str] | None = None,
    reasons: list[Reason] | None = None,
    depths: Sequence[Depths | None] | None = None,
    **options: float,
) -> list[list[Detection]]:
    """Return the result of :func:`recover` for each image of a batch.

    Arguments are as in :func:`recover`; ``belief``, ``field`` and ``K`` have a leading batch axis.
    A reason is appended to ``reasons`` for each object without a candidate (a centroid peak) and
    for each candidate without a detection.

    Raises:
        ValueError: The shapes of maps, cuboids and cameras, or the number of names, disagree.
        UserError: An option is unknown or out of range.
    """
    chosen = RecoveryOptions.of(options)
    cuboids, K = np.asarray(cuboids, np.float64), np.asarray(K, np.float64)
    _check_shapes(belief, field, len(cuboids), K)
    labels = [str(c) for c in range(len(cuboids))] if names is None else list(names)
    if len(labels) != len(cuboids):
        raise ValueError(f"{len(cuboids)} objects need as many names, got {labels}")
    if not labels:
        return [[] for _ in K]
    geometry = MapGeometry(stride, chosen.sigma, chosen.field_radius)
    peaks = find_peaks(belief, geometry, chosen.peak_threshold, chosen.max_peaks, field)
    cells = (belief.shape[-1], belief.shape[-2])
    max_angle = math.radians(chosen.max_angle_deg)
    batch = []
    for image, camera in enumerate(K):
        detections: list[Detection] = []
        for c, (cuboid, name) in enumerate(zip(cuboids, labels, strict=True)):
            object_peaks = select_peaks(peaks, image, c, chosen.centroid_threshold, cells, stride)
            instances = solve_instances(object_peaks, cuboid, camera, max_angle, float(stride))
            beliefs = belief[image, c * NUM_KEYPOINTS : (c + 1) * NUM_KEYPOINTS]
            searched_depths = None if depths is None else depths[c]
            candidates = _Candidates(
                name, cuboid, camera, beliefs, stride, object_peaks, searched_depths, chosen
            )
            for group, result in instances:
                detection = candidates.detection(group, result)
                if detection is not None and detection.score >= chosen.min_score:
                    detections.append(detection)
                elif reasons is not None:
                    reasons.append(rejected(name, group, result, detection, chosen, cells, stride))
            if reasons is not None and not instances:
                reasons.append(no_centroid(beliefs, name, chosen))
        batch.append(sorted(detections, key=lambda detection: -detection.score))
    return batch


@dataclass(frozen=True, eq=False)
class _Candidates:
    """The candidates of one object in one image."""

    name: str
    cuboid: Cuboid
    K: CameraMatrix  # of the network's input, pixels
    beliefs: Float[Tensor, "9 height width"]
    stride: int
    peaks: ObjectPeaks
    depths: Depths | None  # searched for further poses, metres; None: no search
    options: RecoveryOptions

    def detection(self, group: KeypointGroup, result: PnPResult) -> Detection | None:
        """Return the detection of a candidate; an uncertain one is also searched in the maps."""
        of_object = partial(
            make_detection, cuboid=self.cuboid, K=self.K, name=self.name, options=self.options
        )
        detection = of_object(group, result)
        is_probable = detection is not None and detection.score >= PROBABLE
        is_clear = group.score[CENTROID] >= MIN_BELIEF
        if self.depths is None or is_probable or not is_clear:
            return detection
        searched = of_object(*self._search.solve(group, self.peaks, self.depths))
        if detection is None or detection.score < self.options.min_score:
            return searched
        return replace(detection, alternative=searched)

    @cached_property
    def _search(self) -> PoseSearch:
        """Search in the maps, prepared for the first uncertain candidate."""
        maps = self.beliefs.float().cpu().numpy()
        return PoseSearch([PosedMaps(maps, self.K, self.stride, np.eye(4))], self.cuboid)


def explain(
    belief: Belief,
    field: Field,
    cuboids: Cuboids,
    K: CameraMatrix,
    stride: int = 8,
    names: Sequence[str] | None = None,
    **options: float,
) -> list[Reason]:
    """Return why objects and candidates (centroid peaks) are not detected; see :func:`recover`."""
    reasons: list[Reason] = []
    camera = np.asarray(K)[None]
    recover_batch(
        belief[None], field[None], cuboids, camera, stride, names, reasons, None, **options
    )
    return reasons


def _check_shapes(belief: Beliefs, field: Fields, num_objects: int, K: Cameras) -> None:
    """Raise a ValueError if the shapes of maps and cameras and the number of objects disagree."""
    expected = (num_objects * NUM_KEYPOINTS, num_objects * NUM_CORNERS * 2)
    if belief.ndim != 4 or field.ndim != 4 or 0 in belief.shape[2:]:
        raise ValueError(
            f"maps are (batch, channels, height, width) with cells, got {tuple(belief.shape)} "
            f"and {tuple(field.shape)}"
        )
    channels = (belief.shape[1], field.shape[1])
    if channels != expected or belief.shape[2:] != field.shape[2:] or len(belief) != len(field):
        raise ValueError(
            f"{num_objects} objects need {expected} belief and field channels of one size, "
            f"got {tuple(belief.shape)} and {tuple(field.shape)}"
        )
    if K.shape != (len(belief), 3, 3):
        raise ValueError(f"{len(belief)} images need as many camera matrices, got {K.shape}")
