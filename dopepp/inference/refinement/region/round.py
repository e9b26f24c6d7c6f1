"""One round of refinement on the image: its crop, learned colours, outline term and final check.

Search distances (``reach``) are passed in pixels of the full image; :meth:`Round.reach` converts
them to a stage's share in pixels of its crop.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from dopepp.geometry.camera import Transform
from dopepp.inference.refinement.colour import EDGE_PX, Crop, log_odds
from dopepp.inference.refinement.outline import (
    Contour,
    OutlineMesh,
    PosedMesh,
    filled_mask,
    find_contour,
    outline_rows,
    posed,
)
from dopepp.inference.refinement.region.shared_errors import (
    INDEPENDENT_PX,
    MIN_INFORMATION,
    SCALE_ERROR,
    region_terms,
)
from dopepp.inference.refinement.region.shifts import FOLLOWED, Shifts, Weights, find_shifts
from dopepp.inference.refinement.solver import (
    NormalEquations,
    PoseMatrix,
    Prior,
    Solution,
    Term,
    UndecidedError,
    descend,
)

RING: Final = 0.2  # width of the part's surroundings, share of its extent
SAMPLES: Final = 7  # steps on each side of a normal, which are 1 to 4 pixels
MIN_POINTS: Final = 24  # smallest number of outline points that determine a pose

MIN_GAIN: Final = 2.0
"""Smallest increase of the information's log determinant; below it, the image is uninformative."""

PRECISE: Final = (math.radians(1.0), 5e-3)
"""Standard deviations of a precise pose: radians, and metres per metre of distance."""

MIN_AGREEING: Final = 0.3  # smallest agreement of a refined outline that is accepted
AGREE_PX: Final = 2.0  # largest distance from the image's outline of a point that agrees

INFORMATIVE: Final = 0.1  # pixels⁻²: smallest information of a point that counts as support

FARTHEST: Final = 4.5
"""Largest Mahalanobis distance of a refined pose from the prior's pose, in six dimensions."""


@dataclass(frozen=True)
class RegionStage:
    """Settings of one round of refinement."""

    longest_px: int  # length of the part above which the image is shrunk, pixels
    reach: float  # share of the refinement's search distance that this round covers
    steps: int  # Gauss–Newton steps
    points: int  # approximate number of points on the outline
    tiles: int  # tiles along each side of the part, each with its own colours


@dataclass(frozen=True)
class OutlineAgreement:
    """Agreement of a refined outline with the image."""

    share: float  # agreeing share of the image's information about the outline
    # Share of the outline with agreeing information, in [0, 1]: occluded points, and points in
    # front of a background of the part's colour, have no information
    support: float


Odds = Float32[np.ndarray, "height width"]  # log odds that each pixel shows the part
Silhouette = tuple[PosedMesh, UInt8[np.ndarray, "height width"]]  # posed mesh and its mask


