"""VSD: how much of the surface that a camera can see is elsewhere at an estimated pose (BOP)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from dopepp.geometry.camera import CameraMatrix
from dopepp.metrics.functional.rates import BOP_THRESHOLDS

VSD_DELTA: Final = 0.015
"""Metres by which a surface may lie behind what a depth camera has measured and still be seen."""

Depths = Float[np.ndarray, "height width"]


def vsd(
    depth_est: Depths,
    depth_gt: Depths,
    depth: Depths,
    K: CameraMatrix,
    diameter: float,
    delta: float = VSD_DELTA,
    tolerances: Sequence[float] = BOP_THRESHOLDS,
) -> Float[np.ndarray, "tolerances"]:
    """Visible surface discrepancy, in [0, 1], one for each tolerance (Hodan et al. 2018; BOP 2019).

    Of the pixels that show the object at one of the two poses, that is the share that shows it at
    one of them only, or at distances from the camera that differ by a tolerance or more.

    Args:
        depth_est: Depth of the object alone at the estimated pose, metres along z, 0 beside it.
        depth_gt: The same at the true pose.
        depth: What a depth camera has measured, 0 where it has nothing: there a surface is seen.
        K: Camera matrix, pixels.
        diameter: Of the object, metres.
        delta: Metres by which a surface that is seen may lie behind what was measured.
        tolerances: In diameters.
    """
    rays = _ray_lengths(K, depth.shape)
    measured, estimated, true = rays * depth, rays * depth_est, rays * depth_gt
    seen_gt = _seen(true, measured, delta)
    seen_est = _seen(estimated, measured, delta) | (seen_gt & (estimated > 0))
    either, both = seen_gt | seen_est, seen_gt & seen_est
    num_either = int(either.sum())
    if not num_either:
        return np.ones(len(tolerances))
    apart = np.abs(true - estimated)[both] / diameter
    wrong = [int((apart >= tolerance).sum()) for tolerance in tolerances]
    return np.array([(n + num_either - int(both.sum())) / num_either for n in wrong])


def _ray_lengths(K: CameraMatrix, shape: tuple[int, ...]) -> Depths:
    """Return the distance of every pixel's point at depth 1, metres."""
    rows, columns = np.indices(shape)
    rays = np.linalg.solve(K, np.stack([columns.ravel(), rows.ravel(), np.ones(rows.size)]))
    return np.asarray(np.linalg.norm(rays / rays[2], axis=0).reshape(shape))


def _seen(distance: Depths, measured: Depths, delta: float) -> Bool[np.ndarray, "height width"]:
    """Tell where a surface is seen: not behind what was measured, or nothing was."""
    return np.asarray((distance > 0) & ((distance - measured <= delta) | (measured == 0)))
