"""Recover object poses from belief maps and vector fields.

Training, evaluation, estimators and exported runtimes all call :func:`recover` or
:func:`recover_batch`: find peaks, associate them to instances, solve PnP, score the detections.
A :class:`Reason` describes why an object, or one candidate of it, is not detected. To add a reason,
add its kind to :data:`KINDS`, in the order of these steps.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dopepp.geometry.camera import CameraMatrix
from dopepp.geometry.cuboid import CENTROID, NUM_CORNERS, NUM_KEYPOINTS
from dopepp.geometry.pnp import PnPResult
from dopepp.maps.codec import Beliefs, Fields, MapGeometry, find_peaks
from dopepp.recovery.association import KeypointGroup, select_peaks, solve_instances
from dopepp.recovery.detection import PROBABLE, Detection, RecoveryOptions, make_detection
from dopepp.recovery.search import MIN_BELIEF, Depths, PosedMaps, PoseSearch

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
"""Kinds of reasons, in the order of the steps, each with its text in :func:`summary`."""

MIN_CELLS: Final = 3.0  # The peaks of a part that extends over fewer cells overlap


@dataclass(frozen=True)
class Reason:
    """Why an object, or one candidate of it, is not detected.

    Attributes:
        object: Name of the object.
        kind: Step that rejected the candidate, a key of :data:`KINDS`.
        best: Score of the candidate; without a pose, its centroid's belief; without a candidate,
            the highest belief of the object's centroid map or, if all nine are empty, of all nine.
        text: Explanation in words.
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
    geometry = MapGeometry(stride, chosen.sigma)
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
            reach = None if depths is None else depths[c]
            search: PoseSearch | None = None  # made for the first uncertain instance
            for group, result in instances:
                detection = make_detection(group, result, cuboid, camera, name, chosen)
                is_probable = detection is not None and detection.score >= PROBABLE
                is_clear = group.score[CENTROID] >= MIN_BELIEF
                if reach is not None and is_clear and not is_probable:
                    if search is None:
                        maps = beliefs.float().cpu().numpy()
                        posed = PosedMaps(maps, camera, stride, np.eye(4))
                        search = PoseSearch([posed], cuboid)
                    solved = search.solve(group, object_peaks, reach)
                    searched = make_detection(*solved, cuboid, camera, name, chosen)
                    if detection is None or detection.score < chosen.min_score:
                        detection = searched
                    else:
                        detection = replace(detection, alternative=searched)
                if detection is not None and detection.score >= chosen.min_score:
                    detections.append(detection)
                elif reasons is not None:
                    kind, best, text = _rejected(group, result, detection, chosen, cells, stride)
                    reasons.append(Reason(name, kind, best, text))
            if reasons is not None and not instances:
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


def _no_centroid(
    beliefs: Float[Tensor, "9 height width"], name: str, options: RecoveryOptions
) -> Reason:
    """Return the reason for an object without a peak above ``options.centroid_threshold``."""
    best = torch.nan_to_num(beliefs.detach().float()).flatten(1).amax(1)
    highest, centroid = float(best.max()), float(best[CENTROID])
    if highest <= options.peak_threshold:
        return Reason(name, "empty", highest, f"its maps are empty, no belief above {highest:.2g}")
    text = f"best belief of a centroid {centroid:.2g} below {options.centroid_threshold:g}"
    return Reason(name, "centroid", centroid, text)


def _rejected(
    group: KeypointGroup,
    result: PnPResult,
    detection: Detection | None,
    options: RecoveryOptions,
    cells: tuple[int, int],
    stride: int,
) -> tuple[Kind, float, str]:
    """Return the kind, ``best`` and the text of the reason for rejecting a candidate.

    ``cells`` is the (width, height) of the maps.
    """
    kind: Kind = "pose"
    best, text, points = float(np.nan_to_num(group.score[CENTROID])), result.reason, group.position
    if detection is not None:
        kind, best, points = "score", detection.score, detection.keypoints
        text = f"score {best:.3f} below {options.min_score:.3g}"
    points = points[np.isfinite(points).all(1)]
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if len(points) >= 2 and extent < MIN_CELLS * stride:
        kind = "small"
        text += f" (too small: {extent:.0f} px across, a cell of the maps has {stride} px)"
    x, y = group.position[CENTROID]
    size = f"{stride * cells[0]}×{stride * cells[1]}"  # size of the network's input
    return kind, best, f"at pixel ({x:.0f}, {y:.0f}) of {size}: {text}"


def refined_reason(detection: Detection, min_score: float) -> Reason:
    """Return the reason for dropping a refined detection whose score is below ``min_score``."""
    text = f"once refined, score {detection.score:.3f} below {min_score:.3g}"
    text += f" ({detection.kept})" if detection.kept else ""
    return Reason(detection.object, "refined", detection.score, text)


def main_reasons(reasons: Sequence[Reason]) -> list[Reason]:
    """Return each object's reason of the latest step and highest ``best``, latest step last."""
    order = list(KINDS)
    best: dict[str, Reason] = {}
    for reason in sorted(reasons, key=lambda reason: (order.index(reason.kind), reason.best)):
        best.pop(reason.object, None)
        best[reason.object] = reason
    return list(best.values())


def format_reasons(reasons: Sequence[Reason]) -> str:
    """Return the main reason of each object on one image as a line of text, latest step first."""
    counts = Counter(reason.object for reason in reasons)
    lines = []
    for reason in reversed(main_reasons(reasons)):
        count = counts[reason.object]
        lines.append(f"{reason} (the best of {count})" if count > 1 else str(reason))
    return "; ".join(lines)


def summary(silent: Sequence[Reason], num_images: int) -> str:
    """Return a line of text with the number of reasons of each kind and their highest ``best``.

    Args:
        silent: The main reason of each image without detections.
        num_images: Number of all images.
    """
    groups = []
    for kind, words in KINDS.items():
        values = [reason.best for reason in silent if reason.kind == kind]
        if values:
            groups.append(f"{len(values)} {words.format(best=max(values))}")
    return f"{len(silent)} of {num_images} images without detections: {', '.join(groups)}"
