"""What a depth image says about a pose, and when to believe it: the depth term of refinement.

The part is its surface points, so a checkpoint is all that is needed. A search over shifts finds
the measured surface: a descent needs a start from which the nearest surface is the right one, and a
plate that lies 14 mm away from it, or 10 mm beside it on a table, is no such start. From there on
two kinds of terms pull (:mod:`~dopepp.inference.refinement.depth.terms`): the planes of the part's
points, which fix what a surface's shape fixes, and the outline in the depth, which keeps a flat
plate from sliding in its own plane. The image's pose with its covariance decides where depth is
silent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.camera import CameraMatrix, Transform, make_transform, transform
from dopepp.geometry.rotation import Vector
from dopepp.inference.picture import Depth
from dopepp.inference.refinement.depth.terms import DepthTerm
from dopepp.inference.refinement.solver import (
    PoseMatrix,
    Prior,
    Solution,
    UndecidedError,
    descend,
)
from dopepp.inference.refinement.surface import (
    GATE,
    DepthView,
    Points,
    Seen,
    SurfacePoints,
    lay_over,
    view_around,
    visible,
)

FARTHEST: Final = 3.0
"""Standard deviations (Mahalanobis distance) beyond which depth contradicts the image."""

LEAST_INLIERS: Final = 0.5  # of the points with depth that nothing stands before
LEAST_SEEN: Final = 0.25  # of the visible points that must have agreeing depth at all
MOST_RMS: Final = 2.0  # standard deviations of the depth: a right pose leaves about one
CLOSE: Final = 5.0  # spacings before a part up to which nothing else is expected
BESIDE: Final = 3.0  # spacings around the part in which its surface must not go on
SEARCHED_POINTS: Final = 400  # points in the search
ACROSS: Final = 6  # steps to each side, along x and y
REACH: Final = 2.5  # standard deviations of the prior that are searched along the viewing axis

MISSING: Final = 0.5
"""What a point without depth costs, against 1 for one that looks past the surface."""

HIDDEN: Final = 0.5
"""What a point costs that something stands before, or whose depth agrees but in part."""

PENALTY: Final = 0.03
"""Share of the points that a shift by one standard deviation of the prior must gain."""

LEAST_FOUND: Final = 20  # points that must find their depth


@dataclass(frozen=True)
class Stage:
    """One of the rounds from coarse to fine; lengths in diameters where nothing else is said."""

    reach: float  # largest distance from a plane that pulls
    steps: int = 2  # Gauss–Newton steps
    anew: bool = False  # whether the visible points are found anew
    search: float = 0.0  # step of the search across the viewing axis before it; 0 for none
    # Of that search, standard deviations of the depth; a pose that is still tilted needs more
    tolerance: float = 0.0
    outline: float = 0.0  # largest difference of outlines that pulls; 0 for none


FINE: Final = Stage(0.03, steps=3, anew=True, outline=0.05)

STAGES: Final = (
    Stage(0.06, search=0.025, tolerance=5.0),
    Stage(0.045, search=0.0125, tolerance=3.0),
    FINE,
)


class DepthEvidence:
    """A part on a depth image.

    Args:
        surface: The part's points.
        diameter: Of the part, metres.
        depth: Metres along z, aligned to the image of K, 0 where unknown.
        K: Camera matrix, pixels.
        prior: The pose that is to be refined, with what is known of it.

    Raises:
        UndecidedError: The part is not on the depth image.
    """

    def __init__(
        self,
        surface: SurfacePoints,
        diameter: float,
        depth: Depth,
        K: CameraMatrix,
        prior: Prior,
    ) -> None:
        points = transform(prior.T_cam_obj, surface.points)
        if points[:, 2].min() <= 0:
            raise UndecidedError("the part reaches behind the camera")
        view = view_around(depth, K, points)
        if view is None:
            raise UndecidedError("the part lies outside the depth image")
        self.prior = prior
        self._surface, self._diameter, self._view = surface, diameter, view
        self._given_seen = visible(surface, prior.T_cam_obj)
        self._before = self._fit(prior.T_cam_obj, self._given_seen)

    def descend(self) -> Solution:
        """Search and descend, coarse to fine; :class:`UndecidedError` where depth is too little."""
        end, seen = Solution(self.prior.T_cam_obj, self.prior.information), self._given_seen
        for stage in STAGES:
            pose = end.T_cam_obj
            if stage.anew:
                seen = self.seen(pose)
            start = self._searched(pose, seen, stage) if stage.search else pose
            found = None
            if start is not None:
                found = descend(start, self.prior, [self.term(seen, stage)], stage.steps)
            if found is None:
                raise UndecidedError("too little depth was measured on the part")
            end = found
        return end

    def seen(self, pose: Transform) -> Seen:
        """Tell which of the part's points are visible at a pose."""
        return visible(self._surface, pose)

    def information(self, pose: Transform, seen: Seen) -> PoseMatrix:
        """Return what is known at a pose by the prior and the depth of the points seen."""
        known = self.prior.information
        equations = self.term(seen)(pose, (known, np.zeros(6)))
        return known if equations is None else np.asarray(known + equations[0])

    def term(self, seen: Seen, stage: Stage = FINE) -> DepthTerm:
        """Return how the points seen pull."""
        reach = max(stage.reach * self._diameter, GATE * self._view.noise)
        outline = stage.outline * self._diameter
        return DepthTerm(self._view, self._surface, seen, reach, outline)

    def check(self, pose: Transform) -> None:
        """Raise an :class:`UndecidedError` where depth does not speak for a pose."""
        reason = self._fit(pose, self.seen(pose)).doubt(self._before)
        distance = math.sqrt(self.prior.squared_distance(pose))
        if not reason and distance > FARTHEST:
            limit = f"more than {FARTHEST:g}"
            reason = f"{distance:.1f} standard deviations from the image's pose, {limit}"
        if reason:
            raise UndecidedError(reason)

    def _fit(self, pose: Transform, seen: Seen) -> Fit:
        """Measure how well a pose and the points it shows agree with the depth."""
        view, spacing = self._view, self._surface.spacing
        overlay = lay_over(view, self._surface, seen, pose)
        if overlay is None:
            return Fit(0.0, 0.0, np.inf, 0.0)
        gate = GATE * view.noise
        offset = overlay.at_points
        agree = np.abs(offset) <= gate
        # What lies just before a part is more often the part itself, elsewhere, than another thing.
        wrong = (offset > gate) | ((offset < -gate) & (offset > -CLOSE * spacing))
        count = int(agree.sum())
        if count == 0:
            return Fit(0.0, 0.0, np.inf, 0.0)
        beside = overlay.continues(view.noise, BESIDE).sum()
        return Fit(
            inliers=count / (count + int(wrong.sum())),
            seen=count / int(seen.sum()),
            rms=float(np.sqrt(np.mean(offset[agree] ** 2))) / view.noise,
            uncovered=float(beside / max(1, (overlay.distance <= 1.0).sum())),
        )

    def _searched(self, pose: Transform, seen: Seen, stage: Stage) -> Transform | None:
        """Return a pose shifted to where most points find their depth."""
        shift = best_shift(
            self._view, transform(pose, self._surface.points[seen]), self.prior,
            pose[:3, 3] - self.prior.T_cam_obj[:3, 3], stage.search * self._diameter,
            stage.tolerance * self._view.noise,
        )  # fmt: skip
        return None if shift is None else make_transform(pose[:3, :3], pose[:3, 3] + shift)


