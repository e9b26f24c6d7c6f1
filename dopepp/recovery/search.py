"""Search for an instance's pose in the belief maps, without peaks and their association.

In a heap, many corners are hidden or lie beside the corners of other parts, so an instance often
has too few peaks for PnP, although its centroid is visible. At a centroid peak, the search tries
sampled rotations at several depths. The best pose has the highest sum of the logarithms of the
beliefs at the projected corners. A corner without belief reduces this sum only a little, and no
corner peak has to be assigned to an instance.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.camera import (
    CameraMatrix,
    Transform,
    focal_length,
    make_transform,
    project_keypoints,
    rotation_lever,
)
from dopepp.geometry.cuboid import CENTROID, NUM_CORNERS, NUM_KEYPOINTS, Cuboid
from dopepp.geometry.pnp import PnPResult
from dopepp.geometry.rotation import Vector
from dopepp.recovery.association import KeypointGroup, ObjectPeaks

Beliefs = Float[np.ndarray, "9 height width"]
Depths = tuple[float, float]  # nearest and farthest depth, metres

CLEAR: Final = 0.3  # belief of a centroid's peak from which a pose is searched
ROTATION_DEVIATION: Final = 0.3  # standard deviation of a searched rotation, radians
DEPTH_DEVIATION: Final = 0.08  # standard deviation of a searched depth, share of the depth
CENTROID_DEVIATION: Final = 0.4  # standard deviation of a centroid peak's position, cells

_NUM_ROTATIONS: Final = 6000  # neighbours are about 12° apart
_STEP: Final = 0.17  # largest difference between the logarithms of neighbouring depths
_FLOOR: Final = 0.02  # belief added before the logarithm, for corners without belief


class PoseSearch:
    """Searches the poses of an object's instances in its belief maps.

    Args:
        belief: Belief maps of the object.
        cuboid: Keypoints of the part, object frame, metres.
        K: Camera matrix of the network's input, pixels.
        stride: Input pixels per cell of the maps.
        depths: Range of the searched depths of a centroid, metres.
    """

    def __init__(
        self, belief: Beliefs, cuboid: Cuboid, K: CameraMatrix, stride: int, depths: Depths
    ) -> None:
        self._cuboid, self._K, self._stride = cuboid, K, stride
        near, far = depths
        self._depths = np.geomspace(near, far, math.ceil(math.log(far / near) / _STEP) + 1)
        gains = np.log1p(np.maximum(belief[:NUM_CORNERS], 0.0) / _FLOOR)  # 0 without belief
        self._gains = np.asarray(gains, np.float32)
        self._arms = (cuboid[:NUM_CORNERS] - cuboid[CENTROID]) @ _rotations().transpose(0, 2, 1)

    def pose(self, centroid: Float[np.ndarray, "2"]) -> Transform:
        """Return T_cam_obj (metres) with the highest sum of log beliefs at the projected corners.

        The centroid is projected to ``centroid``, (x, y) of its peak, input pixels.
        """
        ray = np.linalg.solve(self._K, np.array([*centroid, 1.0]))
        number, rank = _search(
            self._gains, self._arms, ray, self._depths, self._K, float(self._stride)
        )
        rotation = _rotations()[number]
        centre = self._depths[rank] * ray
        return make_transform(rotation, centre - rotation @ self._cuboid[CENTROID])

    def solve(self, group: KeypointGroup, peaks: ObjectPeaks) -> tuple[KeypointGroup, PnPResult]:
        """Return an instance's searched pose in place of PnP's, with the keypoints that agree.

        Args:
            group: Keypoints of the instance, of which only the centroid is used.
            peaks: All peaks of the object.

        Returns:
            The centroid and, for each corner, the nearest peak within a cell of its projection;
            and the searched pose with its covariance and reprojection error.
        """
        T_cam_obj = self.pose(group.position[CENTROID])
        projected = project_keypoints(self._cuboid, T_cam_obj, self._K)
        distances = np.linalg.norm(peaks.position - projected[:NUM_CORNERS, None], axis=2)
        distances[np.isnan(distances)] = math.inf
        points, scores = np.full((NUM_KEYPOINTS, 2), np.nan), np.zeros(NUM_KEYPOINTS)
        points[CENTROID], scores[CENTROID] = group.position[CENTROID], group.score[CENTROID]
        for corner, nearest in enumerate(distances.argmin(axis=1)):
            if distances[corner, nearest] < self._stride:
                points[corner] = peaks.position[corner, nearest]
                scores[corner] = peaks.score[corner, nearest]
        result = PnPResult(
            T_cam_obj,
            math.sqrt(np.nanmean(((points - projected) ** 2).sum(axis=1))),
            np.isfinite(points[:, 0]),
            covariance=search_covariance(
                T_cam_obj, self._cuboid, focal_length(self._K), self._stride
            ),
        )
        return KeypointGroup(points, scores, group.covariance_px), result


def search_covariance(T_cam_obj: Transform, cuboid: Cuboid, focal_px: float, stride: int) -> Array:
    """Return the covariance of a searched pose, in the form of ``Detection.covariance``.

    Args:
        T_cam_obj: Searched pose, metres.
        cuboid: Keypoints of the part, object frame, metres.
        focal_px: Focal length of the network's input, pixels.
        stride: Input pixels per cell of the maps.
    """
    arm = T_cam_obj[:3, :3] @ cuboid[CENTROID]
    centre: Vector = T_cam_obj[:3, 3] + arm
    depth, along = float(centre[2]), centre / np.linalg.norm(centre)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = ROTATION_DEVIATION**2 * np.eye(3)
    covariance[3:, 3:] = (CENTROID_DEVIATION * stride * depth / focal_px) ** 2 * np.eye(3)
    covariance[3:, 3:] += (DEPTH_DEVIATION * depth) ** 2 * np.outer(along, along)
    # The rotation's error is about the centroid, whose position is measured, but the covariance
    # refers to the object's origin.
    lever = rotation_lever(-arm)
    return np.asarray(lever @ covariance @ lever.T)


@cache
def _rotations() -> Float[np.ndarray, "rotations 3 3"]:
    """Return rotations that are spread evenly (super-Fibonacci sampling, Alexa, CVPR 2022)."""
    step = np.arange(_NUM_ROTATIONS) + 0.5
    share = step / _NUM_ROTATIONS
    first, second = 2 * np.pi * step / math.sqrt(2), 2 * np.pi * step / 1.533751168755204288118041
    small, large = np.sqrt(share), np.sqrt(1 - share)
    parts = small * np.sin(first), small * np.cos(first), large * np.sin(second)
    quaternions = np.stack([*parts, large * np.cos(second)], axis=1)
    return np.asarray(Rotation.from_quat(quaternions).as_matrix())


@compiled()
def _search(
    gains: Array, arms: Array, ray: Array, depths: Array, K: Array, stride: float
) -> tuple[int, int]:
    """Return the indices of the rotation and of the depth with the highest sum of gains.

    Args:
        gains: Logarithm of each corner's belief, 0 without belief, (8, height, width).
        arms: Vectors from the centroid to the corners under each rotation, metres,
            (rotations, 8, 3).
        ray: Point of the centroid's viewing ray at a depth of one metre, camera frame, (3,).
        depths: Tried depths of the centroid, metres.
        K: Camera matrix of the network's input, pixels.
        stride: Input pixels per cell.
    """
    rows, columns = gains.shape[1:]
    half = (stride - 1) / 2
    best, number, rank = -math.inf, 0, 0
    for n in range(len(depths)):
        x, y, z = depths[n] * ray[0], depths[n] * ray[1], depths[n] * ray[2]
        for r in range(len(arms)):
            total = 0.0
            for k in range(arms.shape[1]):
                depth = z + arms[r, k, 2]
                if not depth > 0:
                    continue
                a, b = (x + arms[r, k, 0]) / depth, (y + arms[r, k, 1]) / depth
                u = (K[0, 0] * a + K[0, 1] * b + K[0, 2] - half) / stride
                v = (K[1, 1] * b + K[1, 2] - half) / stride
                j, i = math.floor(u), math.floor(v)
                if i < 0 or j < 0 or i >= rows - 1 or j >= columns - 1:
                    continue
                u, v = u - j, v - i
                upper = (1 - u) * gains[k, i, j] + u * gains[k, i, j + 1]
                lower = (1 - u) * gains[k, i + 1, j] + u * gains[k, i + 1, j + 1]
                total += (1 - v) * upper + v * lower
            if total > best:
                best, number, rank = total, r, n
    return number, rank
