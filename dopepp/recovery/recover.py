"""The one way from maps to poses; callbacks, estimators and exported runtimes all call it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float
from torch import Tensor

from dopepp.geometry.camera import CameraMatrix
from dopepp.geometry.cuboid import CENTROID, NUM_CORNERS, NUM_KEYPOINTS, Cuboid
from dopepp.maps.encode import Beliefs, Fields, MapGeometry
from dopepp.maps.peaks import find_peaks
from dopepp.recovery.association import ObjectPeaks
from dopepp.recovery.calibration import RecoveryOptions, calibrated
from dopepp.recovery.detection import Detection, make_detection, peaks_of_object, pose_instances
from dopepp.recovery.silence import Reason, low_score, no_centroid, no_pose

Cuboids = Float[np.ndarray, "objects 9 3"]
Cameras = Float[np.ndarray, "batch 3 3"]
Belief = Float[Tensor, "beliefs height width"]
Field = Float[Tensor, "fields height width"]

__all__ = ["RecoveryOptions", "explain", "recover", "recover_batch"]


def recover(
    belief: Belief,
    field: Field,
    cuboids: Cuboids,
    K: CameraMatrix,
    stride: int = 8,
    names: Sequence[str] | None = None,
    **options: float,
) -> list[Detection]:
    """Recover the poses of all objects on one image from its maps.

    Of C objects there are 9·C belief maps (peaks of 1), 16·C vector-field maps, and nine keypoints
    each, metres; without names, their indices stand for them. K is the camera matrix of the
    network's input, pixels, of which ``stride`` make a cell. The options are fields of
    :class:`RecoveryOptions`. Returned are the detections of all objects, best score first.
    """
    return recover_batch(
        belief[None], field[None], cuboids, np.asarray(K)[None], stride, names, None, **options
    )[0]


def recover_batch(
    belief: Beliefs,
    field: Fields,
    cuboids: Cuboids,
    K: Cameras,
    stride: int = 8,
    names: Sequence[str] | None = None,
    reasons: list[Reason] | None = None,
    **options: float,
) -> list[list[Detection]]:
    """Recover the poses on every image of a batch; see :func:`recover`.

    Peaks are found and read on the maps' device; only they come to the host. ``reasons`` takes one
    for each object or centroid that is left out. A ``ValueError``: the channels do not match
    the number of cuboids, maps differ in size or have no cells, or there are not as many cameras as
    images or names as objects. A :class:`UserError`: an option is out of range.
    """
    chosen = RecoveryOptions(**options)  # type: ignore[arg-type]
    cuboids, K = np.asarray(cuboids, np.float64), np.asarray(K, np.float64)
    _check_shapes(belief, field, len(cuboids), K)
    labels = [str(c) for c in range(len(cuboids))] if names is None else list(names)
    if len(labels) != len(cuboids):
        raise ValueError(f"{len(cuboids)} objects need as many names, got {labels}")
    if not labels:
        return [[] for _ in K]
    geometry = MapGeometry(stride, chosen.sigma)
    peaks = find_peaks(belief, geometry, chosen.peak_threshold, int(chosen.max_peaks), field)
    cells = (belief.shape[-1], belief.shape[-2])
    size = f"{stride * cells[0]}×{stride * cells[1]}"  # of the network's input
    batch = []
    for image, camera in enumerate(K):
        detections: list[Detection] = []
        for c, (cuboid, name) in enumerate(zip(cuboids, labels, strict=True)):
            own = peaks_of_object(peaks, image, c, chosen.centroid_threshold, cells, stride)
            detections += _recover_object(own, cuboid, camera, name, chosen, stride, size, reasons)
            if reasons is not None and not len(own.centroid):
                beliefs = belief[image, c * NUM_KEYPOINTS : (c + 1) * NUM_KEYPOINTS]
                reasons.append(no_centroid(beliefs, name, chosen))
        batch.append(sorted(detections, key=lambda one: -one.score))
    return batch


def explain(
    belief: Belief,
    field: Field,
    cuboids: Cuboids,
    K: CameraMatrix,
    stride: int = 8,
    names: Sequence[str] | None = None,
    **options: float,
) -> list[Reason]:
    """Say what :func:`recover` leaves out of these maps and why, for each object or centroid."""
    reasons: list[Reason] = []
    image = np.asarray(K)[None]
    recover_batch(belief[None], field[None], cuboids, image, stride, names, reasons, **options)
    return reasons


def _recover_object(
    peaks: ObjectPeaks,
    cuboid: Cuboid,
    K: CameraMatrix,
    name: str,
    options: RecoveryOptions,
    stride: int,
    size: str,
    reasons: list[Reason] | None,
) -> Iterator[Detection]:
    """Yield all instances of one object; ``reasons`` takes one for each that is none."""
    for group, result in pose_instances(peaks, cuboid, K, options.max_angle_deg, float(stride)):
        detection = make_detection(group, result, cuboid, K, name)
        if detection is not None:
            detection = calibrated(detection, cuboid, K, options)
            if detection.score >= options.min_score:
                yield detection
                continue
        if reasons is None:
            continue
        x, y = group.position[CENTROID]
        where = f"at pixel ({x:.0f}, {y:.0f}) of {size}"
        if detection is None:
            reasons.append(no_pose(group, result.reason, name, where, stride))
        else:
            reasons.append(low_score(detection, options.min_score, where, stride))


def _check_shapes(belief: Beliefs, field: Fields, num_objects: int, K: Cameras) -> None:
    expected = (num_objects * NUM_KEYPOINTS, num_objects * NUM_CORNERS * 2)
    if belief.ndim != 4 or field.ndim != 4 or 0 in belief.shape[2:]:
        raise ValueError(
            f"maps are (batch, channels, height, width) with cells, got {tuple(belief.shape)} "
            f"and {tuple(field.shape)}"
        )
    got = (belief.shape[1], field.shape[1])
    if got != expected or belief.shape[2:] != field.shape[2:] or len(belief) != len(field):
        raise ValueError(
            f"{num_objects} objects need {expected} belief and field channels of one size, "
            f"got {tuple(belief.shape)} and {tuple(field.shape)}"
        )
    if K.shape != (len(belief), 3, 3):
        raise ValueError(f"{len(belief)} images need as many camera matrices, got {K.shape}")
