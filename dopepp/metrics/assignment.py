"""Which detection stands for which instance of an object, and every error of such a pair.

To add an error, give :class:`PoseErrors` a field and :meth:`PoseErrors.of` its function.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dopepp.geometry.camera import Transform, transform
from dopepp.geometry.rotation import Vector
from dopepp.geometry.symmetry import symmetry_group
from dopepp.metrics.functional import (
    add,
    add_s,
    match,
    mspd,
    mssd,
    rotation_error_deg,
    translation_error,
)
from dopepp.metrics.functional.inputs import Errors
from dopepp.parts.part import Part

Poses = Float[Tensor, "n 4 4"]


@dataclass
class PoseErrors:
    """Errors of N poses of one object, infinite where it was missed.

    Attributes:
        add: ADD, metres.
        add_s: ADD-S, metres.
        mssd: MSSD over the part's symmetries, metres.
        mspd: MSPD over the part's symmetries, pixels of an image 640 wide; None where a camera is
            not known.
        rotation_deg: Angle between the orientations, degrees.
        rotation_s_deg: The least such angle over the part's symmetries, degrees.
        translation: Distance between the object frame's origins, metres.
    """

    add: Errors
    add_s: Errors
    mssd: Errors
    mspd: Errors | None
    rotation_deg: Errors
    rotation_s_deg: Errors
    translation: Errors

    @classmethod
    def of(
        cls, part: Part, T_est: Poses, T_gt: Poses, K: Float[Tensor, "n 3 3"], width: Errors
    ) -> PoseErrors:
        """Compute them, of estimated poses (NaN for a miss) and true ones, metres.

        Camera matrices and the images' widths are pixels, NaN where unknown.
        """
        poses = T_est[:, :3, :3], T_est[:, :3, 3], T_gt[:, :3, :3], T_gt[:, :3, 3]
        points = torch.from_numpy(np.asarray(part.points, np.float64))
        vertices, group = extreme_points(part), symmetries(part)
        has_cameras = bool(K.isfinite().all() & width.isfinite().all())
        return cls(
            add=add(*poses, points),
            add_s=add_s(*poses, points),
            mssd=mssd(*poses, vertices, group),
            mspd=mspd(*poses, vertices, K, group) * (640 / width) if has_cameras else None,
            rotation_deg=rotation_error_deg(poses[0], poses[2]),
            rotation_s_deg=rotation_error_deg(poses[0], poses[2], group),
            translation=translation_error(poses[1], poses[3]),
        )


def symmetries(part: Part) -> Float[Tensor, "s 4 4"]:
    """Return the part's symmetry transforms, the identity first."""
    group = symmetry_group(part.symmetries_discrete, part.symmetries_continuous)
    return torch.from_numpy(group)


def extreme_points(part: Part) -> Float[Tensor, "v 3"]:
    """Return what MSSD and MSPD look at: the mesh's vertices as in BOP, else the ADD points.

    The surface samples of a CAD part miss its corners, where the largest distances are.
    """
    points = part.points if part.mesh is None else part.mesh.vertices
    return torch.from_numpy(np.asarray(points, np.float64))


class PredictedPose(Protocol):
    """What the accumulator reads of a detection."""

    @property
    def object(self) -> str:
        """Name of the part."""

    @property
    def score(self) -> float:
        """Confidence; a better one is matched first."""

    @property
    def T_cam_obj(self) -> Transform:  # noqa: N802
        """Estimated pose, metres."""


class TruePose(Protocol):
    """What the accumulator reads of a ground-truth instance."""

    @property
    def label(self) -> str:
        """Name of the part."""

    @property
    def T_cam_obj(self) -> Transform:  # noqa: N802
        """True pose, metres."""

    @property
    def visible_fraction(self) -> float:
        """Visible share of the full silhouette, in [0, 1]."""


@dataclass(frozen=True)
class Assignment:
    """One object on one image: each instance that counts, and the scores of the false positives.

    Of an instance it is the estimated pose and the prediction's score (NaN where it was missed),
    the true pose, and the visible share of its silhouette.
    """

    T_est: Float[np.ndarray, "counted 4 4"]
    T_gt: Float[np.ndarray, "counted 4 4"]
    visible_fractions: Float[np.ndarray, "counted"]
    scores: Float[np.ndarray, "counted"]
    false_positive_scores: Float[np.ndarray, "false_positives"]


def assign(
    centre: Vector,
    detections: Sequence[PredictedPose],
    instances: Sequence[TruePose],
    min_visible_fraction: float,
) -> Assignment:
    """Match one object on one image.

    Instances that count are matched first; predictions left over may then explain themselves by
    instances that do not, and are ignored; the rest are false positives.

    Detections and instances are of this object, the centre of its cuboid (object frame, metres).
    """
    counted = [i for i in instances if i.visible_fraction >= min_visible_fraction]
    hidden = [i for i in instances if not i.visible_fraction >= min_visible_fraction]
    T_est, scores = np.full((len(counted), 4, 4), np.nan), np.full(len(counted), np.nan)
    left = []
    matches = match_by_centre(centre, detections, counted)
    for detection, index in zip(detections, matches, strict=True):
        if index < 0:
            left.append(detection)
        else:
            T_est[index], scores[index] = detection.T_cam_obj, detection.score
    unexplained = match_by_centre(centre, left, hidden) < 0
    false_positives = [float(d.score) for d, stray in zip(left, unexplained, strict=True) if stray]
    T_gt = np.array([i.T_cam_obj for i in counted], np.float64).reshape(-1, 4, 4)
    visible = np.array([i.visible_fraction for i in counted], np.float64)
    return Assignment(T_est, T_gt, visible, scores, np.array(false_positives, np.float64))


def match_by_centre(
    centre: Vector, detections: Sequence[PredictedPose], instances: Sequence[TruePose]
) -> Int[Tensor, "detections"]:
    """Match by the distance between the centres of the objects' cuboids; see :func:`match`."""
    # Infinity times zero would warn; as NaN throughout, such a pose just matches nothing.
    estimates = [np.asarray(d.T_cam_obj, np.float64) for d in detections]
    predicted = [transform(np.where(np.isfinite(T), T, np.nan), centre) for T in estimates]
    true = [transform(np.asarray(i.T_cam_obj, np.float64), centre) for i in instances]
    offsets = np.reshape(predicted, (-1, 1, 3)) - np.reshape(true, (1, -1, 3))
    scores = torch.tensor([float(d.score) for d in detections], dtype=torch.float64)
    return match(scores, torch.from_numpy(np.linalg.norm(offsets, axis=2)))
