"""Refinement of one pose on several images of a static scene with known camera poses.

The unknown is the part's pose in the world. Every view contributes the terms of a single image,
with separate errors of offset and scale. A step of the solver is a rotation about the object's
origin and a shift of the origin, in world axes. In a camera, the same step has rotated axes.

The error of a camera's pose changes the part's pose in this camera only. The error is normally
distributed with a given covariance. Its elimination adds this covariance to the covariance of the
pose that the view's equations imply.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix, Transform, rotation_lever
from dopepp.geometry.rotation import RotationMatrix, Vector
from dopepp.inference.input_image import Depth
from dopepp.inference.refinement.depth import DepthEvidence
from dopepp.inference.refinement.part_surface import SurfacePoints
from dopepp.inference.refinement.region import (
    MAX_REPEATS,
    RegionRefiner,
    has_converged,
    necessary_rounds,
    search_distance,
)
from dopepp.inference.refinement.region.round import OutlineAgreement, Round
from dopepp.inference.refinement.region.shifts import FOLLOWED, JOINT, Weights
from dopepp.inference.refinement.solver import (
    NormalEquations,
    PoseMatrix,
    Prior,
    Solution,
    Term,
    UndecidedError,
    descend,
)

NEGLIGIBLE: Final = 1e-6
"""Share of the largest information below which a direction is undetermined."""


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image with its camera matrix and the pose of its camera."""

    image: RGBImage  # RGB, without lens distortion
    K: CameraMatrix
    T_cam_world: Transform
    # Covariance of the camera's pose: rotation vector about the camera's centre and shift of the
    # scene, in camera axes
    error: PoseMatrix
    depth: Depth | None = None  # metres along z

    def pose(self, T_world_obj: Transform) -> Transform:
        """Transform a pose from the world to the camera."""
        return np.asarray(self.T_cam_world @ T_world_obj)

    def error_at(self, position: Vector) -> PoseMatrix:
        """Return the covariance of a part's pose due to the camera's error, in camera axes.

        ``position`` is the object's origin in the camera frame, metres.
        """
        lever = rotation_lever(position)  # from a rotation about the camera's centre
        return np.asarray(lever @ self.error @ lever.T)

    def to_world(self, T_cam_obj: Transform, covariance: PoseMatrix) -> Prior:
        """Convert pose and covariance to the world; add the error of the camera's pose."""
        T_world_obj = np.linalg.inv(self.T_cam_world) @ T_cam_obj
        both = covariance + self.error_at(T_cam_obj[:3, 3])
        in_world = rotate_covariance(self.T_cam_world[:3, :3].T, both)
        return Prior(T_world_obj, np.linalg.inv(in_world))

    def to_camera(self, T_world_obj: Transform, covariance: PoseMatrix) -> Prior:
        """Convert pose and covariance to the camera frame; add the error of the camera's pose."""
        T_cam_obj = self.pose(T_world_obj)
        error = self.error_at(T_cam_obj[:3, 3])
        both = rotate_covariance(self.T_cam_world[:3, :3], covariance) + error
        return Prior(T_cam_obj, np.linalg.inv(both))


def rotate_covariance(R: RotationMatrix, matrix: PoseMatrix) -> PoseMatrix:
    """Rotate the axes of a pose's covariance or information by R."""
    R_step = _step_rotation(R)
    return np.asarray(R_step @ matrix @ R_step.T)


def _step_rotation(R: RotationMatrix) -> PoseMatrix:
    """Return the 6×6 matrix that rotates both the rotation and the translation of a step."""
    R_step = np.zeros((6, 6))
    R_step[:3, :3] = R_step[3:, 3:] = R
    return R_step


@dataclass(frozen=True, eq=False)
class ViewTerm:
    """Solver term of one view, for the pose in the world."""

    term: Term
    view: PosedImage

    def __call__(self, pose: Transform, prior: NormalEquations, /) -> NormalEquations | None:
        """Linearise the term; see :class:`~dopepp.inference.refinement.solver.Term`."""
        T_cam_obj, R_step = self.view.pose(pose), _step_rotation(self.view.T_cam_world[:3, :3])
        error = self.view.error_at(T_cam_obj[:3, 3])
        given = _widened(R_step @ prior[0] @ R_step.T, R_step @ prior[1], error)
        equations = self.term(T_cam_obj, given)
        if equations is None:
            return None
        H, g = _widened(*equations, error)
        return R_step.T @ H @ R_step, R_step.T @ g


def _widened(H: PoseMatrix, g: Vector, covariance: PoseMatrix) -> NormalEquations:
    """Add a covariance C to normal equations without moving their mean: H becomes (H⁻¹ + C)⁻¹."""
    solved = np.linalg.solve(np.eye(6) + H @ covariance, np.column_stack([H, g]))
    return (solved[:, :6] + solved[:, :6].T) / 2, solved[:, 6]


@dataclass(frozen=True, eq=False)
class JointRefinement:
    """Pose refined on several images, with its covariance and each view's agreement."""

    T_world_obj: Transform
    covariance: PoseMatrix  # rotation vector about the object's origin and shift, world axes
    agreements: Sequence[OutlineAgreement | None]  # of each view; None without the outline
    # Mahalanobis distance per √degree of freedom between each view and all other views
    disagreements: Sequence[float]
    informations: Sequence[PoseMatrix]  # added by each view, world axes


