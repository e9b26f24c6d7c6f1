"""Poses refined with depth: point-to-plane ICP around the RGB pose, kept only when it fits better.

The part is its surface points, so a checkpoint is all that is needed. Three kinds of evidence enter
one Gauss–Newton step: small_gicp's point-to-plane terms, which fix what a surface's shape fixes;
the outline (see :mod:`dopepp.inference.refinement.fit`), which keeps a flat plate from sliding in
its own plane; and the RGB pose with its covariance, which decides where depth is silent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import Final

import numpy as np

from dopepp.core.errors import require
from dopepp.geometry import camera
from dopepp.inference.refinement.fit import Fit, Prior, Terms, fit_of, make_prior, outline_terms
from dopepp.inference.refinement.search import best_shift
from dopepp.inference.refinement.view import GATE, DepthView, Overlay, lay_over, view_around
from dopepp.inference.refinement.visible import (
    FEWEST_POINTS,
    Depth,
    PoseMatrix,
    Seen,
    SurfacePoints,
    surface_points,
    visible,
)
from dopepp.parts.part import Part


@dataclass(frozen=True)
class Stage:
    """One of the rounds from coarse to fine; lengths in diameters where nothing else is said.

    Attributes:
        reach: Correspondence distance of the point-to-plane terms.
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


STAGES: Final = (
    Stage(0.06, search=0.025, tolerance=5.0),
    Stage(0.045, search=0.0125, tolerance=3.0),
    Stage(0.03, steps=3, anew=True, outline=0.05),
)

PLANE_NEIGHBOURS: Final = 8
"""Visible points that small_gicp estimates a plane from."""

MOST_PIXELS: Final = 500
"""Depth points in a step."""

INDEPENDENT: Final = 100.0
"""So many independent measurements stand behind any number of neighbouring pixels."""


@dataclass(frozen=True)
class Refinement:
    """What depth or the picture has made of a pose.

    Attributes:
        T_cam_obj: The refined pose, or the one that was given.
        covariance: Of the refined pose, as :class:`~dopepp.geometry.pnp.PnPResult` defines it; None
            where the given pose was kept.
        reason: Why the given pose was kept; empty where it was refined.
        fit: How well the refined pose fits the depth; None where there was nothing to fit.
        agreement: Share of what the picture tells about the refined outline that agrees with it;
            None without it.
        support: Share of the refined outline that the picture tells about and that agrees; None
            without it.
    """

    T_cam_obj: camera.Transform
    covariance: PoseMatrix | None = None
    reason: str = ""
    fit: Fit | None = None
    agreement: float | None = None
    support: float | None = None