@dataclass(eq=False)
class Round:
    """A round of refinement on a crop, with the learned colours of part and surroundings."""

    mesh: OutlineMesh  # mesh of the part
    crop: Crop  # image around the part, at the stage's resolution
    stage: RegionStage  # settings of the round
    weights: Weights  # weights of colours and edges
    further_terms: Sequence[Term] = ()  # solver terms in addition to the outline
    scale_error: float = SCALE_ERROR  # largest relative error of the outline's scale

    def __post_init__(self) -> None:
        self._spacing = max(1.5, 3.0 * self.crop.extent / self.stage.points)
        self._odds: Odds = np.zeros(self.crop.size[::-1], np.float32)
        self._smooth_odds = self._odds
        self._last: tuple[Transform, Silhouette | None] = np.empty((0, 0)), None

    def learn(self, pose: Transform, reach: float) -> None:
        """Learn colours in and around the outline; ``reach`` is the search distance, image pixels.

        Raises:
            UndecidedError: Too few pixels are visible.
        """
        silhouette = self._silhouette(pose)
        reach, ring = self.reach(reach), RING * self.crop.extent
        odds = None
        if silhouette is not None:
            odds = log_odds(self.crop.bins, silhouette[1], 0.5 * reach, ring, self.stage.tiles)
        if odds is None:
            raise UndecidedError("too few pixels of the part and around it are on the image")
        self._odds = self._smooth_odds = odds
        step = round(_step(reach))
        if step >= 2:
            self._smooth_odds = cv2.blur(odds, (step, step))

    def contour(self, pose: Transform) -> Contour | None:
        """Return the outline at a pose; None if too little of it is on the image."""
        silhouette = self._silhouette(pose)
        if silhouette is None:
            return None
        contour = find_contour(self.mesh, *silhouette, self._spacing)
        return contour if len(contour) >= MIN_POINTS else None

    def descend(self, start: Transform, prior: Prior, reach: float) -> Solution:
        """Take the stage's Gauss–Newton steps; ``reach`` is the search distance, image pixels.

        Raises:
            UndecidedError: The outline leaves the image.
        """
        # The outline term is last, because its scale error depends on the sum of all other terms.
        end = descend(start, prior, [*self.further_terms, self.term(reach)], self.stage.steps)
        if end is None:
            raise UndecidedError("the part's outline left the image")
        return end

    def term(self, reach: float) -> Term:
        """Return the solver term of the outline, for the colours learned last."""

        def outline(pose: Transform, prior: NormalEquations) -> NormalEquations | None:
            contour = self.contour(pose)
            if contour is None:
                return None
            rows = outline_rows(contour, pose, self.crop.K)
            shifts = self._shifts(contour, reach)
            spacing, extent, position = self._spacing, self.crop.extent, pose[:3, 3].copy()
            return region_terms(rows, shifts, prior, spacing, extent, position, self.scale_error)

        return outline

    def log_likelihood(self, pose: Transform, prior: Prior) -> float:
        """Return a pose's log probability from learned colours and prior, up to a constant."""
        silhouette = self._silhouette(pose)
        if silhouette is None:
            return -math.inf
        inside = float(self._odds.ravel() @ silhouette[1].ravel())
        inside *= self.weights.colour / INDEPENDENT_PX
        return inside - 0.5 * prior.squared_distance(pose)

    def agreement(self, pose: Transform, reach: float) -> OutlineAgreement:
        """Return the agreement of a pose's outline with the image, for the colours learned last.

        Raises:
            UndecidedError: The outline leaves the image.
        """
        return self._agreement(self._outline(pose), reach)

    def check(
        self, end: Solution, prior: Prior, reach: float, information: PoseMatrix
    ) -> OutlineAgreement:
        """Return the agreement of the outline at the end of a descent, if the pose is accepted.

        Args:
            end: End of the descent.
            prior: Prior of the descent.
            reach: Search distance of the descent, pixels of the image.
            information: Information at the end without the outline.

        Raises:
            UndecidedError: The image does not determine the pose or contradicts it.
        """
        contour = self._outline(end.T_cam_obj)
        agreement = self._agreement(contour, reach)
        if self._gain(end, prior, information) < MIN_GAIN:
            raise UndecidedError("colours inside and around the part are too alike")
        if agreement.share < MIN_AGREEING:
            share = f"{agreement.share:.0%}"
            raise UndecidedError(f"only {share} of the outline agrees with the image")
        distance = math.sqrt(prior.squared_distance(end.T_cam_obj))
        if distance > FARTHEST:
            limit = f"more than {FARTHEST:g}"
            raise UndecidedError(f"{distance:.1f} standard deviations from the given pose, {limit}")
        rows = outline_rows(contour, end.T_cam_obj, self.crop.K)
        is_near = (
            self.weights == FOLLOWED and np.mean((rows @ prior.offset(end.T_cam_obj)) ** 2) < 1.0
        )
        # Compare with the prior's pose, except for a tracked part that moved less than a pixel,
        # where noise would decide, and with further terms, which may contradict the image.
        if not is_near and not self.further_terms:
            after = self.log_likelihood(end.T_cam_obj, prior)
            if after <= self.log_likelihood(prior.T_cam_obj, prior):
                raise UndecidedError("the image agrees as well with the given pose")
        return agreement

    def reach(self, reach: float) -> float:
        """Return the stage's share of a search distance (image pixels), in pixels of its crop."""
        return max(EDGE_PX, self.stage.reach * reach * self.crop.scale)

    def farthest(self, reach: float) -> float:
        """Return the stage's share of a search distance, both in pixels of the image."""
        return self.reach(reach) / self.crop.scale

    def _outline(self, pose: Transform) -> Contour:
        """Return the outline at a pose, or raise :class:`UndecidedError` if it is not visible."""
        contour = self.contour(pose)
        if contour is None:
            raise UndecidedError("the part's outline left the image")
        return contour

    def _agreement(self, contour: Contour, reach: float) -> OutlineAgreement:
        """Return the agreement of a contour with the image within a search distance."""
        shifts = self._shifts(contour, reach)
        weights = shifts.information
        offset = np.average(shifts.mean, weights=weights + MIN_INFORMATION)
        agrees = np.abs(shifts.mean - offset) <= AGREE_PX
        share = float(weights[agrees].sum() / max(weights.sum(), MIN_INFORMATION))
        return OutlineAgreement(share, float((agrees & (weights > INFORMATIVE)).mean()))

    def _gain(self, end: Solution, prior: Prior, information: PoseMatrix) -> float:
        """Return by how much the outline increases the log determinant of the pose's information.

        For a tracked part, whose pose is precise, the gain is relative to a weaker prior.

        Args:
            end: End of the descent.
            prior: Prior of the descent.
            information: Information at the end without the outline.
        """
        added, before = end.information - information, prior.information
        if self.weights == FOLLOWED:
            rotation, shift = PRECISE
            firm = np.repeat([rotation, shift * float(end.T_cam_obj[2, 3])], 3) ** 2
            before = np.linalg.inv(np.linalg.inv(before) + np.diag(firm))
        return float(np.linalg.slogdet(before + added)[1] - np.linalg.slogdet(before)[1])

    def _shifts(self, contour: Contour, reach: float) -> Shifts:
        """Measure where the part ends along the normals of a contour, within a search distance."""
        reach, odds, colours = self.reach(reach), self._smooth_odds, self.crop.colours
        return find_shifts(odds, colours, contour, reach, _step(reach), self.weights)

    def _silhouette(self, pose: Transform) -> Silhouette | None:
        """Return the mesh at a pose and its mask, cached for the last pose."""
        if self._last[0] is not pose:
            posed_mesh, silhouette = posed(self.mesh, pose, self.crop.K), None
            if posed_mesh is not None:
                silhouette = posed_mesh, filled_mask(self.mesh, posed_mesh, self.crop.size)
            self._last = pose, silhouette
        return self._last[1]


def _step(reach: float) -> float:
    """Return the distance between samples along a normal, for a search distance (both pixels)."""
    return min(max(1.0, reach / SAMPLES), 4.0)
