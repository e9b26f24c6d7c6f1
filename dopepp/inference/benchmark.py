"""Measurements of estimators on images: time per frame, and agreement of an exported network."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle, islice
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix
from dopepp.geometry.rotation import rotation_angle
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.network_estimator import NetworkEstimator
from dopepp.inference.network_input import network_views
from dopepp.inference.pose_result import STEPS

WARM_UP: Final = 3
"""Number of frames after the first that are not timed: they allocate memory and select kernels."""

# Largest differences of maps (relative), positions and rotations that rounding in float32 causes.
MAX_MAPS: Final = 1e-4
MAX_MM: Final = 0.1
MAX_DEG: Final = 0.05

CameraImages = Sequence[tuple[RGBImage, CameraMatrix]]
"""Images with their camera matrices."""


@dataclass(frozen=True)
class Timing:
    """Measured times per frame, milliseconds, and mean number of detected poses."""

    first: float  # first frame after loading
    frame: Float[np.ndarray, "frames"]  # each later frame, from image to poses
    steps: dict[str, Float[np.ndarray, "frames"]]  # time of each step
    num_found: float  # mean number of poses per frame


def time_frames(estimator: PoseEstimator, images: CameraImages, num_frames: int) -> Timing:
    """Time a newly loaded estimator on ``num_frames`` frames (cycled images) after a warm-up."""
    rows, num_found = [], []
    for image, K in islice(cycle(images), 1 + WARM_UP + num_frames):
        before, start = estimator.spent_ms.copy(), time.perf_counter()
        num_found.append(len(estimator.predict(image, K, cropped=True)))
        frame = 1000 * (time.perf_counter() - start)
        rows.append([frame, *(estimator.spent_ms[step] - before[step] for step in STEPS)])
    frame, *steps = np.array(rows[1 + WARM_UP :]).T
    by_step = dict(zip(STEPS, steps, strict=True))
    return Timing(rows[0][0], frame, by_step, float(np.mean(num_found)))


@dataclass(frozen=True)
class ExportAgreement:
    """Largest differences of maps and poses between an exported network and the original."""

    maps: float  # difference of a map value, divided by the largest value (at least 1)
    position_mm: float
    rotation_deg: float
    num_poses: int  # best-scored poses that both networks detect
    num_single: int  # best-scored poses that only one network detects
    num_images: int

    @property
    def is_exact(self) -> bool:
        """Whether all differences are within ``MAX_MAPS``, ``MAX_MM`` and ``MAX_DEG``."""
        close = self.maps <= MAX_MAPS and self.position_mm <= MAX_MM
        return close and self.rotation_deg <= MAX_DEG and not self.num_single

    def __str__(self) -> str:
        poses = "no pose detected by both"
        if self.num_poses:
            difference = f"{self.position_mm:.3g} mm and {self.rotation_deg:.3g}°"
            poses = f"{self.num_poses} poses within {difference}"
        single = f", {self.num_single} detected by one network only" if self.num_single else ""
        return f"maps within {self.maps:.1e}, {poses}{single}, on {self.num_images} images"


def compare_export(
    exported: NetworkEstimator, original: NetworkEstimator, images: CameraImages
) -> ExportAgreement:
    """Compare maps, and the best-scored pose of each object on each image.

    Poses with lower scores are ignored, because rounding decides between equal scores in clutter.
    """
    maps, differences, num_single = [0.0], [(0.0, 0.0)], 0
    for image, K in images:
        for view in network_views(original.checkpoint, original.network.size_multiple, image, K):
            pairs = zip(exported.maps(view.pixels), original.maps(view.pixels), strict=True)
            for values, expected in pairs:
                scale = expected.abs().max().clamp(min=1.0)
                largest = float((values - expected).abs().max() / scale)
                maps.append(largest if math.isfinite(largest) else math.inf)
        # Detections are sorted by score: in reverse order, an object's best overwrites the others.
        poses, expected_poses = (
            {
                detection.object: detection.T_cam_obj
                for detection in reversed(estimator.predict(image, K, cropped=True))
            }
            for estimator in (exported, original)
        )
        for name in poses.keys() & expected_poses.keys():
            T, U = poses[name], expected_poses[name]
            degrees = math.degrees(float(rotation_angle(T[:3, :3].T @ U[:3, :3])))
            differences.append((1000 * float(np.linalg.norm(T[:3, 3] - U[:3, 3])), degrees))
        num_single += len(poses.keys() ^ expected_poses.keys())
    positions, rotations = zip(*differences, strict=True)
    largest_pose = max(positions), max(rotations)
    return ExportAgreement(max(maps), *largest_pose, len(differences) - 1, num_single, len(images))
