"""Search for an instance's pose in the belief maps, without peaks and their association.

In a heap, many corners are hidden or lie beside the corners of other parts, so an instance often
has too few peaks for PnP, although its centroid is visible. At a centroid peak, the search tries
sampled rotations at several depths. The best pose has the highest sum of the logarithms of the
beliefs at the projected corners. A corner without belief reduces this sum only a little, and no
corner peak has to be assigned to an instance. With several images of a static scene, the sum is
over the keypoints in all images.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
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

MIN_BELIEF: Final = 0.3  # belief of a centroid's peak from which a pose is searched
ROTATION_DEVIATION: Final = 0.3  # standard deviation of a searched rotation, radians
DEPTH_DEVIATION: Final = 0.08  # standard deviation of a searched depth, share of the depth
CENTROID_DEVIATION: Final = 0.4  # standard deviation of a centroid peak's position, cells
STEP: Final = 0.17  # largest difference between the logarithms of neighbouring depths
JOINT_STEP: Final = 0.04  # the same on several images, which together determine the depth

_NUM_ROTATIONS: Final = 6000  # neighbours are about 12° apart
_FLOOR: Final = 0.02  # belief added before the logarithm, for corners without belief


@dataclass(frozen=True, eq=False)
class PosedMaps:
    """Belief maps of an object on an image, and the pose of the camera."""

    belief: Beliefs
    K: CameraMatrix  # camera matrix of the network's input, pixels
    stride: int  # pixels of the network's input per cell of the maps
    T_cam_world: Transform

    @property
    def projection(self) -> Float[np.ndarray, "3 4"]:
        """Matrix from homogeneous points in the world to homogeneous cells."""
        half = (self.stride - 1) / 2
        in_cells = np.array([[1.0, 0.0, -half], [0.0, 1.0, -half], [0.0, 0.0, self.stride]])
        return np.asarray(in_cells @ self.K @ self.T_cam_world[:3])


class PoseSearch:
    """Searches the poses of an object's instances in its belief maps on one or several images.

    Args:
        maps: Belief maps of the object on each image.
        cuboid: Keypoints of the part, object frame, metres.
    """

    def __init__(self, maps: Sequence[PosedMaps], cuboid: Cuboid) -> None:
        self._cuboid, self._image = cuboid, maps[0]
        rows, columns = np.max([item.belief.shape[1:] for item in maps], axis=0)
        self._gains = np.zeros((len(maps), NUM_KEYPOINTS, rows, columns), np.float32)
        for gains, item in zip(self._gains, maps, strict=True):
            gains[:, : item.belief.shape[1], : item.belief.shape[2]] = np.log1p(
                np.maximum(item.belief, 0.0) / _FLOOR  # 0 without belief
            )
        self._projections = np.stack([item.projection for item in maps])
        arms = (cuboid - cuboid[CENTROID]) @ _rotations().transpose(0, 2, 1)
        self._arms = arms @ self._projections[:, None, :, :3].transpose(0, 1, 3, 2)

    def pose(self, centres: Float[np.ndarray, "centres 3"]) -> Transform:
        """Return T_world_obj (metres) with the highest sum of log beliefs at the keypoints.

        ``centres`` are tried positions of the centroid in the world, metres.
        """
        projected = centres @ self._projections[:, :, :3].transpose(0, 2, 1)
        projected += self._projections[:, None, :, 3]
        number, rank = _search(self._gains, self._arms, projected)
        rotation = _rotations()[number]
        return make_transform(rotation, centres[rank] - rotation @ self._cuboid[CENTROID])

    def solve(
        self, group: KeypointGroup, peaks: ObjectPeaks, depths: Depths
    ) -> tuple[KeypointGroup, PnPResult]:
        """Return an instance's searched pose in place of PnP's, with the keypoints that agree.

        The world is the frame of the first image's camera.

        Args:
            group: Keypoints of the instance on the first image; only the centroid is used.
            peaks: All peaks of the object on the first image.
            depths: Range of the searched depths of the centroid, metres.

        Returns:
            The centroid and, for each corner, the nearest peak within a cell of its projection;
            and the searched pose with its covariance and reprojection error.
        """
        K, stride = self._image.K, self._image.stride
        T_cam_obj = self.pose(centres_on_ray(group.position[CENTROID], K, depths))
        projected = project_keypoints(self._cuboid, T_cam_obj, K)
        distances = np.linalg.norm(peaks.position - projected[:NUM_CORNERS, None], axis=2)
        distances[np.isnan(distances)] = math.inf
        points, scores = np.full((NUM_KEYPOINTS, 2), np.nan), np.zeros(NUM_KEYPOINTS)
        points[CENTROID], scores[CENTROID] = group.position[CENTROID], group.score[CENTROID]
        for corner, nearest in enumerate(distances.argmin(axis=1)):
            if distances[corner, nearest] < stride:
                points[corner] = peaks.position[corner, nearest]
                scores[corner] = peaks.score[corner, nearest]
        result = PnPResult(
            T_cam_obj,
            math.sqrt(np.nanmean(((points - projected) ** 2).sum(axis=1))),
            np.isfinite(points[:, 0]),
            covariance=search_covariance(T_cam_obj, self._cuboid, focal_length(K), stride),
        )
        return KeypointGroup(points, scores, group.covariance_px), result


def centres_on_ray(
    centroid: Float[np.ndarray, "2"], K: CameraMatrix, depths: Depths, step: float = STEP
) -> Float[np.ndarray, "centres 3"]:
    """Return positions on a pixel's line of sight, camera frame, metres.

    Args:
        centroid: (x, y) of a centroid's peak, pixels.
        K: Camera matrix, pixels.
        depths: Nearest and farthest depth.
        step: Largest difference between logarithms of neighbouring depths.
    """
    near, far = depths
    tried = np.geomspace(near, far, math.ceil(math.log(far / near) / step) + 1)
    return np.asarray(tried[:, None] * np.linalg.solve(K, np.array([*centroid, 1.0])))


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
def _search(gains: Array, arms: Array, centres: Array) -> tuple[int, int]:
    """Return the indices of the rotation and of the centre with the highest sum over the keypoints.

    Args:
        gains: Log beliefs (image, keypoint, row, column).
        arms: Vectors from the centroid to the keypoints (image, rotation, keypoint, 3), after the
            image's projection to cells.
        centres: Projected positions of the centroid (image, centre, 3).
    """
    rows, columns = gains.shape[2:]
    best, number, rank = -math.inf, 0, 0
    for n in range(centres.shape[1]):
        for r in range(arms.shape[1]):
            total = 0.0
            for view in range(len(gains)):
                x, y, z = centres[view, n]
                for k in range(arms.shape[2]):
                    depth = z + arms[view, r, k, 2]
                    if not depth > 0:
                        continue
                    u = (x + arms[view, r, k, 0]) / depth
                    v = (y + arms[view, r, k, 1]) / depth
                    j, i = math.floor(u), math.floor(v)
                    if i < 0 or j < 0 or i >= rows - 1 or j >= columns - 1:
                        continue
                    u, v = u - j, v - i
                    gain = gains[view, k]
                    upper = (1 - u) * gain[i, j] + u * gain[i, j + 1]
                    lower = (1 - u) * gain[i + 1, j] + u * gain[i + 1, j + 1]
                    total += (1 - v) * upper + v * lower
            if total > best:
                best, number, rank = total, r, n
    return number, rank