def refine_views(
    region: RegionRefiner,
    views: Sequence[PosedImage],
    start: Prior,
    prior: Prior,
    surface: SurfacePoints | None = None,
    followed: bool = False,
) -> JointRefinement:
    """Refine a pose in the world on all views that show the part's outline.

    Args:
        region: Refiner of the part.
        views: Images with the poses of their cameras.
        start: Pose in the world from which the search starts; its information limits the search.
        prior: Distribution of the pose before the images' outlines are used.
        surface: Surface points of the part, for views with depth.
        followed: Whether the part was refined on the previous images.

    Raises:
        UndecidedError: No view shows the part's outline, at the start or later.
    """
    covariance, weights = np.linalg.inv(start.information), FOLLOWED if followed else JOINT
    searches: list[_ViewSearch] = []
    for number, view in enumerate(views):
        try:
            given = number, view, region, start.T_cam_obj, covariance, weights
            searches.append(_ViewSearch(*given))
        except UndecidedError:
            continue
        if surface is not None and view.depth is not None:
            searches[-1].add_depth(surface)
    end = Solution(start.T_cam_obj, prior.information)
    num_stages = max((len(search.rounds) for search in searches), default=0)
    terms: list[Term] = []
    # As for a single image, the last stage is repeated until it converges.
    for stages_left in (*range(num_stages, 0, -1), *[1] * MAX_REPEATS):
        searches = [search for search in searches if search.learn(end.T_cam_obj, stages_left)]
        terms = [term for search in searches for term in search.terms(stages_left)]
        steps = max((search.round(stages_left).stage.steps for search in searches), default=0)
        solution = descend(end.T_cam_obj, prior, terms, steps)
        if solution is None or not terms:
            raise UndecidedError("the part's outline left the image")
        end, before = solution, end.T_cam_obj
        if stages_left == 1 and has_converged(end, before):
            break
    agreements: list[OutlineAgreement | None] = [None] * len(views)
    for search in searches:
        agreements[search.number] = search.agreement(end.T_cam_obj)
    owners = [search.number for search in searches for _ in search.terms(1)]
    distances = _disagreements(end, prior, owners)
    disagreements = [distances.get(number, 0.0) for number in range(len(views))]
    informations = [np.zeros((6, 6)) for _ in views]
    for number, equations in zip(owners, end.equations, strict=True):
        informations[number] += equations[0]
    covariance = np.linalg.inv(end.information)
    return JointRefinement(end.T_cam_obj, covariance, agreements, disagreements, informations)


@dataclass(eq=False)
class _ViewSearch:
    """Rounds of refinement on one view, with the term of its depth image.

    Raises:
        UndecidedError: Too little of the outline is on the image.
    """

    number: int  # index of the view
    view: PosedImage
    region: RegionRefiner  # refiner of the part
    T_world_obj: Transform  # start pose in the world
    covariance: PoseMatrix  # covariance of the start pose, world axes
    weights: Weights  # weights of colours and edges

    def __post_init__(self) -> None:
        view = self.view
        self._start = view.to_camera(self.T_world_obj, self.covariance)
        rounds = self.region.rounds(view.image, view.K, self._start.T_cam_obj, self.weights)
        self._reach = search_distance(rounds[0], self._start)
        self.rounds: Sequence[Round] = necessary_rounds(rounds, self._reach)
        self._depth: list[Term] = []

    def add_depth(self, surface: SurfacePoints) -> None:
        """Add the term of the view's depth image, if the part is on it."""
        assert self.view.depth is not None
        try:
            given = surface, self.region.diameter, self.view.depth, self.view.K, self._start
            evidence = DepthEvidence(*given)
        except UndecidedError:
            return
        self._depth = [evidence.term(evidence.visible(self._start.T_cam_obj))]

    def round(self, left: int) -> Round:
        """Return the ``left``-th round from the end, or the first round if there are fewer."""
        return self.rounds[max(0, len(self.rounds) - left)]

    def learn(self, T_world_obj: Transform, left: int) -> bool:
        """Learn part and background colours at a pose; return False if too little is visible."""
        stage, pose = self.round(left), self.view.pose(T_world_obj)
        try:
            stage.learn(pose, self._reach)
        except UndecidedError:
            return False
        return stage.contour(pose) is not None

    def terms(self, left: int) -> list[Term]:
        """Return the depth and outline terms of a refinement round, for the pose in the world."""
        terms = [*self._depth, self.round(left).term(self._reach)]
        return [ViewTerm(term, self.view) for term in terms]

    def agreement(self, T_world_obj: Transform) -> OutlineAgreement | None:
        """Return the outline's agreement with the image, or None if too little of it is visible."""
        try:
            return self.rounds[-1].agreement(self.view.pose(T_world_obj), self._reach)
        except UndecidedError:
            return None


def _disagreements(end: Solution, prior: Prior, owners: Sequence[int]) -> dict[int, float]:
    """Return how much each view contradicts the other views and the prior.

    Args:
        end: Pose with the equations of each term.
        prior: Prior of the descent.
        owners: Index of the view of each term.

    Returns:
        Mahalanobis distance per √degree of freedom by index of the view; empty for a single view.
    """
    distances: dict[int, float] = {}
    gradient = prior.information @ prior.offset(end.T_cam_obj)
    for owner in set(owners) if len(set(owners)) > 1 else ():
        H, g, H_others, g_others = np.zeros((6, 6)), np.zeros(6), prior.information, gradient
        for number, equations in zip(owners, end.equations, strict=True):
            if number == owner:
                H, g = H + equations[0], g + equations[1]
            else:
                H_others, g_others = H_others + equations[0], g_others + equations[1]
        solved = np.linalg.solve(H_others, np.column_stack([g_others, H]))
        rest, spread = g - H @ solved[:, 0], H + H @ solved[:, 1:]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(spread), 1e-300))
        values, axes = np.linalg.eigh(spread * np.outer(scale, scale))
        is_known = values > NEGLIGIBLE * values[-1]
        along = (axes.T @ (scale * rest))[is_known]
        squared = float((along**2 / values[is_known]).sum())
        distances[owner] = math.sqrt(squared / max(1, is_known.sum()))
    return distances
