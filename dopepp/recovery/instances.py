"""From one object's peaks to its instances: grouping and posing by turns."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.geometry.camera import project_keypoints
from dopepp.geometry.cuboid import CENTROID, NUM_CORNERS, NUM_KEYPOINTS
from dopepp.geometry.pnp import PnPResult
from dopepp.maps.peaks import Peaks
from dopepp.recovery.association import KeypointGroup, ObjectPeaks, associate, direction_evidence
from dopepp.recovery.detection import Detection
from dopepp.recovery.options import RecoveryOptions
from dopepp.recovery.solve import solve_group

ROUNDS: Final = 3
"""Most turns of grouping and solving; in crowds one or two change anything."""


def peaks_of_object(
    peaks: Peaks, image: int, number: int, threshold: float, area: float
) -> ObjectPeaks:
    """Pick the peaks of one object on one image."""
    first = number * NUM_KEYPOINTS
    corners, centroid = (image, slice(first, first + NUM_CORNERS)), (image, first + CENTROID)
    strong = peaks.score[centroid] >= threshold
    return ObjectPeaks(
        peaks.position[corners],
        peaks.score[corners],
        peaks.covariance_px[corners],
        peaks.toward[corners],
        peaks.position[centroid][strong],
        peaks.score[centroid][strong],
        peaks.covariance_px[centroid][strong],
        area,
    )


def pose_instances(
    peaks: ObjectPeaks,
    cuboid: Float[np.ndarray, "9 3"],
    K: Float[np.ndarray, "3 3"],
    options: RecoveryOptions,
    coincident_px: float,
) -> list[tuple[KeypointGroup, PnPResult]]:
    """Group keypoints and solve poses by turns, until the poses change no group any more."""
    max_angle = math.radians(options.max_angle_deg)
    evidence = direction_evidence(peaks, max_angle, coincident_px)
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
            np.array_equal(old.position, new.position, equal_nan=True)
            for old, new in zip(before, groups, strict=True)
        ]
        if all(same):
            break
        results = [
            result if kept else solve_group(group, cuboid, K)
            for kept, result, group in zip(same, results, groups, strict=True)
        ]
    return list(zip(groups, results, strict=True))


def make_detection(
    group: KeypointGroup,
    result: PnPResult,
    cuboid: Float[np.ndarray, "9 3"],
    K: Float[np.ndarray, "3 3"],
    name: str,
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
