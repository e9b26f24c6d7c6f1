"""Poses made precise: one solver, and the evidence that ``refine=`` names as its terms.

``region`` is the outline on the picture, ``depth`` a depth image. Where both are asked for, the
picture alone leads to a start, or depth where the picture does not decide or leads too far from the
measured surface; from there both pull at once. What does not decide is left out: without depth the
picture refines alone, and depth alone where part and background are of one colour.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import (
    CameraMatrix,
    Transform,
    camera_matrix,
    make_transform,
    project,
    project_keypoints,
    transform,
)
from dopepp.geometry.cuboid import Cuboid
from dopepp.geometry.pnp import solve_pnp
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.inference.picture import Depth
from dopepp.inference.refinement.depth import DepthEvidence
from dopepp.inference.refinement.region import RegionRefiner, Starts, refinement
from dopepp.inference.refinement.solver import (
    PoseMatrix,
    Refinement,
    Solution,
    UndecidedError,
    make_prior,
)
from dopepp.inference.refinement.surface import FEWEST_POINTS, Points, surface_points
from dopepp.parts.part import Part

if TYPE_CHECKING:
    from dopepp.recovery.detection import Detection

TERMS: Final = ("region", "depth")

LOOSER: Final = 3.0
"""Factor on the deviations of a network's pose: its covariance was learned on pictures like those
of its training, and it is farther off on others."""

FEW: Final = 4  # keypoints that fix a pose
NUM_QUADRUPLES: Final = 40  # of the 126 of nine keypoints

Refine = str | Sequence[str]  # what `refine=` takes: one of TERMS, or several


class Refiner:
    """Refines the detections of some parts by one or several of :data:`TERMS`.

    Raises:
        UserError: There is no such term, or a part has no mesh whose outline it could use.
    """

    def __init__(self, refine: Refine, parts: Sequence[Part]) -> None:
        terms = checked_terms(refine)
        self._refiners = {part.name: PartRefiner(part, terms) for part in parts}
        self._cuboids = {part.name: part.cuboid for part in parts}

    def __call__(
        self, detection: Detection, image: Picture, K: CameraMatrix, depth: Depth | None
    ) -> Detection:
        """Return the refined detection, or the given one with the reason why it was kept."""
        cuboid, T_cam_obj = self._cuboids[detection.object], detection.T_cam_obj
        refine, covariance = self._refiners[detection.object].refine, detection.covariance
        if detection.agreement is not None:  # set by refinement only: the part is tracked
            refined = refine(image, K, T_cam_obj, covariance, depth, followed=True)
        else:
            # A tracker knows how far a part may have moved; a network's covariance may be wrong.
            starts = partial(poses_of_four, cuboid, detection.peaks, K)
            covariance = LOOSER**2 * covariance
            refined = refine(image, K, T_cam_obj, covariance, depth, starts=starts)
        if refined.covariance is None:
            return replace(detection, kept=refined.reason, agreement=None, support=None)
        return replace(
            detection,
            T_cam_obj=refined.T_cam_obj,
            keypoints=project_keypoints(cuboid, refined.T_cam_obj, K),
            covariance=refined.covariance,
            kept="",
            agreement=refined.agreement,
            support=refined.support,
        )


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
                return _by_depth(measured, measured.descend())
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


def poses_of_four(
    cuboid: Cuboid, peaks: Float[np.ndarray, "9 2"], K: CameraMatrix
) -> list[Transform]:
    """Return the poses of several quadruples of measured keypoints, always the same ones.

    What hides a part, or looks like it, puts several keypoints wrong together, which no keypoint's
    own covariance tells; the others are right.

    Args:
        cuboid: The part's keypoints, metres.
        peaks: Those measured on the picture, pixels; NaN where there is none.
        K: Camera matrix.
    """
    quadruples = list(combinations(np.flatnonzero(np.isfinite(peaks).all(axis=1)), FEW))
    order = np.random.default_rng(0).permutation(len(quadruples))[:NUM_QUADRUPLES]
    poses = []
    for number in order:
        few = list(quadruples[number])
        try:
            found, turn, place = cv2.solvePnP(
                cuboid[few], peaks[few], K, None, flags=cv2.SOLVEPNP_SQPNP
            )
        except cv2.error:  # all four in one place
            continue
        if found and np.isfinite(turn).all() and place[2, 0] > 0:
            poses.append(make_transform(rotation_vector_to_matrix(turn[:, 0]), place[:, 0]))
    return poses


def rehearse_pose() -> None:
    """Solve for the pose of a box, which compiles the inner loops.

    See :func:`~dopepp.core.compiled.compile_beside`.
    """
    corners, K, _, pixels = _box()
    pixels[0] += 20.0
    solve_pnp(corners, pixels, K, covariance_px=np.tile(np.eye(2), (8, 1, 1)))


def rehearse_refinement() -> None:
    """Refine the pose of a drawn box, as :func:`rehearse_pose` does."""
    corners, K, T, pixels = _box()
    image = np.full((128, 128, 3), 40, np.uint8)
    cv2.fillConvexPoly(image, cv2.convexHull(np.rint(pixels).astype(np.int32)), (200, 160, 90))
    sides = np.array(
        [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    )
    triangles = np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]])
    RegionRefiner(corners, triangles).refine(image, K, T, starts=list)


def _box() -> tuple[Points, CameraMatrix, Transform, Float[np.ndarray, "8 2"]]:
    """Return the corners of a box, a camera, the box's pose and the corners' pixels."""
    corners = 0.06 * (np.array(list(np.ndindex(2, 2, 2))) - 0.5)
    turn = rotation_vector_to_matrix(np.array([0.5, 0.4, 0.3]))
    K, T = camera_matrix(120, 120, 63.5, 63.5), make_transform(turn, np.array([0.0, 0.0, 0.2]))
    return corners, K, T, project(transform(T, corners), K)


def _by_depth(measured: DepthEvidence, end: Solution) -> Refinement:
    """Return depth's own end; an :class:`UndecidedError` where depth does not decide for it."""
    measured.check(end.T_cam_obj)
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

    def together(start: Solution) -> Refinement:
        end, agreement = region.refine_with(image, K, measured, start)
        measured.check(end.T_cam_obj)
        return refinement(end, agreement)

    if alone.covariance is not None:
        with contextlib.suppress(UndecidedError):  # too far from the surface that depth shows
            return together(Solution(alone.T_cam_obj, np.linalg.inv(alone.covariance)))
    start = measured.descend()
    try:
        return together(start)
    except UndecidedError:
        if alone.covariance is not None:
            raise
        return _by_depth(measured, start)


def _region(part: Part) -> RegionRefiner:
    if part.mesh is None:
        raise UserError(
            f"refine=region and no mesh of {part.name} in the checkpoint",
            "a mesh of every part of the checkpoint",
            f"add --part {part.name}=FILE and its --unit (parts=… in Python), or train again",
        )
    return RegionRefiner(part.mesh.vertices, part.mesh.faces)
