"""Pose errors and the rates made of them: pure, batched, float64 inside.

Poses come as ``(R_est, t_est, R_gt, t_gt)`` with shapes (N, 3, 3), (N, 3), (N, 3, 3), (N, 3), in
metres and ``T_cam_obj`` convention; object points as (V, 3). Every error is (N,). A pose that is
not finite has an infinite error: it is a miss, and no function here returns NaN.

To add an error, write one function of this form, its formula in ``docs/metrics.md`` and a test
against an independent implementation.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from dopepp.errors import UserError

AucMethod = Literal["exact", "voc"]
MATCH_DISTANCE: Final = 0.1
"""Metres between the centres of a prediction and of the instance it may be matched with."""

_CHUNK_POINTS: Final = 1 << 17
"""Transformed points held at once: 3 MB in float64, which stays in a CPU's cache."""
_ORTHOGONAL: Final = 1e-6
"""Largest |RᵀR − I| at which R counts as the rigid rotation the shared KD-tree relies on."""

_LEAF_SIZE: Final = 32
"""KD-tree leaf: fastest of 4, 8, 16, 32 at 2,000 points."""


def add(
    R_est: Float[Tensor, "n 3 3"],
    t_est: Float[Tensor, "n 3"],
    R_gt: Float[Tensor, "n 3 3"],
    t_gt: Float[Tensor, "n 3"],
    points: Float[Tensor, "v 3"],
) -> Float[Tensor, "n"]:
    """Average distance between corresponding points at both poses (ADD, paper Eq. 1), metres.

    Raises:
        ValueError: A shape is wrong or there are no points.
    """
    R_est, t_est, R_gt, t_gt, points = _checked(R_est, t_est, R_gt, t_gt, points)
    # R_est·x + t_est − R_gt·x − t_gt needs one product instead of two.
    rotation, translation = R_est - R_gt, (t_est - t_gt)[..., None]
    errors = t_est.new_empty(len(t_est))
    for chunk in _chunks(len(t_est), len(points)):
        offsets = torch.baddbmm(
            translation[chunk], rotation[chunk], points.T.expand(chunk.stop - chunk.start, 3, -1)
        )
        errors[chunk] = offsets.square_().sum(dim=1).sqrt_().mean(dim=1)
    return _nan_is_miss(errors)


def add_s(
    R_est: Float[Tensor, "n 3 3"],
    t_est: Float[Tensor, "n 3"],
    R_gt: Float[Tensor, "n 3 3"],
    t_gt: Float[Tensor, "n 3"],
    points: Float[Tensor, "v 3"],
) -> Float[Tensor, "n"]:
    """Average distance from each true point to the nearest ESTIMATED point (ADD-S), metres.

    Exact, for symmetric objects. True points are carried into the estimated object frame, where
    one KD-tree serves all poses: a rotation keeps distances. The distance itself is then taken
    in the camera frame, so that rounding in R cannot enter twice.

    Raises:
        ValueError: A shape is wrong or there are no points.
    """
    device = torch.as_tensor(t_est).device
    inputs = _checked(R_est, t_est, R_gt, t_gt, points)
    R_est, t_est, R_gt, t_gt, points = (tensor.cpu() for tensor in inputs)
    errors = torch.full((len(t_est),), torch.inf, dtype=torch.float64)
    finite = [R_est.flatten(1), t_est, R_gt.flatten(1), t_gt]
    valid = torch.cat(finite, dim=1).isfinite().all(dim=1).nonzero()[:, 0]
    tree = cKDTree(points.numpy(), leafsize=_LEAF_SIZE)
    for chunk in _chunks(len(valid), len(points)):
        rows = valid[chunk]
        true = points @ R_gt[rows].mT + (t_gt - t_est)[rows, None]
        nearest = points[_nearest(R_est[rows], true, points, tree)]
        offsets = nearest @ R_est[rows].mT - true
        errors[rows] = offsets.norm(dim=2).mean(dim=1)
    return errors.to(device)


