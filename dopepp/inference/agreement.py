"""How far an exported network's maps and poses are from the original's on the same pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch

from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import CameraMatrix
from dopepp.geometry.rotation import rotation_angle
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.picture import letterboxed, letterboxes
from dopepp.recovery.detection import Detection

MAX_MAPS: Final = 1e-4
MAX_MM: Final = 0.1
MAX_DEG: Final = 0.05  # what float32 of another runtime may change: maps, positions and rotations


@dataclass(frozen=True)
class Agreement:
    """The largest differences, and how many poses they are of."""

    maps: float  # of a value of a map, as a share of the largest one's size where that is over 1
    position_mm: float  # of a position, millimetres
    rotation_deg: float  # of a rotation, degrees
    num_poses: int  # best-scored poses that both found
    num_single: int  # those that only one of them found
    num_pictures: int  # pictures they looked at

    @property
    def is_exact(self) -> bool:
        """Whether nothing differs by more than float32's rounding may bring about."""
        close = self.maps <= MAX_MAPS and self.position_mm <= MAX_MM
        return close and self.rotation_deg <= MAX_DEG and not self.num_single

    def __str__(self) -> str:
        words = f"maps within {self.maps:.1e}"
        if self.num_poses:
            words += (
                f", {self.num_poses} poses within {self.position_mm:.3g} mm "
                f"and {self.rotation_deg:.3g}°"
            )
        else:
            words += ", no pose found by both"
        single = f", {self.num_single} found by one alone" if self.num_single else ""
        return f"{words}{single}, on {self.num_pictures} pictures"


def compare(
    exported: PoseEstimator,
    original: PoseEstimator,
    pictures: Sequence[tuple[Picture, CameraMatrix]],
) -> Agreement:
    """Compare maps and poses on pictures with their camera matrices.

    Of each object, a picture's best-scored pose: what a network sees in clutter beside the parts
    may lie on the brink of two poses, and float32's rounding decides which.
    """
    maps, apart, num_single = [0.0], [(0.0, 0.0)], 0
    for picture, K in pictures:
        for box in letterboxes(original.checkpoint, K, picture):
            pixels = letterboxed(picture, box, original.network.size_multiple)
            for one, other in zip(exported.maps(pixels), original.maps(pixels), strict=True):
                maps.append(_difference(one, other))
        ours, theirs = (
            _best(each.predict(picture, K, cropped=True)) for each in (original, exported)
        )
        apart += [_apart(ours[name], theirs[name]) for name in ours.keys() & theirs.keys()]
        num_single += len(ours.keys() ^ theirs.keys())
    positions, rotations = zip(*apart, strict=True)
    return Agreement(
        max(maps), max(positions), max(rotations), len(apart) - 1, num_single, len(pictures)
    )


def _difference(one: torch.Tensor, other: torch.Tensor) -> float:
    """Return the largest difference of two maps; infinite where one is not finite."""
    largest = float((one - other).abs().max() / other.abs().max().clamp(min=1.0))
    return largest if math.isfinite(largest) else math.inf


def _best(found: Sequence[Detection]) -> dict[str, Detection]:
    """Return each object's best-scored detection; they are given in that order."""
    return {one.object: one for one in reversed(found)}


def _apart(one: Detection, other: Detection) -> tuple[float, float]:
    """Return how far two poses are apart, millimetres and degrees."""
    T, U = one.T_cam_obj, other.T_cam_obj
    angle = rotation_angle(T[:3, :3].T @ U[:3, :3])
    return 1000 * float(np.linalg.norm(T[:3, 3] - U[:3, 3])), math.degrees(float(angle))