class DepthRefiner:
    """Refines the poses of some parts; a :class:`UserError` if the extra ``depth`` is missing."""

    def __init__(self, parts: Sequence[Part]) -> None:
        require("small_gicp", "refine=depth", "depth")
        self._gicp: ModuleType = import_module("small_gicp")
        large = [part for part in parts if len(part.points) >= FEWEST_POINTS]
        self._surfaces = {part.name: surface_points(part.points) for part in large}
        self._diameters = {part.name: part.diameter for part in parts}

    def refine(
        self,
        name: str,
        T_cam_obj: camera.Transform,
        depth: Depth,
        K: camera.CameraMatrix,
        covariance: PoseMatrix | None = None,
    ) -> Refinement:
        """Refine one pose, metres, of a part by its name.

        Depth is in metres along z, aligned to the image of K, 0 where unknown. The covariance is
        that of the given pose: rotation vector about the object's origin and shift, both in camera
        axes, radians and metres; without it, a broad one is taken. An unknown part is a
        ``KeyError``.
        """
        given, diameter = np.asarray(T_cam_obj, np.float64), self._diameters[name]
        surface = self._surfaces.get(name)
        if surface is None:
            return Refinement(given, reason="the part has too few surface points")
        points = camera.transform(given, surface.points)
        if points[:, 2].min() <= 0:
            return Refinement(given, reason="the part reaches behind the camera")
        view = view_around(depth, K, points)
        if view is None:
            return Refinement(given, reason="the part lies outside the depth image")
        prior = make_prior(given, diameter, covariance)
        seen = visible(surface, given)
        found = self._descend(view, surface, diameter, prior, seen)
        if found is None:
            return Refinement(given, reason="too little depth was measured on the part")
        pose, information = found
        after = fit_of(view, surface, pose, visible(surface, pose))
        before = fit_of(view, surface, given, seen)
        reason = after.doubt(before) or prior.doubt(pose)
        if reason:
            return Refinement(given, reason=reason, fit=after)
        return Refinement(pose, np.linalg.inv(information), fit=after)

    def _descend(
        self, view: DepthView, surface: SurfacePoints, diameter: float, prior: Prior, seen: Seen
    ) -> tuple[camera.Transform, PoseMatrix] | None:
        """Search and descend, coarse to fine; return the pose and the information behind it.

        ``seen`` are the visible points at the prior's pose.
        """
        pose = prior.T_cam_obj
        information = prior.information
        plane = self._plane_terms(surface, seen)
        for stage in STAGES:
            if stage.anew:
                seen = visible(surface, pose)
                plane = self._plane_terms(surface, seen)
            if stage.search:
                shift = best_shift(
                    view, camera.transform(pose, surface.points[seen]), prior,
                    pose[:3, 3] - prior.T_cam_obj[:3, 3], stage.search * diameter,
                    stage.tolerance * view.noise,
                )  # fmt: skip
                if shift is None:
                    return None
                pose = camera.make_transform(pose[:3, :3], pose[:3, 3] + shift)
            reach = max(stage.reach * diameter, GATE * view.noise)
            for _ in range(stage.steps):
                overlay = lay_over(view, surface, seen, pose)
                if overlay is None:
                    return None
                H_plane, g_plane = plane(view, overlay, pose, reach)
                information = H_plane + prior.information
                pull = g_plane + prior.information @ prior.offset(pose)
                if stage.outline:
                    H_outline, g_outline = outline_terms(
                        view, overlay, pose[:3, 3], surface.spacing, stage.outline * diameter
                    )
                    information, pull = information + H_outline, pull + g_outline
                pose = camera.moved(pose, np.linalg.solve(information, pull))
        return pose, information

    def _plane_terms(
        self, surface: SurfacePoints, seen: Seen
    ) -> Callable[[DepthView, Overlay, camera.Transform, float], Terms]:
        """Return small_gicp's point-to-plane terms against a part's visible points."""
        gicp = self._gicp
        target = gicp.PointCloud(surface.points[seen])
        tree = gicp.KdTree(target)
        gicp.estimate_normals(target, tree, PLANE_NEIGHBOURS)

        def terms(view: DepthView, overlay: Overlay, pose: camera.Transform, reach: float) -> Terms:
            covered = overlay.covered & (np.abs(overlay.offset) <= reach)
            points = view.points(covered)
            points = points[:: -(-len(points) // MOST_PIXELS) or 1]
            if not len(points):
                return np.zeros((6, 6)), np.zeros(6)
            # One iteration, so H and b are those at this pose, and the step is left to us.
            one = gicp.align(
                target, gicp.PointCloud(points), tree, camera.invert_transform(pose), "PLANE_ICP",
                max_correspondence_distance=reach, max_iterations=1,
            )  # fmt: skip
            # It turns and shifts the depth about the camera; a move of the part is the opposite.
            to_camera = -np.eye(6)
            to_camera[3:, :3] = -np.cross(np.eye(3), pose[:3, 3])
            deviation = view.noise**2 + (surface.spacing / 4) ** 2
            weight = min(1.0, INDEPENDENT / max(1, one.num_inliers)) / deviation
            H = to_camera.T @ one.H @ to_camera * weight
            return H, -weight * to_camera.T @ np.ravel(one.b)

        return terms
