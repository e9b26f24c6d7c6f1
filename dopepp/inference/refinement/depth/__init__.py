"""Depth term of refinement: fit a pose to a depth image, and accept or reject the result.

The part is represented by its surface points, which every checkpoint contains.

1. A search over shifts finds the measured surface. Without the search, Gauss–Newton steps converge
   to the nearest surface, e.g. to the table if the pose of a plate is 10 mm off.
2. Two kinds of terms are minimised (:mod:`~dopepp.inference.refinement.depth.terms`). The planes of
   the part's points determine the pose as far as the shape of the surface does. The outline in the
   depth image prevents a plate from sliding in its plane. The prior, which is the pose without
   depth, determines the other directions.
3. The result is rejected if it fits the depth badly, or no better than the prior's pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.camera import CameraMatrix, Transform, make_transform, transform
from dopepp.inference.input_image import Depth
from dopepp.inference.refinement.depth.terms import DepthTerm
from dopepp.inference.refinement.part_surface import (
    GATE,
    DepthView,
    SurfacePoints,
    Visible,
    overlay_surface,
    view_around,
    visible,
)
from dopepp.inference.refinement.solver import (
    PoseMatrix,
    Prior,
    Solution,
    UndecidedError,
    descend,
)

FARTHEST: Final = 3.0
"""Mahalanobis distance from the prior's pose beyond which depth contradicts the image."""

MIN_INLIERS: Final = 0.5  # share of the unobstructed points with depth that must agree
MIN_SEEN: Final = 0.25  # share of the visible points that must have agreeing depth
MAX_RMS: Final = 2.0  # RMS offset in standard deviations of the depth; about 1 at a correct pose
CLOSE: Final = 5.0  # distance in front of a part without other objects, spacings
BESIDE: Final = 3.0  # spacings around the part in which its surface must not continue
SEARCHED_POINTS: Final = 400  # points in the search
ACROSS: Final = 6  # steps of the search to each side, along x and y
REACH: Final = 2.5  # standard deviations of the prior that are searched along the viewing axis

# Costs of a point in the search; a point behind the surface costs 1.
MISSING: Final = 0.5  # point without measured depth
HIDDEN: Final = 0.5  # point that is occluded, or whose depth agrees only in part

PENALTY: Final = 0.03
"""Share of the points that must gain by a shift of one standard deviation of the prior."""

MIN_FOUND: Final = 20  # smallest number of points that agree with their depth


@dataclass(frozen=True)
class DepthStage:
    """A stage of the fit to depth; lengths are shares of the part's diameter if not stated."""

    reach: float  # distance from a plane above which a pixel has no weight
    steps: int = 2  # Gauss–Newton steps
    update_visible: bool = False  # whether the visible points are determined again
    search: float = 0.0  # step of the search across the viewing axis; 0 for no search
    tolerance: float = 0.0  # largest depth error in the search, standard deviations
    outline: float = 0.0  # like ``reach``, between the outlines; 0 for no outline terms


FINE: Final = DepthStage(0.03, steps=3, update_visible=True, outline=0.05)

STAGES: Final = (
    DepthStage(0.06, search=0.025, tolerance=5.0),
    DepthStage(0.045, search=0.0125, tolerance=3.0),
    FINE,
)