def reprojection_error(
    R_est: Float[Tensor, "n 3 3"],
    t_est: Float[Tensor, "n 3"],
    R_gt: Float[Tensor, "n 3 3"],
    t_gt: Float[Tensor, "n 3"],
    points: Float[Tensor, "v 3"],
    K: Float[Tensor, "*n 3 3"],
) -> Float[Tensor, "n"]:
    """Average pixel distance between the points' projections at both poses.

    One K serves all poses, or each has its own. A point at or behind the camera in either pose
    makes the error infinite.

    Raises:
        ValueError: A shape is wrong or there are no points.
    """
    R_est, t_est, R_gt, t_gt, points = _checked(R_est, t_est, R_gt, t_gt, points)
    K = _float64(K)
    if K.shape[-2:] != (3, 3) or K.shape[:-2] not in ((), R_est.shape[:1]):
        raise ValueError(f"K must be (3, 3) or (N, 3, 3) of N = {len(R_est)}, got {tuple(K.shape)}")
    K = K.expand(len(R_est), 3, 3)
    errors = t_est.new_empty(len(t_est))
    for chunk in _chunks(len(t_est), len(points)):
        pixels = [
            _project(points @ R[chunk].mT + t[chunk, None], K[chunk])
            for R, t in ((R_est, t_est), (R_gt, t_gt))
        ]
        errors[chunk] = (pixels[0] - pixels[1]).norm(dim=2).mean(dim=1)
    return _nan_is_miss(errors)


def rotation_error_deg(
    R_est: Float[Tensor, "n 3 3"], R_gt: Float[Tensor, "n 3 3"]
) -> Float[Tensor, "n"]:
    """Angle of the rotation between two orientations, degrees in [0, 180].

    ``atan2(|axial vector|, trace − 1)`` keeps its digits near 0° and 180°, where arccos loses half.
    """
    Q = _float64(R_est) @ _float64(R_gt).mT
    axial = torch.stack(
        [Q[:, 2, 1] - Q[:, 1, 2], Q[:, 0, 2] - Q[:, 2, 0], Q[:, 1, 0] - Q[:, 0, 1]], dim=1
    )
    trace = Q.diagonal(dim1=1, dim2=2).sum(dim=1)
    return _nan_is_miss(torch.rad2deg(torch.atan2(axial.norm(dim=1), trace - 1)))


def translation_error(
    t_est: Float[Tensor, "n 3"], t_gt: Float[Tensor, "n 3"]
) -> Float[Tensor, "n"]:
    """Distance between the two positions of the object's origin, metres."""
    return _nan_is_miss((_float64(t_est) - _float64(t_gt)).norm(dim=1))


def auc(errors: Float[Tensor, "n"], max_threshold: float, method: AucMethod = "exact") -> float:
    """Area under the accuracy-threshold curve from 0 to ``max_threshold``, as a share of 1.

    Args:
        errors: Errors in the unit of ``max_threshold``; a miss is infinite (NaN counts as one).
        max_threshold: End of the curve, e.g. 0.1 m.
        method: ``exact`` integrates the step curve: mean(clip(1 − e / max, 0, 1)). ``voc`` is the
            YCB-Video toolbox's sum over the k of N sorted errors that are ≤ max, in which a step
            counts from its left end: (Σ (eᵢ − eᵢ₋₁)·i + (max − eₖ)·k) / (N·max), e₀ = 0. It is
            larger than ``exact`` by eₖ / (N·max).

    Returns:
        The area in [0, 1]; 0.0 without errors.

    Raises:
        UserError: The method is unknown or ``max_threshold`` is not positive.
    """
    if not max_threshold > 0:
        raise UserError(
            f"max_threshold={max_threshold}", "a positive number", "give where the curve ends"
        )
    errors = _nan_is_miss(_float64(errors))
    if method == "exact":
        values = (1 - errors / max_threshold).clamp(0, 1)
        return float(values.mean()) if len(values) else 0.0
    if method != "voc":
        raise UserError(f"auc method {method!r}", "exact, voc", "choose one of them")
    hits = errors[errors <= max_threshold].sort().values
    if len(hits) == 0:
        return 0.0
    edges = torch.cat([hits.new_zeros(1), hits, hits.new_tensor([max_threshold])])
    ranks = torch.arange(1, len(hits) + 2, dtype=torch.float64, device=hits.device)
    ranks[-1] = len(hits)
    return float(edges.diff() @ ranks) / (len(errors) * max_threshold)


