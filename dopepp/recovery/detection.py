"""From one object's peaks to its detections: keypoints are grouped, groups posed, by turns."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.camera import CameraMatrix, Transform, project_keypoints
from dopepp.geometry.cuboid import CENTROID, NUM_CORNERS, NUM_KEYPOINTS, Cuboid
from dopepp.geometry.pnp import PnPResult, solve_pnp
from dopepp.geometry.refine import MIN_POINTS, too_few
from dopepp.maps.codec import Peaks
from dopepp.recovery.association import KeypointGroup, ObjectPeaks, associate, direction_evidence

SIGMA_FLOOR_PX: Final = 1.0  # Bounds the weight of a clean peak against a blurred one

WIDENINGS: Final = (1.0, 2.0, 4.0)
"""Factors on the peaks' standard deviations, until most keypoints agree."""

ROUNDS: Final = 3  # Most turns of grouping and solving

BORDER: Final = 1.0  # Distance from the maps' border within which a keypoint may lie beyond, cells

BORDER_DEVIATION: Final = 0.75
"""Error of such a peak, cells (root mean square of trained networks): half of the belief lies where
there are no cells, so the peak is pulled inward."""


@dataclass(frozen=True)
class Detection:
    """One object found on an image.

    Attributes:
        object: The part's name.
        score: How sure the pose is, in [0, 1]: the mean belief or, once the checkpoint is tuned,
            the probability that ADD is below a tenth of the diameter.
        belief: Mean belief over the nine keypoints, in [0, 1]; one that is missing or does not
            agree with the pose counts 0.
        T_cam_obj: Object-to-camera transform, metres, OpenCV camera frame.
        keypoints: The cuboid's corners and centroid projected with this pose, pixels.
        peaks: The measured keypoints, pixels; NaN where the maps have none that agrees with the
            pose.
        reprojection_error_px: RMS distance between the two over the PnP inliers, pixels.
        covariance: Of a small turn about the object's origin (rotation vector in the camera
            frame, radians) and a small shift (camera frame, metres), from the peaks' covariances.
        kept: Why a refinement that was asked for kept the network's pose; empty elsewhere.
        agreement: Share of the image's evidence about the refined outline that agrees with it, in
            [0, 1]; None without refinement.
        support: Share of the refined outline that has agreeing evidence, in [0, 1], which hidden
            outline has not; None without refinement.
    """

    object: str
    score: float
    belief: float
    T_cam_obj: Transform
    keypoints: Float[np.ndarray, "9 2"]
    peaks: Float[np.ndarray, "9 2"]
    reprojection_error_px: float
    covariance: Float[np.ndarray, "6 6"]
    kept: str = ""
    agreement: float | None = None
    support: float | None = None


def peaks_of_object(
    peaks: Peaks, image: int, number: int, threshold: float, cells: tuple[int, int], stride: float
) -> ObjectPeaks:
    """Pick the peaks of one object on one image; those at the border are less certain.

    Below the belief ``threshold`` a centroid is no instance; ``cells`` are the maps' width and
    height.
    """
    first = number * NUM_KEYPOINTS
    corners, centroid = (image, slice(first, first + NUM_CORNERS)), (image, first + CENTROID)
    strong = peaks.score[centroid] >= threshold
    extent = np.array(cells) * float(stride)
    position, covariance = peaks.position[corners], peaks.covariance_px[corners]
    covariance = _covariance_px(position, covariance, extent, float(stride))
    return ObjectPeaks(
        position,
        peaks.score[corners],
        covariance,
        peaks.toward[corners],
        peaks.position[centroid][strong],
        peaks.score[centroid][strong],
        peaks.covariance_px[centroid][strong],
        float(extent.prod()),
    )


