"""Poses refined on the picture alone: the outline is moved to where the part's colours end.

Colours inside a part's outline and around it are learned at the pose that is to be refined. Along
the normals of the outline they tell where the part ends (:mod:`~dopepp.inference.refinement.lines`)
and a few Gauss–Newton steps follow, from coarse to fine, with the given pose and its covariance as
prior. Several starts drawn from that covariance are ranked by likelihood. Where the picture does
not decide, the given pose is kept.

Errors of neighbouring points are alike, and an offset may be common to all: a covariance that took
them for independent would let a blurred edge overrule the network's distance. The idea of regions
is that of PWP3D and RBOT, that of probabilistic lines SRT3D's (Stoiber et al. 2022).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from dopepp.geometry.camera import CameraMatrix, Transform, resize_camera
from dopepp.inference.refinement.colour import colour_bins, log_odds
from dopepp.inference.refinement.contour import (
    Contour,
    OutlineMesh,
    filled_mask,
    find_contour,
    make_outline_mesh,
    posed,
)
from dopepp.inference.refinement.depth import Refinement
from dopepp.inference.refinement.fit import Prior, make_prior
from dopepp.inference.refinement.lines import (
    CONFIDENCE,
    INDEPENDENT_PX,
    LEAST_INFORMATION,
    Shifts,
    find_shifts,
    outline_rows,
    region_terms,
)
from dopepp.inference.refinement.solver import Evidence, Solution, Terms, descend, moved
from dopepp.parts.mesh.measure import Faces, Vertices, largest_distance


@dataclass(frozen=True)
class Stage:
    """One of the rounds from coarse to fine.

    Attributes:
        longest_px: A part that is longer on the picture is read from a smaller one.
        reach: Of the normals, share of the first reach.
        steps: Gauss–Newton steps.
        points: About so many on the outline.
    """

    longest_px: int
    reach: float
    steps: int
    points: int


COARSE: Final = Stage(120, 1.0, 3, 100)
MIDDLE: Final = Stage(200, 0.5, 2, 160)
FINE: Final = Stage(400, 0.25, 3, 240)
"""The coarse round is every start's, the others only the best one's."""

NUM_DRAWS: Final = 4
"""Starts drawn from the covariance where the given pose's own descent is doubtful."""

WIDENED: Final = 2.0
"""Factor on the prior's deviations in the coarse round: a start that is far off shows a picture
that agrees with itself too little to overrule the prior, until it has come nearer."""

SMALLEST_PX: Final = 12
"""A part that is shorter on the picture shows no outline."""

MARGIN: Final = 0.35
"""Of the part's extent, looked at around it."""

RING: Final = 0.2
"""Of the part's extent: width of what counts as its surroundings."""

REACH: Final = (2.5, 6.0, 0.15)
"""Standard deviations of the outline under the prior; not below so many pixels, not above such a
share of the part's extent."""

SAMPLES: Final = 7
"""Steps on each side of a normal, which are 1 to 4 pixels."""

FEWEST_POINTS: Final = 24
"""Of an outline on the picture, to fix six numbers."""

LEAST_GAIN: Final = 2.0
"""Of the logarithm of the covariance's volume, below which the picture says nothing."""

AGREE_PX: Final = 2.0
LEAST_AGREEING: Final = 0.3
"""Share of a refined outline, by information, that the picture's is so near to."""

FARTHEST: Final = 4.5
"""Standard deviations (Mahalanobis distance of six numbers) that a pose may be moved."""


@dataclass(frozen=True, eq=False)
class RegionView:
    """The part of a picture that a posed part can have to do with.

    Attributes:
        bins: Colours of its pixels.
        K: Its camera matrix, pixels.
        extent: Longer side of the part on it, pixels.
        scale: Its pixels per pixel of the picture, at most 1.
    """

    bins: Int[np.ndarray, "height width"]
    K: CameraMatrix
    extent: float
    scale: float

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.bins.shape[1], self.bins.shape[0]


def view_around(
    image: UInt8[np.ndarray, "height width 3"],
    K: CameraMatrix,
    pixels: Float[np.ndarray, "vertices 2"],
    longest_px: int,
) -> RegionView | str:
    """Cut out a posed part and what is around it; where there is too little, say so."""
    lower, upper = pixels.min(axis=0), pixels.max(axis=0)
    extent = float((upper - lower).max())
    if extent < SMALLEST_PX:
        return f"the part is only {extent:.0f} pixels long"
    edge = MARGIN * extent + REACH[1]
    limit = np.array(image.shape[1::-1])
    left, top = np.clip(np.floor(lower - edge), 0, limit).astype(int)
    right, bottom = np.clip(np.ceil(upper + edge) + 1, 0, limit).astype(int)
    if min(right - left, bottom - top) < SMALLEST_PX:
        return "the part lies outside the picture"
    crop = np.ascontiguousarray(image[top:bottom, left:right])
    own = np.array(K, np.float64)
    own[:2, 2] -= left, top
    scale = min(1.0, longest_px / extent)
    if scale < 1:
        width, height = (max(1, round(scale * side)) for side in crop.shape[1::-1])
        own = resize_camera(own, width / crop.shape[1], height / crop.shape[0])
        crop = cv2.resize(crop, (width, height), interpolation=cv2.INTER_AREA)
    return RegionView(colour_bins(crop), own, extent * scale, scale)