@dataclass(eq=False)
class DepthEvidence:
    """Depth image around a part, to which the part's pose is fitted.

    Raises:
        UndecidedError: The part is not on the depth image.
    """

    surface: SurfacePoints  # surface points of the part
    diameter: float  # diameter of the part, metres
    depth: Depth  # metres along z, aligned to the image, 0 where unknown
    K: CameraMatrix
    prior: Prior  # pose to refine and its covariance

    def __post_init__(self) -> None:
        points = transform(self.prior.T_cam_obj, self.surface.points)
        if points[:, 2].min() <= 0:
            raise UndecidedError("the part reaches behind the camera")
        view = view_around(self.depth, self.K, points)
        if view is None:
            raise UndecidedError("the part lies outside the depth image")
        self._view, self._given_visible = view, self.visible(self.prior.T_cam_obj)
        self._before = self._fit(self.prior.T_cam_obj, self._given_visible)

    def descend(self) -> Solution:
        """Fit the prior's pose to the depth by shifts and Gauss–Newton steps, from coarse to fine.

        Raises:
            UndecidedError: Too few points of the part have agreeing depth.
        """
        end, is_visible = (
            Solution(self.prior.T_cam_obj, self.prior.information),
            self._given_visible,
        )
        for stage in STAGES:
            if stage.update_visible:
                is_visible = self.visible(end.T_cam_obj)
            start = self._shifted(end.T_cam_obj, is_visible, stage)
            terms = [self.term(is_visible, stage)]
            reached = None if start is None else descend(start, self.prior, terms, stage.steps)
            if reached is None:
                raise UndecidedError("too little depth was measured on the part")
            end = reached
        return end

    def visible(self, pose: Transform) -> Visible:
        """Return which of the part's points are not hidden by the part itself at a pose."""
        return visible(self.surface, pose)

    def information(self, pose: Transform, is_visible: Visible) -> PoseMatrix:
        """Return the information about the pose from the prior and the depth together."""
        prior = self.prior.information
        equations = self.term(is_visible)(pose, (prior, np.zeros(6)))
        return prior if equations is None else np.asarray(prior + equations[0])

    def term(self, is_visible: Visible, stage: DepthStage = FINE) -> DepthTerm:
        """Return the solver term of the depth at the visible points."""
        reach = max(stage.reach * self.diameter, GATE * self._view.noise)
        outline = stage.outline * self.diameter
        return DepthTerm(self._view, self.surface, is_visible, reach, outline)

    def check(self, pose: Transform) -> None:
        """Check that depth fits a pose well, and better than the prior's pose.

        Raises:
            UndecidedError: The depth does not fit so well, or the pose is farther than ``FARTHEST``
                from the prior's pose.
        """
        reason = self._fit(pose, self.visible(pose)).doubt(self._before)
        distance = math.sqrt(self.prior.squared_distance(pose))
        if not reason and distance > FARTHEST:
            limit = f"more than {FARTHEST:g}"
            reason = f"{distance:.1f} standard deviations from the image's pose, {limit}"
        if reason:
            raise UndecidedError(reason)

    def _fit(self, pose: Transform, is_visible: Visible) -> Fit:
        """Measure how well the visible points at a pose agree with the depth."""
        view, spacing = self._view, self.surface.spacing
        overlay = overlay_surface(view, self.surface, is_visible, pose)
        if overlay is None:
            return Fit(0.0, 0.0, np.inf, 0.0)
        gate = GATE * view.noise
        offset = overlay.at_points
        agree = np.abs(offset) <= gate
        # Depth just in front of a part is more often the part at another pose than an occluder.
        wrong = (offset > gate) | ((offset < -gate) & (offset > -CLOSE * spacing))
        count = int(agree.sum())
        if count == 0:
            return Fit(0.0, 0.0, np.inf, 0.0)
        beside = overlay.continues(view.noise, BESIDE).sum()
        return Fit(
            inliers=count / (count + int(wrong.sum())),
            seen=count / int(is_visible.sum()),
            rms=float(np.sqrt(np.mean(offset[agree] ** 2))) / view.noise,
            uncovered=float(beside / max(1, (overlay.distance <= 1.0).sum())),
        )

    def _shifted(self, pose: Transform, is_visible: Visible, stage: DepthStage) -> Transform | None:
        """Shift a pose so that most points agree with their depth; None if too few agree."""
        if not stage.search:
            return pose
        view = self._view
        points = transform(pose, self.surface.points[is_visible])
        points = np.ascontiguousarray(points[:: -(-len(points) // SEARCHED_POINTS)])
        information = np.ascontiguousarray(self.prior.information[3:, 3:])
        sigma = np.sqrt(np.linalg.inv(information)[2, 2])
        half = int(np.ceil(REACH * sigma / view.noise))
        moved = pose[:3, 3] - self.prior.T_cam_obj[:3, 3]
        step, tolerance = stage.search * self.diameter, stage.tolerance * view.noise
        shift = np.zeros(3)
        num_votes = _search(view, points, information, moved, step, half, tolerance, shift)
        if num_votes < MIN_FOUND:
            return None
        return make_transform(pose[:3, :3], pose[:3, 3] + shift)


@dataclass(frozen=True)
class Fit:
    """Agreement of a posed part with a depth image."""

    inliers: float  # share of the unobstructed points with depth that agree
    seen: float  # share of the visible points that agree
    rms: float  # RMS offset of agreeing points, standard deviations of the depth
    uncovered: float  # area next to the part that continues its surface, relative to the part's

    @property
    def score(self) -> float:
        """Share of visible points that agree, minus contradicting and uncovered shares."""
        return self.seen - (1.0 - self.inliers) - self.uncovered

    def doubt(self, before: Fit) -> str:
        """Return why this fit should be rejected in favour of ``before``, or an empty string."""
        if self.inliers < MIN_INLIERS:
            return f"only {self.inliers:.0%} of the part agrees with the depth"
        if self.seen < MIN_SEEN:
            return f"only {self.seen:.0%} of the part is measured and unobstructed"
        if self.rms > MAX_RMS:
            return f"a residual of {self.rms:.1f} standard deviations of the depth"
        return "the depth fits the given pose no worse" if self.score <= before.score else ""


@compiled()
def _search(
    view: DepthView,
    points: Array,
    information: Array,
    moved: Array,
    step: float,
    half: int,
    tolerance: float,
    shift: Array,
) -> int:
    """Search the translation of a pose that agrees best with the depth image.

    Shifts along x and y are tried on a grid. For each shift, the points vote on the shift along z.
    The score is the number of votes minus penalties: for points in front of the measured surface,
    for occluded points, for points without depth, and for the distance from the prior.

    Args:
        view: Crop of the depth image; the size of a bin along z is the noise.
        points: Visible points in the camera frame, shape (n, 3), metres.
        information: Information matrix of the prior about a translation, shape (3, 3), 1/m².
        moved: Translation from the prior's pose to the present pose, shape (3,), metres.
        step: Distance between neighbouring shifts along x and y, metres.
        half: Number of bins on each side of the present depth.
        tolerance: Depth difference at which the weight of a vote falls to 0, metres.
        shift: Output: the best shift in the camera frame, shape (3,), metres.

    Returns:
        Number of points that agree with the best shift.
    """
    depth, K, _, bin_size = view
    rows, columns = depth.shape
    count = points.shape[0]
    width = max(1, int(tolerance / bin_size))
    votes = np.zeros(2 * half + 1)
    highest, most = -np.inf, 0
    for a in range(-ACROSS, ACROSS + 1):
        for b in range(-ACROSS, ACROSS + 1):
            votes[:] = 0.0
            missing, beyond, counted = 0, 0, 0
            for i in range(count):
                x, y, z = points[i, 0] + a * step, points[i, 1] + b * step, points[i, 2]
                u, v = round(K[0, 0] * x / z + K[0, 2]), round(K[1, 1] * y / z + K[1, 2])
                if not (0 <= u < columns and 0 <= v < rows):
                    continue
                measured = depth[int(v), int(u)]
                if measured <= 0.0:
                    missing += 1
                    continue
                counted += 1
                vote = int(np.floor((measured - z) / bin_size + 0.5)) + half
                if vote > 2 * half:
                    beyond += 1
                elif vote >= 0:
                    votes[vote] += 1.0
            behind = float(beyond)
            for k in range(2 * half, -1, -1):
                near = votes[k]
                for w in range(1, width):
                    share = 1.0 - w / width
                    if k >= w:
                        near += share * votes[k - w]
                    if k + w <= 2 * half:
                        near += share * votes[k + w]
                if k + width <= 2 * half:
                    behind += votes[k + width]
                if near < 1.0:
                    continue
                dx, dy, dz = a * step, b * step, (k - half) * bin_size
                offset = (dx + moved[0], dy + moved[1], dz + moved[2])  # from the prior's pose
                far = 0.0
                for m in range(3):
                    for n in range(3):
                        far += offset[m] * information[m, n] * offset[n]
                hidden = max(counted - near - behind, 0.0)
                score = near - behind - HIDDEN * hidden - MISSING * missing - PENALTY * count * far
                if score > highest:
                    highest, most = score, int(near)
                    shift[0], shift[1], shift[2] = dx, dy, dz
    return most
