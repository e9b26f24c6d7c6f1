"""Poses made precise: one solver, and the evidence that ``refine=`` names as its terms.

``region`` is the outline on the picture, ``depth`` a depth image. Where both are asked for, the
picture alone leads to a start, or depth where the picture does not decide or leads too far from the
measured surface; from there both pull at once. What does not decide is left out: without depth the
picture refines alone, and depth alone where part and background are of one colour.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import CameraMatrix, Transform
from dopepp.inference.refinement.depth import DepthEvidence
from dopepp.inference.refinement.fit import make_prior
from dopepp.inference.refinement.region import RegionRefiner, Starts, refinement
from dopepp.inference.refinement.solver import Refinement, Solution, UndecidedError
from dopepp.inference.refinement.starts import poses_of_four
from dopepp.inference.refinement.visible import FEWEST_POINTS, Depth, PoseMatrix, surface_points
from dopepp.parts.part import Part
from dopepp.recovery.detection import Detection

TERMS: Final = ("region", "depth")

LOOSER: Final = 3.0
"""Factor on the deviations of a network's pose: its covariance was learned on pictures like those
of its training, and it is farther off on others."""

Refine = str | Sequence[str]
"""What ``refine=`` takes: one of :data:`TERMS`, or several."""

Refiner = Callable[[Detection, Picture, CameraMatrix, Depth | None], Refinement]
"""From a detection on a picture, with its depth where there is one, to the refined pose, or to the
given one and why it was kept."""


def make_refiner(refine: Refine, parts: Sequence[Part]) -> Refiner:
    """Return what refines the poses of these parts by one or several of :data:`TERMS`.

    A :class:`UserError`: there is none of that name, or a part has no mesh whose outline it could
    use.
    """
    terms = checked_terms(refine)
    refiners = {part.name: PartRefiner(part, terms) for part in parts}
    cuboids = {part.name: part.cuboid for part in parts}

    def refined(one: Detection, image: Picture, K: CameraMatrix, depth: Depth | None) -> Refinement:
        followed = one.agreement is not None  # which only refinement gives
        # A tracker knows how far a part may have moved; a network may be wrong about that.
        starts = None if followed else partial(poses_of_four, cuboids[one.object], one.peaks, K)
        covariance = one.covariance if followed else LOOSER**2 * one.covariance
        return refiners[one.object].refine(
            image, K, one.T_cam_obj, covariance, depth, followed, starts
        )

    return refined


def checked_terms(refine: Refine) -> tuple[str, ...]:
    """Return the names of the terms; a :class:`UserError` for what is none of them."""
    terms = (refine,) if isinstance(refine, str) else tuple(refine)
    if not terms or not set(terms) <= set(TERMS):
        allowed = f"{', '.join(TERMS)}, several of them, or none"
        raise UserError(f"refine={refine!r}", allowed, "choose among them")
    return terms


class PartRefiner:
    """Refines the poses of one part.

    Args:
        part: The part.
        terms: The evidence, some of :data:`TERMS`.

    Raises:
        UserError: The picture's outline is asked for, and the part has no mesh.
    """

    def __init__(self, part: Part, terms: Sequence[str]) -> None:
        self._region = _region(part) if "region" in terms else None
        self._by_depth, self._diameter = "depth" in terms, part.diameter
        large = self._by_depth and len(part.points) >= FEWEST_POINTS
        self._surface = surface_points(part.points) if large else None

    def refine(
        self,
        image: Picture,
        K: CameraMatrix,
        T_cam_obj: Transform,
        covariance: PoseMatrix | None = None,
        depth: Depth | None = None,
        followed: bool = False,
        starts: Starts | None = None,
    ) -> Refinement:
        """Refine one pose.

        Args:
            image: RGB.
            K: Its camera matrix, pixels.
            T_cam_obj: The pose to start from, metres.
            covariance: Of the given pose: rotation vector about the object's origin and shift, both
                in camera axes, radians and metres. Without it, a broad one is taken.
            depth: Metres along z, aligned to the image, 0 where unknown.
            followed: Whether the pose follows from one that was refined on the frame before.
            starts: As :meth:`RegionRefiner.refine` takes it.

        Returns:
            The refined pose with its covariance, or the given one with the reason why it was kept.
        """
        given = np.asarray(T_cam_obj, np.float64)
        if not np.isfinite(given).all():
            return Refinement(given, reason="the pose is not finite")
        alone = None
        if self._region is not None:
            alone = self._region.refine(image, K, given, covariance, followed, starts)
        if alone is not None and (depth is None or not self._by_depth):
            return alone
        try:
            measured = self._measured(K, given, covariance, depth)
            if self._region is None or alone is None:
                return _by_depth(measured)
            return _by_both(self._region, image, K, alone, measured)
        except UndecidedError as undecided:
            return alone or Refinement(given, reason=str(undecided))

    def _measured(
        self,
        K: CameraMatrix,
        given: Transform,
        covariance: PoseMatrix | None,
        depth: Depth | None,
    ) -> DepthEvidence:
        """Return what depth says; an :class:`UndecidedError` where that is nothing."""
        if depth is None:
            raise UndecidedError("no depth image was given")
        if self._surface is None:
            raise UndecidedError("the part has too few surface points")
        prior = make_prior(given, self._diameter, covariance)
        return DepthEvidence(self._surface, self._diameter, depth, K, prior)


def _by_depth(measured: DepthEvidence) -> Refinement:
    """Refine with depth alone; an :class:`UndecidedError` where it does not decide."""
    end = measured.descend()
    measured.check(end.T_cam_obj)
    return _of_depth(end)


def _of_depth(end: Solution) -> Refinement:
    return Refinement(end.T_cam_obj, np.linalg.inv(end.information))


def _by_both(
    region: RegionRefiner,
    image: Picture,
    K: CameraMatrix,
    alone: Refinement,
    measured: DepthEvidence,
) -> Refinement:
    """Refine on picture and depth, from where the picture alone has led, or else from depth's end.

    Where the picture does not decide, depth's own end is what remains.

    Raises:
        UndecidedError: Depth does not decide, or contradicts what the picture has decided.
    """
    if alone.covariance is not None:
        start = Solution(alone.T_cam_obj, np.linalg.inv(alone.covariance))
        with contextlib.suppress(UndecidedError):  # too far from the surface that depth shows
            return _together(region, image, K, start, measured)
    start = measured.descend()
    try:
        return _together(region, image, K, start, measured)
    except UndecidedError:
        if alone.covariance is not None:
            raise
        measured.check(start.T_cam_obj)
        return _of_depth(start)


def _together(
    region: RegionRefiner,
    image: Picture,
    K: CameraMatrix,
    start: Solution,
    measured: DepthEvidence,
) -> Refinement:
    """Refine on both; an :class:`UndecidedError` where one of them speaks against the end."""
    end, agreement = region.refine_with(image, K, measured, start)
    measured.check(end.T_cam_obj)
    return refinement(end, agreement)


def _region(part: Part) -> RegionRefiner:
    if part.mesh is None:
        raise UserError(
            f"refine=region and no mesh of {part.name} in the checkpoint",
            "a mesh of every part of the checkpoint",
            f"add --part {part.name}=FILE and its --unit (parts=… in Python), or train again",
        )
    return RegionRefiner(part.mesh.vertices, part.mesh.faces)