class RegionRefiner:
    """Refines the poses of one part.

    Args:
        vertices: Positions, metres.
        faces: Triangles. Many are replaced by fewer.

    Raises:
        ValueError: The triangles have no area.
    """

    def __init__(self, vertices: Vertices, faces: Faces) -> None:
        self._mesh = make_outline_mesh(vertices, faces)
        self._diameter = largest_distance(self._mesh.vertices)

    @property
    def deviation(self) -> float:
        """How far any vertex was moved to have fewer triangles, metres."""
        return self._mesh.deviation

    def refine(
        self,
        image: UInt8[np.ndarray, "height width 3"],
        K: CameraMatrix,
        T_cam_obj: Transform,
        covariance: Float[np.ndarray, "6 6"] | None = None,
    ) -> Refinement:
        """Refine one pose.

        Args:
            image: RGB.
            K: Its camera matrix, pixels.
            T_cam_obj: The pose to start from, metres.
            covariance: Of the given pose: rotation vector about the object's origin and shift, both
                in camera axes, radians and metres. Without it, a broad one is taken.

        Returns:
            The refined pose with its covariance, or the given one with the reason why it was kept.
        """
        given = np.asarray(T_cam_obj, np.float64)
        if not np.isfinite(given).all():
            return Refinement(given, reason="the pose is not finite")
        K = np.asarray(K, np.float64)
        at = posed(self._mesh, given, K)
        if at is None:
            return Refinement(given, reason="the part reaches behind the camera")
        rounds = []
        for stage in (COARSE, MIDDLE, FINE):
            view = view_around(image, K, at.pixels, stage.longest_px)
            if isinstance(view, str):
                return Refinement(given, reason=view)
            rounds.append(_Round(self._mesh, view, stage))
        prior = _prior(given, self._diameter, covariance)
        try:
            end, agreement = _search(rounds, prior)
        except _UndecidedError as undecided:
            return Refinement(given, reason=str(undecided))
        return Refinement(end.T_cam_obj, np.linalg.inv(end.information), agreement=agreement)


class _UndecidedError(Exception):
    """Why a picture does not decide about a pose."""


def _prior(given: Transform, diameter: float, covariance: Float[np.ndarray, "6 6"] | None) -> Prior:
    """Return the given pose with its covariance as it is, or with a broad one."""
    if covariance is None or not np.isfinite(covariance).all():
        return make_prior(given, diameter)
    # A thousandth of a degree and of a millimetre keep it from being singular.
    floor = np.diag(np.repeat([1e-5**2, 1e-6**2], 3))
    return Prior(given, np.linalg.inv(np.asarray(covariance, np.float64) + floor))


def _search(rounds: list[_Round], prior: Prior) -> tuple[Solution, float]:
    """Descend from the given pose and, where that is doubtful, from the best of several draws.

    Returns:
        The end, and the share of the outline that agrees there.

    Raises:
        _UndecidedError: No descent is to be believed.
    """
    coarse = rounds[0]
    given = prior.T_cam_obj
    reach = _first_reach(coarse, prior)
    coarse.learn(given, reach)
    wide = Prior(given, prior.information / WIDENED**2)
    try:
        end = descend(given, wide, [coarse.evidence(reach)], COARSE.steps)
        return _refined(rounds, end, prior, reach)
    except _UndecidedError as first:
        coarse.learn(given, reach)
        ends = [descend(start, wide, [coarse.evidence(reach)], COARSE.steps)
                for start in _starts(prior)]  # fmt: skip
        best = max((end for end in ends if end), default=None,
                   key=lambda end: coarse.log_likelihood(end.T_cam_obj, prior))  # fmt: skip
        try:
            return _refined(rounds, best, prior, reach)
        except _UndecidedError:
            raise first from None


def _refined(
    rounds: list[_Round], end: Solution | None, prior: Prior, reach: float
) -> tuple[Solution, float]:
    """Go on from the end of a coarse descent, and see whether to believe where it leads.

    Raises:
        _UndecidedError: Not to be believed.
    """
    for later in rounds[1:]:
        if end is None:
            break
        later.learn(end.T_cam_obj, reach)
        end = descend(end.T_cam_obj, prior, [later.evidence(reach)], later.stage.steps)
    if end is None:
        raise _UndecidedError("the part's outline left the picture")
    return end, rounds[-1].agreement(end, prior, reach)


def _starts(prior: Prior) -> list[Transform]:
    """Return draws from a prior, always the same ones."""
    spread = np.linalg.cholesky(np.linalg.inv(prior.information))
    draws = np.random.default_rng(0).normal(size=(NUM_DRAWS, 6))
    return [moved(prior.T_cam_obj, spread @ draw) for draw in draws]


