"""The one way from maps to poses; callbacks, estimators and exported runtimes all call it.

A :class:`Reason` says why an object, or one candidate of it, is no detection. To add a reason, name
its kind in :data:`KINDS`, at its place on the way from maps to poses.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dopepp.geometry.camera import CameraMatrix
from dopepp.geometry.cuboid import CENTROID, NUM_CORNERS, NUM_KEYPOINTS, Cuboid
from dopepp.maps.codec import Beliefs, Fields, MapGeometry, find_peaks
from dopepp.recovery.association import ObjectPeaks
from dopepp.recovery.detection import Detection, make_detection, peaks_of_object, pose_instances
from dopepp.recovery.scoring import RecoveryOptions, calibrated

Cuboids = Float[np.ndarray, "objects 9 3"]
Cameras = Float[np.ndarray, "batch 3 3"]
Belief = Float[Tensor, "beliefs height width"]
Field = Float[Tensor, "fields height width"]

Kind = Literal["empty", "centroid", "small", "pose", "score", "refined"]

KINDS: Final[dict[Kind, str]] = {
    "empty": "with empty maps (best belief {best:.2g})",
    "centroid": "without a centroid (best belief {best:.2g})",
    "small": "with too small a part (best belief {best:.2g})",
    "pose": "without a pose that fits (best belief {best:.2g})",
    "score": "below the threshold (best score {best:.3g})",
    "refined": "below the threshold once refined (best score {best:.3g})",
}
"""What ends the way from maps to poses, in its order, as a summary says it."""

LEAST_CELLS: Final = 3.0  # Extent of an object's keypoints below which its maps are one blot, cells


@dataclass(frozen=True)
class Reason:
    """Why an object, or one candidate of it, is no detection.

    Attributes:
        object: The part's name.
        kind: What ended it.
        best: The belief or the score that it reached.
        text: In words, with the threshold.
    """

    object: str
    kind: Kind
    best: float
    text: str

    def __str__(self) -> str:
        return f"{self.object}: {self.text}"


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

    Args:
        belief: 9·C belief maps of C objects, peaks of 1.
        field: 16·C vector-field maps.
        cuboids: Nine keypoints of each object, metres.
        K: Camera matrix of the network's input, pixels.
        stride: Pixels per cell.
        names: Names of the objects (default: their indices).
        **options: Fields of :class:`RecoveryOptions`.

    Returns:
        Detections of all objects, best score first.
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

    ``reasons`` takes one for each object or centroid that is left out.

    Raises:
        ValueError: Maps, cuboids, cameras and names do not fit each other.
        UserError: An option is out of range.
    """
    chosen = RecoveryOptions.of(options)
    cuboids, K = np.asarray(cuboids, np.float64), np.asarray(K, np.float64)
    _check_shapes(belief, field, len(cuboids), K)
    labels = [str(c) for c in range(len(cuboids))] if names is None else list(names)
    if len(labels) != len(cuboids):
        raise ValueError(f"{len(cuboids)} objects need as many names, got {labels}")
    if not labels:
        return [[] for _ in K]
    geometry = MapGeometry(stride, chosen.sigma)
    peaks = find_peaks(belief, geometry, chosen.peak_threshold, chosen.max_peaks, field)
    cells = (belief.shape[-1], belief.shape[-2])
    size = f"{stride * cells[0]}×{stride * cells[1]}"  # of the network's input
    batch = []
    for image, camera in enumerate(K):
        detections: list[Detection] = []
        for c, (cuboid, name) in enumerate(zip(cuboids, labels, strict=True)):
            object_peaks = peaks_of_object(
                peaks, image, c, chosen.centroid_threshold, cells, stride
            )
            detections += _recover_object(
                object_peaks, cuboid, camera, name, chosen, stride, size, reasons
            )
            if reasons is not None and not len(object_peaks.centroid):
                beliefs = belief[image, c * NUM_KEYPOINTS : (c + 1) * NUM_KEYPOINTS]
                reasons.append(_no_centroid(beliefs, name, chosen))
        batch.append(sorted(detections, key=lambda detection: -detection.score))
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
            best = float(np.nan_to_num(group.score[CENTROID]))
            reason = Reason(name, "pose", best, f"{where}: {result.reason}")
            reasons.append(_or_too_small(reason, group.position, stride))
        else:
            text = f"{where}: score {detection.score:.3f} below {options.min_score:g}"
            reason = Reason(name, "score", detection.score, text)
            reasons.append(_or_too_small(reason, detection.keypoints, stride))


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


def _no_centroid(
    beliefs: Float[Tensor, "9 height width"], name: str, options: RecoveryOptions
) -> Reason:
    """Return how close an object without any centroid came to one."""
    best = torch.nan_to_num(beliefs.detach().float()).flatten(1).amax(1)
    if float(best.max()) <= options.peak_threshold:
        text = f"its maps are empty, no belief above {float(best.max()):.2g}"
        return Reason(name, "empty", float(best.max()), text)
    centroid, least = float(best[CENTROID]), options.centroid_threshold
    text = f"best belief of a centroid {centroid:.2g}, {least:g} is the least"
    return Reason(name, "centroid", centroid, text)


def _or_too_small(reason: Reason, points: Float[np.ndarray, "9 2"], stride: int) -> Reason:
    """Return the reason, or that the part is too small for the maps."""
    points = points[np.isfinite(points).all(1)]
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if len(points) < 2 or extent >= LEAST_CELLS * stride:
        return reason
    cell = f"{extent:.0f} px across, where a cell of the maps has {stride}"
    return replace(reason, kind="small", text=f"{reason.text} (too small: {cell})")


def rejected_refined(detection: Detection, least: float) -> Reason:
    """Return why a refined detection was dropped."""
    text = f"once refined, score {detection.score:.3f} below {least:g}"
    text += f" ({detection.kept})" if detection.kept else ""
    return Reason(detection.object, "refined", detection.score, text)


def furthest(reasons: Sequence[Reason]) -> list[Reason]:
    """Return of every object the reason that ended its best candidate, the best one last."""
    order = list(KINDS)
    best: dict[str, Reason] = {}
    for reason in sorted(reasons, key=lambda reason: (order.index(reason.kind), reason.best)):
        best.pop(reason.object, None)
        best[reason.object] = reason
    return list(best.values())


def explained(reasons: Sequence[Reason]) -> str:
    """Return one line on an image without detections."""
    counts = Counter(reason.object for reason in reasons)
    lines = []
    for reason in reversed(furthest(reasons)):
        count = counts[reason.object]
        lines.append(f"{reason} (the best of {count})" if count > 1 else str(reason))
    return "; ".join(lines)


def summary(silent: Sequence[Reason], num_images: int) -> str:
    """Return one line on images without detections, with a reason of each."""
    groups = []
    for kind, words in KINDS.items():
        values = [reason.best for reason in silent if reason.kind == kind]
        if values:
            groups.append(f"{len(values)} {words.format(best=max(values))}")
    return f"{len(silent)} of {num_images} images silent: {', '.join(groups)}"