@dataclass(frozen=True)
class Fit:
    """Agreement of a pose with depth."""

    inliers: float  # share that agrees among the points with depth that nothing stands before
    seen: float  # share that agrees among all points that the part itself does not hide
    rms: float  # of the agreeing points' offsets, in standard deviations of the depth
    uncovered: float  # area beside the part that goes on as its surface does, over the part's own

    @property
    def score(self) -> float:
        """One number to compare poses by."""
        return self.seen - (1.0 - self.inliers) - self.uncovered

    def doubt(self, before: Fit) -> str:
        """Say why not to believe this fit rather than the one before; empty where there is none."""
        if self.inliers < LEAST_INLIERS:
            return f"only {self.inliers:.0%} of the part agrees with the depth"
        if self.seen < LEAST_SEEN:
            return f"only {self.seen:.0%} of the part is measured and unobstructed"
        if self.rms > MOST_RMS:
            return f"a residual of {self.rms:.1f} standard deviations of the depth"
        if self.score <= before.score:
            return "the depth fits the given pose no worse"
        return ""


def best_shift(
    view: DepthView, points: Points, prior: Prior, moved: Vector, step: float, tolerance: float
) -> Vector | None:
    """Return the shift in camera axes that most points agree on; None where too few have depth.

    The points are those of the part that are visible at the present pose, in the camera frame;
    ``moved`` is how far that pose is from the prior's already, ``step`` is between neighbouring
    shifts along x and y, and ``tolerance`` is the depth by which a point may differ and still
    count, the less the more. All are metres.
    """
    chosen = np.ascontiguousarray(points[:: -(-len(points) // SEARCHED_POINTS)])
    information = np.ascontiguousarray(prior.information[3:, 3:])
    sigma = np.sqrt(np.linalg.inv(information)[2, 2])
    half = int(np.ceil(REACH * sigma / view.noise))
    shift = np.zeros(3)
    agreeing = _search(
        view.depth, view.K, chosen, information, moved, step, view.noise, half, tolerance, shift
    )
    return shift if agreeing >= LEAST_FOUND else None


@compiled()
def _search(
    depth: Array,
    K: Array,
    points: Array,
    information: Array,
    moved: Array,
    step: float,
    bin_size: float,
    half: int,
    tolerance: float,
    best: Array,
) -> int:
    """Try every shift across and vote on the one along the axis; return the votes of the best.

    Votes fall into ``half`` bins of ``bin_size`` metres to each side of the present depth, and
    count less the farther off they are, up to ``tolerance``. ``best`` is filled with the shift,
    metres; see :func:`best_shift` for the others.
    """
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
                place = int(np.floor((measured - z) / bin_size + 0.5)) + half
                if place > 2 * half:
                    beyond += 1
                elif place >= 0:
                    votes[place] += 1.0
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
                shift = (a * step + moved[0], b * step + moved[1], (k - half) * bin_size + moved[2])
                far = 0.0
                for m in range(3):
                    for n in range(3):
                        far += shift[m] * information[m, n] * shift[n]
                hidden = max(counted - near - behind, 0.0)
                score = near - behind - HIDDEN * hidden - MISSING * missing - PENALTY * count * far
                if score > highest:
                    highest, most = score, int(near)
                    best[0], best[1] = a * step, b * step
                    best[2] = (k - half) * bin_size
    return most