def _first_reach(coarse: _Round, prior: Prior) -> float:
    """Return how far the outline may be off, pixels of the picture."""
    contour = coarse.contour(prior.T_cam_obj)
    if contour is None:
        raise _UndecidedError("too little of the part's outline is on the picture")
    view = coarse.view
    rows = outline_rows(contour, prior.T_cam_obj, view.K)
    covariance = np.linalg.inv(prior.information)
    deviation = math.sqrt(float(np.mean(((rows @ covariance) * rows).sum(axis=1))))
    factor, least, most = REACH
    return max(least, min(factor * deviation, most * view.extent) / view.scale)


class _Round:
    """One stage on its view, with the colours that it has learned.

    Args:
        mesh: The part.
        view: The picture at the stage's size.
        stage: The stage.
    """

    def __init__(self, mesh: OutlineMesh, view: RegionView, stage: Stage) -> None:
        self.view, self.stage, self._mesh = view, stage, mesh
        self._spacing = max(1.5, 3.0 * view.extent / stage.points)
        self._odds: Float32[np.ndarray, "height width"] = np.zeros(view.size[::-1], np.float32)
        self._soft = self._odds

    def learn(self, pose: Transform, reach: float) -> None:
        """Learn the colours at a pose that may be off by the stage's share of ``reach``."""
        mask = self._mask(pose)
        reach = self._reach(reach)
        ring = RING * self.view.extent
        odds = None if mask is None else log_odds(self.view.bins, mask, 0.5 * reach, ring)
        if odds is None:
            raise _UndecidedError("too few pixels of the part and around it are on the picture")
        self._odds = self._soft = odds
        step = round(self._step(reach))
        if step >= 2:
            self._soft = cv2.blur(odds, (step, step))

    def contour(self, pose: Transform) -> Contour | None:
        """Return the outline; None where too little of it is on the picture."""
        at = posed(self._mesh, pose, self.view.K)
        if at is None:
            return None
        mask = filled_mask(self._mesh, at, self.view.size)
        contour = find_contour(self._mesh, at, mask, self._spacing)
        return contour if len(contour) >= FEWEST_POINTS else None

    def evidence(self, reach: float) -> Evidence:
        """Return the stage's pull as a function of the pose."""

        def pull(pose: Transform, known: Terms) -> Terms | None:
            contour = self.contour(pose)
            if contour is None:
                return None
            rows = outline_rows(contour, pose, self.view.K)
            return region_terms(
                rows, self._shifts(contour, reach), known, self._spacing, self.view.extent
            )

        return pull

    def log_likelihood(self, pose: Transform, prior: Prior) -> float:
        """Return the logarithm of a pose's probability, up to a constant."""
        mask = self._mask(pose)
        if mask is None:
            return -math.inf
        inside = float(self._odds.ravel() @ mask.ravel()) * CONFIDENCE / INDEPENDENT_PX
        offset = prior.offset(pose)
        return inside - 0.5 * float(offset @ prior.information @ offset)

    def agreement(self, end: Solution, prior: Prior, reach: float) -> float:
        """Return the share of a refined outline, by information, that the picture agrees with.

        Raises:
            _UndecidedError: The picture does not decide for this pose.
        """
        contour = self.contour(end.T_cam_obj)
        if contour is None:
            raise _UndecidedError("the part's outline left the picture")
        gain = np.linalg.slogdet(end.information)[1] - np.linalg.slogdet(prior.information)[1]
        if gain < LEAST_GAIN:
            raise _UndecidedError("colours inside and around the part are too alike")
        shifts = self._shifts(contour, reach)
        weights = shifts.information
        away = np.abs(shifts.mean - np.average(shifts.mean, weights=weights + LEAST_INFORMATION))
        agreeing = float(weights[away <= AGREE_PX].sum() / max(weights.sum(), LEAST_INFORMATION))
        offset = prior.offset(end.T_cam_obj)
        distance = math.sqrt(float(offset @ prior.information @ offset))
        before = self.log_likelihood(prior.T_cam_obj, prior)
        after = self.log_likelihood(end.T_cam_obj, prior)
        if agreeing < LEAST_AGREEING:
            raise _UndecidedError(f"only {agreeing:.0%} of the outline agrees with the picture")
        if distance > FARTHEST:
            raise _UndecidedError(
                f"{distance:.1f} standard deviations from the given pose, more than {FARTHEST:g}"
            )
        if after <= before:
            raise _UndecidedError("the picture fits the given pose no worse")
        return agreeing

    def _shifts(self, contour: Contour, reach: float) -> Shifts:
        reach = self._reach(reach)
        return find_shifts(self._soft, contour, reach, self._step(reach))

    def _reach(self, reach: float) -> float:
        """Return the stage's share of a reach, in pixels of its view."""
        return max(REACH[1], self.stage.reach * reach * self.view.scale)

    def _step(self, reach: float) -> float:
        return min(max(1.0, reach / SAMPLES), 4.0)

    def _mask(self, pose: Transform) -> UInt8[np.ndarray, "height width"] | None:
        at = posed(self._mesh, pose, self.view.K)
        return None if at is None else filled_mask(self._mesh, at, self.view.size)
