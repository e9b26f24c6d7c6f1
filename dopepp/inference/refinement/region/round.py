"""A round in which a pose is refined on the picture: its crop, colours, pull and verdict."""

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
    Posed,
    filled_mask,
    find_contour,
    outline_rows,
    posed,
)
from dopepp.inference.refinement.region.shifts import (
    FOLLOWED,
    INDEPENDENT_PX,
    LEAST_INFORMATION,
    Shifts,
    Weights,
    find_shifts,
    region_terms,
)
from dopepp.inference.refinement.solver import (
    NormalEquations,
    PoseMatrix,
    Prior,
    Solution,
    Term,
    UndecidedError,
    descend,
)

RING: Final = 0.2  # of the part's extent: width of what counts as its surroundings
SAMPLES: Final = 7  # steps on each side of a normal, which are 1 to 4 pixels
FEWEST_POINTS: Final = 24  # of an outline on the picture, to fix six numbers

LEAST_GAIN: Final = 2.0
"""Of the logarithm of the covariance's volume, below which the picture says nothing."""

FIRM: Final = (math.radians(1.0), 5e-3)
"""Standard deviations of a pose that was known well: radians, and metres per metre of distance."""

AGREE_PX: Final = 2.0
LEAST_AGREEING: Final = 0.3
"""Share of a refined outline, by information, that the picture's is so near to."""

TOLD: Final = 0.1  # pixels⁻²: information from which on the picture tells where the part ends

FARTHEST: Final = 4.5
"""Standard deviations (Mahalanobis distance of six numbers) that a pose may be moved."""


@dataclass(frozen=True)
class Stage:
    """How a round looks at the picture."""

    longest_px: int  # A part that is longer on the picture is read from a smaller one
    reach: float  # of the normals, share of the first reach
    steps: int  # Gauss–Newton steps
    points: int  # about so many on the outline
    tiles: int  # along each side of the part, with colours of their own


@dataclass(frozen=True)
class Agreement:
    """How well a refined outline agrees with the picture."""

    share: float  # of what the picture tells about the outline, by information, in [0, 1]
    # Share of the outline that the picture tells about and that agrees, in [0, 1]: what is
    # hidden, or before its own colour, has none
    support: float


