"""BOP's scores of 6D localisation: recall over the targets for three errors and their thresholds.

Targets are the instances in a list (``test_targets_bop19.json``) or, without a list, those with a
visible fraction of at least a tenth. For n targets of an object in an image, the n estimates with
the highest scores are evaluated. For each error and threshold, estimates are matched by descending
score, each with the free target of the smallest error below the threshold. AR is the mean of
AR_VSD, AR_MSSD and AR_MSPD (Hodan et al., "BOP Challenge 2020", 2020), as computed by bop_toolkit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dopepp.drawing.pictures import DepthMap, Size
from dopepp.geometry.camera import CameraMatrix, Transform
from dopepp.metrics.functional import (
    BOP_MSPD_THRESHOLDS,
    BOP_THRESHOLDS,
    add,
    add_s,
    mspd,
    mssd,
    vsd,
)
from dopepp.metrics.pose import PredictedPose, TruePose, is_evaluated
from dopepp.metrics.row import bop_points, symmetry_transforms
from dopepp.parts.part import Part

Draw = Callable[[Part, Transform, CameraMatrix, Size], DepthMap]
"""Function that renders the depth of a single part, metres, 0 outside the part."""

_STRICT: Final = 0.1  # Threshold of ADD(-S), diameters

Errors = Float[np.ndarray, "estimates targets"]


@dataclass(frozen=True)
class BopScores:
    """Scores over all targets of all objects, in [0, 1]."""

    num_targets: int  # Number of target instances
    ar_vsd: float | None  # Average recall of VSD; None if an image has no depth or a part no mesh
    ar_mssd: float  # Average recall of MSSD
    ar_mspd: float  # Average recall of MSPD
    ar: float | None  # Mean of AR_VSD, AR_MSSD and AR_MSPD; None without AR_VSD
    add_or_s_01d: float  # Recall of ADD (ADD-S for symmetric parts) below a tenth of the diameter

    def in_words(self) -> str:
        """Return the scores as one line of text."""

        def percent(share: float | None) -> str:
            return "n/a" if share is None else f"{share:.1%}"

        return (
            f"BOP, {self.num_targets:,} targets: AR {percent(self.ar)} (VSD {percent(self.ar_vsd)},"
            f" MSSD {percent(self.ar_mssd)}, MSPD {percent(self.ar_mspd)}), "
            f"ADD(-S)-0.1d {percent(self.add_or_s_01d)}"
        )


class Localisation:
    """Accumulates pose errors, image by image, for BOP's localisation scores.

    VSD needs ``draw``, the renderer of a part's depth.
    """

    def __init__(self, parts: Sequence[Part], draw: Draw | None = None) -> None:
        self._parts = {part.name: part for part in parts}
        self._draw = draw
        self._groups: list[_Group] = []

    def update(
        self,
        detections: Sequence[PredictedPose],
        instances: Sequence[TruePose],
        K: CameraMatrix,
        size: Size,
        depth: DepthMap | None = None,
    ) -> None:
        """Add the detections, ground truth and measured depth (metres) of an image of ``size``."""
        for part in self._parts.values():
            true = [i.T_cam_obj for i in instances if i.label == part.name and is_evaluated(i)]
            candidates = (d for d in detections if d.object == part.name)
            ranked = sorted(candidates, key=lambda detection: -detection.score)
            estimated = [detection.T_cam_obj for detection in ranked[: len(true)]]
            if not true:
                continue
            group = _errors(part, np.array(estimated).reshape(-1, 4, 4), np.array(true), K, size[0])
            if self._draw is not None and depth is not None and part.mesh is not None:
                depths_est, depths_gt = (
                    [self._draw(part, T, K, size) for T in poses] for poses in (estimated, true)
                )
                rows = [[vsd(e, t, depth, K, part.diameter) for t in depths_gt] for e in depths_est]
                group.vsd = np.array(rows).reshape(len(estimated), len(true), len(BOP_THRESHOLDS))
            self._groups.append(group)

    def scores(self) -> BopScores | None:
        """Return the scores over all images, or None without targets."""
        if not self._groups:
            return None
        num_targets = sum(group.mssd.shape[1] for group in self._groups)

        def recall(errors: Sequence[Errors], threshold: float) -> float:
            return float(sum(num_matched(table, threshold) for table in errors) / num_targets)

        def average(errors: Sequence[Errors], thresholds: Sequence[float]) -> float:
            return float(np.mean([recall(errors, threshold) for threshold in thresholds]))

        ar_mssd = average([group.mssd for group in self._groups], BOP_THRESHOLDS)
        ar_mspd = average([group.mspd for group in self._groups], BOP_MSPD_THRESHOLDS)
        ar_vsd = None
        tables = [group.vsd for group in self._groups if group.vsd is not None]
        if len(tables) == len(self._groups):
            by_tolerance = zip(*(np.moveaxis(table, -1, 0) for table in tables), strict=True)
            ar_vsd = float(np.mean([average(errors, BOP_THRESHOLDS) for errors in by_tolerance]))
        return BopScores(
            num_targets=num_targets,
            ar_vsd=ar_vsd,
            ar_mssd=ar_mssd,
            ar_mspd=ar_mspd,
            ar=None if ar_vsd is None else (ar_vsd + ar_mssd + ar_mspd) / 3,
            add_or_s_01d=recall([group.add_or_s for group in self._groups], _STRICT),
        )


def num_matched(errors: Errors, threshold: float) -> int:
    """Count the targets matched with an error below a threshold.

    Each estimate, a row by descending score, is matched with the free target of smallest error.
    """
    free = np.ones(errors.shape[1], bool)
    for row in errors:
        free_errors = np.where(free, row, np.inf)
        nearest = int(free_errors.argmin())
        if free_errors[nearest] < threshold:
            free[nearest] = False
    return int((~free).sum())


@dataclass
class _Group:
    """Errors between all estimates and targets of an object in an image.

    ``mssd`` and ``add_or_s`` are in diameters, ``mspd`` in pixels of an image 640 wide.
    """

    mssd: Errors
    mspd: Errors
    add_or_s: Errors
    vsd: Float[np.ndarray, "estimates targets tolerances"] | None = None


def _errors(
    part: Part,
    estimated: Float[np.ndarray, "estimates 4 4"],
    true: Float[np.ndarray, "targets 4 4"],
    K: CameraMatrix,
    width: int,
) -> _Group:
    """Compute MSSD, MSPD and ADD(-S) between all estimates and targets over the mesh's vertices."""
    shape = len(estimated), len(true)
    T_est = torch.from_numpy(np.repeat(estimated.astype(np.float64), shape[1], axis=0))
    T_gt = torch.from_numpy(np.tile(true.astype(np.float64), (shape[0], 1, 1)))
    poses = T_est[:, :3, :3], T_est[:, :3, 3], T_gt[:, :3, :3], T_gt[:, :3, 3]
    vertices, group = bop_points(part), symmetry_transforms(part)
    cameras = torch.from_numpy(np.asarray(K, np.float64)).expand(len(T_est), 3, 3)
    average = add_s if len(group) > 1 else add

    def table(errors: Tensor) -> Errors:
        return np.asarray(errors.numpy().reshape(shape))

    return _Group(
        mssd=table(mssd(*poses, vertices, group)) / part.diameter,
        mspd=table(mspd(*poses, vertices, cameras, group)) * (640 / width),
        add_or_s=table(average(*poses, vertices)) / part.diameter,
    )
