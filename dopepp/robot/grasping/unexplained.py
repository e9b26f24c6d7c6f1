"""Regions of an image in the colours of the detected parts that no detected part covers.

Such a region probably shows an undetected part. The planner's model of the scene lacks this part,
so the fingers should not descend there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final

import cv2
import numpy as np
from jaxtyping import UInt8

from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix, Transform, project, transform
from dopepp.inference.refinement.colour import colour_bins, log_odds
from dopepp.inference.refinement.outline import OutlineMesh, filled_mask, posed
from dopepp.robot.grasping.grasps import PAD_HALF

BESIDE_PX: Final = 8.0  # distance from a detected part's outline within which no pixel counts
MIN_LOG_ODDS: Final = 0.5  # smallest log odds of a pixel in a part's colours
SMOOTH_PX: Final = 5  # side of the square over which log odds are averaged
THINNEST_PX: Final = 9  # thickness of a region below which it is ignored
COMMON: Final = 0.3  # share of the image above which the bench has the parts' colours
MAX_COVERED: Final = 0.1  # largest share of a finger's image inside regions
TIP: Final = 0.01  # length of the fingers' ends that must be clear, metres


@dataclass(frozen=True, eq=False)
class Unexplained:
    """Regions that probably show undetected parts, in an image without lens distortion."""

    mask: UInt8[np.ndarray, "height width"]  # 1 inside a region, else 0
    K: CameraMatrix
    T_cam_base: Transform

    def blocks(self, T_base_tool: Transform, opening: float) -> bool:
        """Return whether a finger enters a region on the image.

        ``T_base_tool`` has its origin midway between the pads' ends, x along the closing direction
        and z along the approach. ``opening`` is the distance between the pads, metres.
        """
        inner, outer = opening / 2, opening / 2 + 2 * PAD_HALF[0]
        for side in (-1, 1):
            ends = product((side * inner, side * outer), (-PAD_HALF[1], PAD_HALF[1]), (-TIP, 0.0))
            corners = transform(self.T_cam_base @ T_base_tool, np.array(list(ends)))
            hull = cv2.convexHull(np.rint(project(corners, self.K)).astype(np.int32))
            finger = cv2.fillConvexPoly(np.zeros_like(self.mask), hull, 1)
            if (finger & self.mask).sum() > MAX_COVERED * finger.sum():
                return True
        return False


def find_unexplained(
    image: RGBImage, K: CameraMatrix, mesh: OutlineMesh, poses: Sequence[Transform]
) -> UInt8[np.ndarray, "height width"]:
    """Return a mask of the pixels in the detected parts' colours, away from these parts.

    The image has no lens distortion; ``poses`` are T_cam_obj of the detected parts.

    Returns:
        1 in a region, else 0; 0 everywhere if colours do not distinguish the parts from the bench.
    """
    height, width = image.shape[:2]
    covered = np.zeros((height, width), np.uint8)
    for pose in poses:
        posed_mesh = posed(mesh, pose, K)
        if posed_mesh is not None:
            covered |= filled_mask(mesh, posed_mesh, (width, height))
    nothing = np.zeros_like(covered)
    odds = log_odds(colour_bins(image), covered, BESIDE_PX, float(max(height, width)), tiles=1)
    if odds is None:
        return nothing
    alike = (cv2.blur(odds, (SMOOTH_PX, SMOOTH_PX)) > MIN_LOG_ODDS).astype(np.uint8)
    alike[cv2.distanceTransform(1 - covered, cv2.DIST_L2, 3) <= BESIDE_PX] = 0
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (THINNEST_PX, THINNEST_PX))
    alike = np.asarray(cv2.morphologyEx(alike, cv2.MORPH_OPEN, disc), np.uint8)
    return nothing if alike.mean() > COMMON else alike