class Round:
    """One stage on its crop, with the colours that it has learned.

    Args:
        mesh: The part.
        crop: The picture at the stage's size.
        stage: The stage.
        weights: Of colours and edges.
        more: Terms that pull beside the outline.
    """

    def __init__(
        self,
        mesh: OutlineMesh,
        crop: Crop,
        stage: Stage,
        weights: Weights,
        more: Sequence[Term] = (),
    ) -> None:
        self.crop, self.stage, self._weights = crop, stage, weights
        self._mesh, self._more = mesh, more
        self._spacing = max(1.5, 3.0 * crop.extent / stage.points)
        self._odds: Float32[np.ndarray, "height width"] = np.zeros(crop.size[::-1], np.float32)
        self._soft = self._odds
        self._last_pose: Transform = np.empty((0, 0))
        self._last: tuple[Posed, UInt8[np.ndarray, "height width"]] | None = None

    def learn(self, pose: Transform, reach: float) -> None:
        """Learn the colours at a pose that may be off by the stage's share of ``reach``."""
        silhouette = self._silhouette(pose)
        reach, ring = self.reach(reach), RING * self.crop.extent
        odds = None
        if silhouette is not None:
            odds = log_odds(self.crop.bins, silhouette[1], 0.5 * reach, ring, self.stage.tiles)
        if odds is None:
            raise UndecidedError("too few pixels of the part and around it are on the picture")
        self._odds = self._soft = odds
        step = round(_step(reach))
        if step >= 2:
            self._soft = cv2.blur(odds, (step, step))

    def contour(self, pose: Transform) -> Contour | None:
        """Return the outline; None where too little of it is on the picture."""
        silhouette = self._silhouette(pose)
        if silhouette is None:
            return None
        contour = find_contour(self._mesh, *silhouette, self._spacing)
        return contour if len(contour) >= FEWEST_POINTS else None

    def terms(self, reach: float) -> list[Term]:
        """Return the pull of the outline and of what there is besides."""

        def outline(pose: Transform, known: NormalEquations) -> NormalEquations | None:
            contour = self.contour(pose)
            if contour is None:
                return None
            rows = outline_rows(contour, pose, self.crop.K)
            shifts = self._shifts(contour, reach)
            return region_terms(rows, shifts, known, self._spacing, self.crop.extent)

        return [outline, *self._more]

    def descend(self, start: Transform, prior: Prior, reach: float) -> Solution:
        """Take the stage's steps; an :class:`UndecidedError` where they leave the picture."""
        end = descend(start, prior, self.terms(reach), self.stage.steps)
        if end is None:
            raise UndecidedError("the part's outline left the picture")
        return end

    def log_likelihood(self, pose: Transform, prior: Prior) -> float:
        """Return the logarithm of a pose's probability, up to a constant."""
        silhouette = self._silhouette(pose)
        if silhouette is None:
            return -math.inf
        inside = float(self._odds.ravel() @ silhouette[1].ravel())
        inside *= self._weights.colour / INDEPENDENT_PX
        return inside - 0.5 * prior.squared_distance(pose)

    def agreement(self, pose: Transform, reach: float) -> Agreement:
        """Return how well an outline agrees with the picture, in the colours learned last."""
        return self._agreement(self._outline(pose), reach)

    def believed(self, end: Solution, prior: Prior, reach: float, known: PoseMatrix) -> Agreement:
        """Return how well the outline agrees where a descent has ended.

        ``known`` is the information that was there without the outline.

        Raises:
            UndecidedError: The picture does not decide for this pose.
        """
        contour = self._outline(end.T_cam_obj)
        agreement = self._agreement(contour, reach)
        if self._gain(end, prior, known) < LEAST_GAIN:
            raise UndecidedError("colours inside and around the part are too alike")
        if agreement.share < LEAST_AGREEING:
            raise UndecidedError(
                f"only {agreement.share:.0%} of the outline agrees with the picture"
            )
        distance = math.sqrt(prior.squared_distance(end.T_cam_obj))
        if distance > FARTHEST:
            raise UndecidedError(
                f"{distance:.1f} standard deviations from the given pose, more than {FARTHEST:g}"
            )
        rows = outline_rows(contour, end.T_cam_obj, self.crop.K)
        near = self._followed and np.mean((rows @ prior.offset(end.T_cam_obj)) ** 2) < 1.0
        # Of a followed part within a pixel, single pixels would decide; what pulls besides may
        # well move a pose to where the picture alone fits less.
        if not near and not self._more:
            after = self.log_likelihood(end.T_cam_obj, prior)
            if after <= self.log_likelihood(prior.T_cam_obj, prior):
                raise UndecidedError("the picture fits the given pose no worse")
        return agreement

    def reach(self, reach: float) -> float:
        """Return the stage's share of a reach, in pixels of its crop."""
        return max(EDGE_PX, self.stage.reach * reach * self.crop.scale)

    def farthest(self, reach: float) -> float:
        """Return the same in pixels of the picture."""
        return self.reach(reach) / self.crop.scale

    @property
    def _followed(self) -> bool:
        return self._weights == FOLLOWED

    def _outline(self, pose: Transform) -> Contour:
        contour = self.contour(pose)
        if contour is None:
            raise UndecidedError("the part's outline left the picture")
        return contour

    def _agreement(self, contour: Contour, reach: float) -> Agreement:
        shifts = self._shifts(contour, reach)
        weights = shifts.information
        away = np.abs(shifts.mean - np.average(shifts.mean, weights=weights + LEAST_INFORMATION))
        agrees = away <= AGREE_PX
        share = float(weights[agrees].sum() / max(weights.sum(), LEAST_INFORMATION))
        return Agreement(share, float((agrees & (weights > TOLD)).mean()))

    def _gain(self, end: Solution, prior: Prior, known: PoseMatrix) -> float:
        """Return the logarithm by which the outline makes the prior's volume smaller.

        For a followed part, whose pose was known well, the gain is relative to a weaker prior.
        """
        added, before = end.information - known, prior.information
        if self._followed:
            turn, shift = FIRM
            firm = np.repeat([turn, shift * float(end.T_cam_obj[2, 3])], 3) ** 2
            before = np.linalg.inv(np.linalg.inv(before) + np.diag(firm))
        return float(np.linalg.slogdet(before + added)[1] - np.linalg.slogdet(before)[1])

    def _shifts(self, contour: Contour, reach: float) -> Shifts:
        reach = self.reach(reach)
        return find_shifts(
            self._soft, self.crop.colours, contour, reach, _step(reach), self._weights
        )

    def _silhouette(
        self, pose: Transform
    ) -> tuple[Posed, UInt8[np.ndarray, "height width"]] | None:
        """Return the mesh at a pose and its mask, kept while the same pose is asked for."""
        if self._last_pose is not pose:
            at = posed(self._mesh, pose, self.crop.K)
            self._last = None if at is None else (at, filled_mask(self._mesh, at, self.crop.size))
            self._last_pose = pose
        return self._last


def _step(reach: float) -> float:
    """Return the pixels between two samples."""
    return min(max(1.0, reach / SAMPLES), 4.0)