def pass_rate(errors: Float[Tensor, "n"], threshold: float) -> float:
    """Share of errors strictly below ``threshold``, TP / (TP + FN); 0.0 without errors."""
    errors = _float64(errors)
    return float((errors < threshold).double().mean()) if len(errors) else 0.0


def match(
    scores: Float[Tensor, "p"],
    distances: Float[Tensor, "p g"],
    max_distance: float = MATCH_DISTANCE,
) -> Int[Tensor, "p"]:
    """Match predictions with instances one-to-one, greedily by score.

    The best-scored prediction takes its nearest instance within ``max_distance`` (inclusive), the
    next one the nearest that is left, and so on. Equal scores go in input order, equal distances
    to the first instance; a score that is NaN comes last and a distance that is NaN never matches.

    Args:
        scores: Confidence of each prediction.
        distances: Metres from each prediction (row) to each instance (column).
        max_distance: Largest distance of a match, metres.

    Returns:
        The instance of each prediction, −1 where it has none.
    """
    scores, distances = _float64(scores), _float64(distances)
    if distances.shape[0] != len(scores) or distances.ndim != 2:
        raise ValueError(f"{len(scores)} scores need as many rows, got {tuple(distances.shape)}")
    matches = torch.full((len(scores),), -1, dtype=torch.int64, device=scores.device)
    if distances.shape[1] == 0:
        return matches
    # Comparing with <= is False for NaN, so what may not match becomes infinitely far.
    free = torch.where(distances <= max_distance, distances, torch.inf)
    for prediction in scores.nan_to_num(nan=-torch.inf).argsort(descending=True, stable=True):
        nearest = free[prediction].argmin()
        if free[prediction, nearest].isfinite():
            matches[prediction] = nearest
            free[:, nearest] = torch.inf
    return matches


def _float64(array: Tensor) -> Tensor:
    return torch.as_tensor(array, dtype=torch.float64)


def _checked(
    R_est: Tensor, t_est: Tensor, R_gt: Tensor, t_gt: Tensor, points: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Cast to float64 and insist on the shapes that broadcasting would otherwise hide."""
    R_est, t_est, R_gt, t_gt, points = map(_float64, (R_est, t_est, R_gt, t_gt, points))
    n = len(t_est)
    shapes = [tuple(tensor.shape) for tensor in (R_est, t_est, R_gt, t_gt)]
    if shapes != [(n, 3, 3), (n, 3), (n, 3, 3), (n, 3)]:
        raise ValueError(f"poses must be (N, 3, 3), (N, 3), (N, 3, 3), (N, 3), got {shapes}")
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ValueError(f"points must be (V, 3) with V >= 1, got {tuple(points.shape)}")
    return R_est, t_est, R_gt, t_gt, points


def _chunks(num_poses: int, num_points: int) -> Iterator[slice]:
    step = max(1, _CHUNK_POINTS // num_points)
    return (slice(i, min(i + step, num_poses)) for i in range(0, num_poses, step))


def _nan_is_miss(errors: Tensor) -> Tensor:
    return errors.nan_to_num(nan=torch.inf, posinf=torch.inf, neginf=-torch.inf)


def _nearest(R_est: Tensor, true: Tensor, points: Tensor, tree: cKDTree) -> Tensor:
    """Index of the estimated point nearest to each true point; ``true`` is relative to t_est."""
    eye = torch.eye(3, dtype=torch.float64)
    rigid = ((R_est.mT @ R_est - eye).abs().amax(dim=(1, 2)) <= _ORTHOGONAL).numpy()
    nearest = np.empty(true.shape[:2], np.int64)
    nearest[rigid] = tree.query((true @ R_est).numpy()[rigid])[1]
    for row in np.flatnonzero(~rigid):  # scaled or skewed "rotations" change distances
        nearest[row] = cKDTree((points @ R_est[row].T).numpy()).query(true[row].numpy())[1]
    return torch.from_numpy(nearest)


def _project(points_cam: Tensor, K: Tensor) -> Tensor:
    """Project (n, v, 3) to pixels, NaN at or behind the camera."""
    depth = points_cam[..., 2:]
    rays = torch.where(depth > 0, points_cam / depth, torch.nan)
    return (rays @ K.mT)[..., :2]
