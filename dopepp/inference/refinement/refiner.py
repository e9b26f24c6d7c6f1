"""Refinement of poses by one solver; ``refine=`` selects the measurement terms.

``region`` uses the outline on the image, ``depth`` a depth image. With both terms:

1. The pose is refined on the image alone.
2. The result is refined on image and depth together. If the image does not determine the pose, or
   moves the pose too far from the measured surface, the start is the pose from depth alone instead.
3. A term that does not determine the pose is left out: without depth values on the part, the image
   alone refines the pose; if part and background have the same colour, depth alone does.

To add a term, extend :data:`TERMS` and :class:`PartRefiner`.
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
from dopepp.core.validation import Range, check
from dopepp.drawing.pictures import RGBImage
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
from dopepp.geometry.pnp import solve_pnp, sqpnp
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.inference.input_image import Depth
from dopepp.inference.refinement.depth import DepthEvidence
from dopepp.inference.refinement.joint_refinement import (
    JointRefinement,
    PosedImage,
    refine_views,
)
from dopepp.inference.refinement.outline import OutlineMesh
from dopepp.inference.refinement.part_surface import MIN_POINTS, Points, surface_points
from dopepp.inference.refinement.region import RegionRefiner, Starts, refinement
from dopepp.inference.refinement.region.shared_errors import SCALE_ERROR
from dopepp.inference.refinement.solver import (
    PoseMatrix,
    Prior,
    Refinement,
    Solution,
    UndecidedError,
    make_prior,
)
from dopepp.inference.refinement.verification import Verifier
from dopepp.parts.part import Part

if TYPE_CHECKING:
    from dopepp.recovery.detection import Detection

TERMS: Final = ("region", "depth")

INFLATION: Final = 3.0
"""Factor on the standard deviations of a network's pose. Its covariance was fitted to images like
the training images; errors are larger on other images."""

MIN_KEYPOINTS: Final = 4  # number of keypoints that determine a pose
NUM_QUADRUPLES: Final = 40  # nine keypoints have 126 quadruples

Refine = str | Sequence[str]  # name or names in TERMS


def refine_terms(refine: Refine | None) -> tuple[str, ...]:
    """Return the term names in ``refine`` as a tuple, empty for None."""
    return (refine,) if isinstance(refine, str) else tuple(refine or ())


class Refiner:
    """Refines the detections of several parts.

    Args:
        refine: One or several of :data:`TERMS`.
        parts: Parts, with meshes for the term ``region``.
        scale_error: Largest relative error of the parts' size or of the focal length, 0 to 0.1.

    Raises:
        UserError: A term is unknown, or a part has no mesh.
    """

    def __init__(
        self, refine: Refine, parts: Sequence[Part], scale_error: float = SCALE_ERROR
    ) -> None:
        scale_error = check("scale_error", scale_error, float, Range(0.0, 0.1))
        terms = refine_terms(refine)
        if not terms or not set(terms) <= set(TERMS):
            allowed = f"one or more of {', '.join(TERMS)}, or none"
            raise UserError(f"refine={refine!r}", allowed, "use only these words")
        self._refiners = {part.name: PartRefiner(part, terms, scale_error) for part in parts}
        self._cuboids = {part.name: part.cuboid for part in parts}
        self.verifies = "region" in terms
        """Whether refined poses are verified, which requires the term ``region``."""
        self.uses_depth = "depth" in terms
        """Whether poses are refined on depth images, if available."""

    def mesh(self, name: str) -> OutlineMesh | None:
        """Return a part's mesh, prepared for its outline; None without the term ``region``."""
        verifier = self._refiners[name].verifier
        return None if verifier is None else verifier.mesh

    def __call__(
        self,
        detection: Detection,
        image: RGBImage,
        K: CameraMatrix,
        depth: Depth | None,
        followed: bool = False,
    ) -> Detection:
        """Refine and verify a detection.

        Args:
            detection: Detection of a network, of templates, or of a tracker's last frame.
            image: RGB, without distortion.
            K: Camera matrix, pixels.
            depth: Metres along z, aligned to the image, 0 where unknown.
            followed: Whether the part was refined on the previous frame. It keeps its probability.

        Returns:
            The detection at the refined pose, or at the given pose with the reason ``kept``.
        """
        refiner, cuboid = self._refiners[detection.object], self._cuboids[detection.object]
        T_cam_obj, covariance = detection.T_cam_obj, detection.covariance
        prior, starts = covariance, None
        if not followed and np.isfinite(detection.peaks).any():  # templates have no peaks
            # A tracker predicts how far a part moves, but a network's covariance may be too small.
            starts = partial(poses_of_four, cuboid, detection.peaks, K)
            prior = INFLATION**2 * covariance
        refined = refiner.refine(image, K, T_cam_obj, prior, depth, followed, starts)
        detection = replace(detection, start=(T_cam_obj, prior))
        if refined.covariance is None:
            end = replace(detection, kept=refined.reason, agreement=None, support=None)
        else:
            end = replace(
                detection,
                T_cam_obj=refined.T_cam_obj,
                keypoints=project_keypoints(cuboid, refined.T_cam_obj, K),
                covariance=refined.covariance,
                kept="",
                agreement=refined.agreement,
                support=refined.support,
            )
        if followed:
            return end
        moved = Prior(T_cam_obj, np.linalg.inv(covariance)).squared_distance(end.T_cam_obj) ** 0.5
        return self.verified(end, image, K, moved)

    def coarse_fit(self, detection: Detection, image: RGBImage, K: CameraMatrix) -> float:
        """Return how well a detection's outline fits; see :meth:`RegionRefiner.coarse_fit`."""
        region = self._refiners[detection.object].region
        assert region is not None  # the caller requires the term ``region``
        return region.coarse_fit(image, K, detection.T_cam_obj, detection.covariance)

    def verifier(self, name: str) -> Verifier:
        """Return the verifier of a part; requires the term ``region``."""
        verifier = self._refiners[name].verifier
        assert verifier is not None  # the caller requires the term ``region``
        return verifier

    def refine_views(
        self,
        name: str,
        views: Sequence[PosedImage],
        start: Prior,
        prior: Prior,
        followed: bool = False,
    ) -> JointRefinement:
        """Refine the pose of a part in the world; see :func:`.joint_refinement.refine_views`."""
        part = self._refiners[name]
        assert part.region is not None  # the caller requires the term ``region``
        return refine_views(part.region, views, start, prior, part.surface, followed)

    def verified(
        self, detection: Detection, image: RGBImage, K: CameraMatrix, moved: float = 0.0
    ) -> Detection:
        """Return a detection with the probability that its pose is correct, if poses are verified.

        A pose is correct if ADD(-S) is below a tenth of the diameter. ``moved`` is the Mahalanobis
        distance by which refinement has moved the pose.
        """
        verifier = self._refiners[detection.object].verifier
        if verifier is None:
            return detection
        probability = verifier.probability(detection, image, K, moved)
        return replace(detection, probability=probability)


