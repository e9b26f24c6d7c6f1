"""What a depth image says about a pose: the depth term of the refinement.

The part is its surface points, so a checkpoint is all that is needed. A search over shifts finds
the measured surface. From there on two kinds of evidence pull: the planes of the part's points,
which fix what a surface's shape fixes (:mod:`~dopepp.inference.refinement.planes`), and the outline
in the depth (see :mod:`~dopepp.inference.refinement.fit`), which keeps a flat plate from sliding in
its own plane. The image's pose with its covariance decides where depth is silent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from dopepp.geometry import camera
from dopepp.inference.refinement.fit import Prior, Terms, fit_of, outline_terms
from dopepp.inference.refinement.planes import plane_terms
from dopepp.inference.refinement.search import best_shift
from dopepp.inference.refinement.solver import (
    Evidence,
    Solution,
    UndecidedError,
    descend,
)
from dopepp.inference.refinement.view import GATE, lay_over, view_around
from dopepp.inference.refinement.visible import Depth, PoseMatrix, Seen, SurfacePoints, visible


@dataclass(frozen=True)
class Stage:
    """One of the rounds from coarse to fine; lengths in diameters where nothing else is said.

    Attributes:
        reach: Largest distance from a plane that pulls.
        steps: Gauss–Newton steps.
        anew: Whether the visible points are found anew.
        search: Step of the search across the viewing axis before it; 0 for none.
        tolerance: Of that search, standard deviations of the depth; a pose that is still tilted
            needs more.
        outline: Largest difference of outlines that pulls; 0 for none.
    """

    reach: float
    steps: int = 2
    anew: bool = False
    search: float = 0.0
    tolerance: float = 0.0
    outline: float = 0.0


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
        K: camera.CameraMatrix,
        prior: Prior,
    ) -> None:
        points = camera.transform(prior.T_cam_obj, surface.points)
        if points[:, 2].min() <= 0:
            raise UndecidedError("the part reaches behind the camera")
        view = view_around(depth, K, points)
        if view is None:
            raise UndecidedError("the part lies outside the depth image")
        self.prior = prior
        self._surface, self._diameter, self._view = surface, diameter, view
        self._given_seen = visible(surface, prior.T_cam_obj)
        self._before = fit_of(view, surface, prior.T_cam_obj, self._given_seen)

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
                found = descend(start, self.prior, [self.evidence(seen, stage)], stage.steps)
            if found is None:
                raise UndecidedError("too little depth was measured on the part")
            end = found
        return end

    def seen(self, pose: camera.Transform) -> Seen:
        """Tell which of the part's points are visible at a pose."""
        return visible(self._surface, pose)

    def information(self, pose: camera.Transform, seen: Seen) -> PoseMatrix:
        """Return what is known at a pose by the prior and the depth of the points seen."""
        known = self.prior.information
        terms = self.evidence(seen)(pose, (known, np.zeros(6)))
        return known if terms is None else np.asarray(known + terms[0])

    def evidence(self, seen: Seen, stage: Stage = FINE) -> Evidence:
        """Return how the points seen pull, as a function of the pose."""
        surface, view = self._surface, self._view
        reach = max(stage.reach * self._diameter, GATE * view.noise)

        def terms(pose: camera.Transform, known: Terms) -> Terms | None:
            overlay = lay_over(view, surface, seen, pose)
            if overlay is None:
                return None
            origin = pose[:3, 3]
            H, g = plane_terms(view, overlay, origin, surface.spacing, reach)
            if not stage.outline:
                return H, g
            outline = stage.outline * self._diameter
            H_outline, g_outline = outline_terms(view, overlay, origin, surface.spacing, outline)
            return H + H_outline, g + g_outline

        return terms

    def check(self, pose: camera.Transform) -> None:
        """Raise an :class:`UndecidedError` where depth does not speak for a pose."""
        after = fit_of(self._view, self._surface, pose, self.seen(pose))
        reason = after.doubt(self._before) or self.prior.doubt(pose)
        if reason:
            raise UndecidedError(reason)

    def _searched(
        self, pose: camera.Transform, seen: Seen, stage: Stage
    ) -> camera.Transform | None:
        """Return a pose shifted to where most points find their depth."""
        shift = best_shift(
            self._view, camera.transform(pose, self._surface.points[seen]), self.prior,
            pose[:3, 3] - self.prior.T_cam_obj[:3, 3], stage.search * self._diameter,
            stage.tolerance * self._view.noise,
        )  # fmt: skip
        return None if shift is None else camera.make_transform(pose[:3, :3], pose[:3, 3] + shift)