@compiled()
def _covariance_px(position: Array, covariance: Array, extent: Array, stride: float) -> Array:
    """Add what a peak at the border of the maps does not know; the outermost pixel ends at −½."""
    widened = covariance.copy()
    for k, m in np.ndindex(position.shape[:2]):
        x, y = position[k, m, 0], position[k, m, 1]
        inward = min(x + 0.5, y + 0.5, extent[0] - 0.5 - x, extent[1] - 0.5 - y)
        if inward < BORDER * stride:
            for axis in range(2):
                widened[k, m, axis, axis] += (BORDER_DEVIATION * stride) ** 2
    return widened


def pose_instances(
    peaks: ObjectPeaks,
    cuboid: Cuboid,
    K: CameraMatrix,
    max_angle_deg: float,
    coincident_px: float,
) -> list[tuple[KeypointGroup, PnPResult]]:
    """Group keypoints and solve poses by turns, until the poses change no group any more."""
    if not len(peaks.centroid):
        return []
    evidence = direction_evidence(peaks, math.radians(max_angle_deg), coincident_px)
    groups = associate(peaks, evidence)
    results = [solve_group(group, cuboid, K) for group in groups]
    for _ in range(ROUNDS):
        if all(result.inliers.all() for result in results):
            break  # complete instances have nothing to gain from each other
        expected = np.full((len(groups), NUM_CORNERS, 2), np.nan)
        for corners, result in zip(expected, results, strict=True):
            if result.T_cam_obj is not None:
                corners[:] = project_keypoints(cuboid, result.T_cam_obj, K)[:NUM_CORNERS]
        before, groups = groups, associate(peaks, evidence, expected)
        same = [
            old.position.tobytes() == new.position.tobytes()
            for old, new in zip(before, groups, strict=True)
        ]
        if all(same):
            break
        results = [
            result if kept else solve_group(group, cuboid, K)
            for kept, result, group in zip(same, results, groups, strict=True)
        ]
    return list(zip(groups, results, strict=True))


def solve_group(group: KeypointGroup, cuboid: Cuboid, K: CameraMatrix) -> PnPResult:
    """Solve PnP with each keypoint weighted by its own covariance.

    A covariance is averaged over its directions: how wide a network's peak is tells how far it is
    off, its shape does not tell whither. A network's maps are narrower than its errors; where fewer
    than two thirds of the keypoints agree on a pose, the deviations are widened and the pose solved
    again.
    """
    found = sum(math.isfinite(x) for x in group.position[:, 0].tolist())
    if found < MIN_POINTS:  # as of most centroids that noise makes
        return PnPResult(None, math.inf, np.zeros(NUM_KEYPOINTS, bool), too_few(found))
    covariance = _averaged(group.covariance_px)
    return solve_pnp(cuboid, group.position, K, covariance_px=covariance, widenings=WIDENINGS)


@compiled()
def _averaged(covariance: Array) -> Array:
    """Return circular covariances of the same mean variance, and the floor; NaN stays NaN."""
    averaged = np.zeros(covariance.shape)
    for k in range(len(covariance)):
        variance = (covariance[k, 0, 0] + covariance[k, 1, 1]) / 2 + SIGMA_FLOOR_PX**2
        averaged[k, 0, 0] = averaged[k, 1, 1] = variance
    return averaged


def make_detection(
    group: KeypointGroup, result: PnPResult, cuboid: Cuboid, K: CameraMatrix, name: str
) -> Detection | None:
    """Turn one group into a detection where PnP finds a pose."""
    if result.T_cam_obj is None or result.covariance is None:
        return None
    belief = float(np.where(result.inliers, group.score, 0.0).clip(0.0, 1.0).mean())
    return Detection(
        object=name,
        score=belief,
        belief=belief,
        T_cam_obj=result.T_cam_obj,
        keypoints=project_keypoints(cuboid, result.T_cam_obj, K),
        peaks=np.where(result.inliers[:, None], group.position, np.nan),
        reprojection_error_px=result.reprojection_error_px,
        covariance=result.covariance,
    )