class PartRefiner:
    """Refines the poses of one part.

    Args:
        part: Part.
        terms: Measurement terms, some of :data:`TERMS`.
        scale_error: See :class:`Refiner`.

    Raises:
        UserError: The term ``region`` requires a mesh, and the part has none.
    """

    def __init__(self, part: Part, terms: Sequence[str], scale_error: float = SCALE_ERROR) -> None:
        self.region: RegionRefiner | None = None
        """Refines on the image; None without the term ``region``."""
        self.verifier: Verifier | None = None
        """Verifies poses refined on the image; None without the term ``region``."""
        if "region" in terms:
            if part.mesh is None:
                raise UserError(
                    f"refine=region with a checkpoint that has no mesh of {part.name}",
                    "a mesh of every part of the checkpoint",
                    f"add --part {part.name}=FILE and its --unit (parts=… in Python), "
                    "or train again",
                )
            self.region = RegionRefiner(part.mesh.vertices, part.mesh.faces, scale_error)
            self.verifier = Verifier(self.region.mesh, part.diameter)
        self._uses_depth, self._diameter = "depth" in terms, part.diameter
        has_surface = self._uses_depth and len(part.points) >= MIN_POINTS
        self.surface = surface_points(part.points) if has_surface else None
        """Surface points; None without the term ``depth``, or if the part has too few points."""

    def refine(
        self,
        image: RGBImage,
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
            K: Camera matrix, pixels.
            T_cam_obj: Start pose, metres.
            covariance: Covariance of the start pose (default: broad): rotation vector about the
                object's origin and shift, both in camera axes, radians and metres.
            depth: Metres along z, aligned to the image, 0 where unknown.
            followed: Whether the part was refined on the previous frame.
            starts: Further start poses; see :meth:`RegionRefiner.refine`.

        Returns:
            The refined pose and its covariance, or the start pose and the reason why it was kept.
        """
        given = np.asarray(T_cam_obj, np.float64)
        by_image = None
        if self.region is not None:
            by_image = self.region.refine(image, K, given, covariance, followed, starts)
            if depth is None or not self._uses_depth:
                return by_image
        try:
            if depth is None:
                raise UndecidedError("no depth image was given")
            if self.surface is None:
                raise UndecidedError("the part has too few surface points")
            prior = make_prior(given, self._diameter, covariance)
            evidence = DepthEvidence(self.surface, self._diameter, depth, K, prior)
            if self.region is None or by_image is None:
                return _checked(evidence, evidence.descend())
            return _refine_with_both(self.region, image, K, by_image, evidence)
        except UndecidedError as undecided:
            return by_image or Refinement(given, reason=str(undecided))


def _checked(evidence: DepthEvidence, end: Solution) -> Refinement:
    """Return the result of a descent on depth alone.

    Raises:
        UndecidedError: Depth does not fit the result, or fits the start pose as well.
    """
    evidence.check(end.T_cam_obj)
    return Refinement(end.T_cam_obj, np.linalg.inv(end.information))


def _refine_with_both(
    region: RegionRefiner,
    image: RGBImage,
    K: CameraMatrix,
    by_image: Refinement,
    evidence: DepthEvidence,
) -> Refinement:
    """Refine on image and depth together.

    The refinement starts at the pose found by the image alone. If this fails, it starts at the pose
    found by depth alone. If the image does not determine the pose, the pose found by depth alone is
    returned.

    Args:
        region: Refiner by the image.
        image: RGB, uint8.
        K: Camera matrix, pixels.
        by_image: Result of the image alone.
        evidence: Measured depth of the part.

    Raises:
        UndecidedError: Depth does not determine the pose, or contradicts the image.
    """

    def refine_from(start: Solution) -> Refinement:
        end, agreement = region.refine_with(image, K, evidence, start)
        evidence.check(end.T_cam_obj)
        return refinement(end, agreement)

    if by_image.covariance is not None:
        with contextlib.suppress(UndecidedError):  # too far from the measured surface
            return refine_from(Solution(by_image.T_cam_obj, np.linalg.inv(by_image.covariance)))
    start = evidence.descend()
    try:
        return refine_from(start)
    except UndecidedError:
        if by_image.covariance is not None:
            raise
        return _checked(evidence, start)


def poses_of_four(
    cuboid: Cuboid, peaks: Float[np.ndarray, "9 2"], K: CameraMatrix
) -> list[Transform]:
    """Solve for a pose from each of up to ``NUM_QUADRUPLES`` sets of four keypoints; deterministic.

    An occluder or a similar object displaces several keypoints together, which their covariances do
    not show. Sets without these keypoints give the correct pose.

    Args:
        cuboid: Keypoints of the part, metres.
        peaks: Measured keypoints, pixels; NaN if missing.
        K: Camera matrix.
    """
    quadruples = list(combinations(np.flatnonzero(np.isfinite(peaks).all(axis=1)), MIN_KEYPOINTS))
    order = np.random.default_rng(0).permutation(len(quadruples))[:NUM_QUADRUPLES]
    poses = []
    for number in order:
        four = list(quadruples[number])
        pose = sqpnp(cuboid[four], peaks[four], K)
        if np.isfinite(pose).all() and pose[5] > 0:
            poses.append(make_transform(rotation_vector_to_matrix(pose[:3]), pose[3:]))
    return poses


def warm_up_pose() -> None:
    """Solve for the pose of a box, which compiles the inner loops.

    See :func:`~dopepp.core.compiled.compile_in_background`.
    """
    corners, K, _, pixels = _box()
    pixels[0] += 20.0
    solve_pnp(corners, pixels, K, covariance_px=np.tile(np.eye(2), (8, 1, 1)))


def warm_up_refinement() -> None:
    """Refine the pose of a drawn box, which compiles the inner loops; see :func:`warm_up_pose`."""
    corners, K, T, pixels = _box()
    image = np.full((128, 128, 3), 40, np.uint8)
    cv2.fillConvexPoly(image, cv2.convexHull(np.rint(pixels).astype(np.int32)), (200, 160, 90))
    sides = np.array(
        [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    )
    triangles = np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]])
    RegionRefiner(corners, triangles).refine(image, K, T, starts=list)


def _box() -> tuple[Points, CameraMatrix, Transform, Float[np.ndarray, "8 2"]]:
    """Return a box's corners (object frame), K, its pose and the corners' pixels."""
    corners = 0.06 * (np.array(list(np.ndindex(2, 2, 2))) - 0.5)
    rotation = rotation_vector_to_matrix(np.array([0.5, 0.4, 0.3]))
    K, T = camera_matrix(120, 120, 63.5, 63.5), make_transform(rotation, np.array([0.0, 0.0, 0.2]))
    return corners, K, T, project(transform(T, corners), K)
