"""Poses of parts from several images of a static scene with known camera poses.

1. Each view is searched alone.
2. Detections of several views that agree in the world are associated with one part
   (:mod:`~dopepp.inference.several_views.observations`).
3. The pose of each part is refined on all views together and verified in each view
   (:mod:`~dopepp.inference.several_views.joint`). If no pose is probable, a pose is searched in the
   belief maps of all views (:mod:`~dopepp.inference.several_views.joint_search`).
4. Of several parts with the same name and pose, the part with the best score remains.
5. Contradictions between views are reported
   (:mod:`~dopepp.inference.several_views.contradictions`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.core.validation import Range, check
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix, Step, Transform, invert_transform
from dopepp.geometry.camera_file import Camera
from dopepp.geometry.rotation import is_rigid
from dopepp.inference.input_image import Depth, Distances, Region, prepare_image
from dopepp.inference.pose_result import PoseResult, Shape, elapsed_by_step
from dopepp.inference.refinement.joint_refinement import PosedImage
from dopepp.inference.several_views.contradictions import contradictions
from dopepp.inference.several_views.joint import JointEstimator
from dopepp.inference.several_views.joint_search import JointSearch
from dopepp.inference.several_views.observations import (
    PartGeometry,
    PartObservation,
    associate,
    make_observation,
)
from dopepp.inference.several_views.views_result import ViewsResult, WorldDetection

if TYPE_CHECKING:
    from dopepp.inference.estimator import PoseEstimator, SeenMaps
    from dopepp.recovery.detection import Detection

CAMERA_ERROR: Final = (2e-4, math.radians(0.02))
"""Default standard deviations of a camera's pose: position along each axis (metres), rotation about
each axis (radians). These errors are typical after a hand-eye calibration."""


def joint_estimator(
    estimator: PoseEstimator,
    images: Sequence[RGBImage],
    cameras: Sequence[Camera | CameraMatrix],
    T_world_cam: Sequence[Transform],
    depths: Sequence[Depth] | None = None,
    camera_error: tuple[float, float] | None = None,
    names: Sequence[str] | None = None,
) -> JointEstimator:
    """Return the estimator of joint poses on several images.

    The arguments are those of :meth:`PoseEstimator.predict_views`.

    Raises:
        UserError: The estimator does not refine by region, or an argument is invalid.
    """
    refiner = estimator.refiner
    if refiner is None or not refiner.verifies:
        fix = "load the estimator with refine='region'"
        problem = f"several views with refine={estimator.refine}"
        raise UserError(problem, "refine='region', or region and depth", fix)
    names = names or [f"view {number}" for number in range(len(images))]
    shift, rotation_error = (
        check(f"camera_error[{n}]", error, float, Range(0.0, 1.0))
        for n, error in enumerate(CAMERA_ERROR if camera_error is None else camera_error)
    )
    error = np.diag(np.repeat([rotation_error, shift], 3) ** 2)
    count = len(images)
    lengths = {"cameras": cameras, "T_world_cam": T_world_cam, "depths": depths, "names": names}
    for name, values in lengths.items():
        if values is not None and len(values) != count:
            problem = f"{len(values)} {name} for {count} images"
            raise UserError(problem, f"{count}, one for each image", f"pass {count} {name}")
    views = []
    for number, (image, camera) in enumerate(zip(images, cameras, strict=True)):
        if isinstance(camera, Camera):
            resized = camera.for_picture((image.shape[1], image.shape[0]))
            K, distortion, cropped = resized.K, resized.coefficients, resized.cropped
        else:
            K, distortion, cropped = camera, None, False
        depth = None if depths is None else depths[number]
        image, K, depth = prepare_image(image, K, distortion, depth, cropped)
        T = np.asarray(T_world_cam[number], np.float64)
        if not is_rigid(T):
            problem = f"T_world_cam of {names[number]}: {T.tolist()!s:.200}"
            raise UserError(problem, "a rigid 4×4 transform", "pass the camera's pose in the world")
        views.append(PosedImage(image, K, invert_transform(T), error, depth))
    geometries = {part.name: PartGeometry.of(part) for part in estimator.solid_parts}
    slope = estimator.recovery.refined_verification
    return JointEstimator(refiner, views, names, geometries, slope)


def search(
    estimator: PoseEstimator,
    joint: JointEstimator,
    distances: Distances | None = None,
    regions: Sequence[Region | None] | None = None,
) -> ViewsResult:
    """Search for parts in each view alone, and estimate the poses of the parts from all views.

    Args:
        estimator: Estimator that refines by region.
        joint: Estimator of joint poses on the views.
        distances: See :meth:`PoseEstimator.predict`.
        regions: Region to search in each view, None to search nothing (default: whole images).
    """
    before = dict(estimator.spent_ms)
    observations, maps = _observations(estimator, joint.views, distances, regions)
    least = estimator.min_score
    with estimator.timed("refine"):
        in_maps = JointSearch(estimator, joint.views, maps)
        parts = [
            part.detection
            for part in joint.parts(associate(observations, joint.geometries), in_maps)
        ]
    strong = [[item for item in view if item.detection.score >= least] for view in observations]
    passed, findings = contradictions([p for p in parts if p.score >= least], strong, joint)
    weaker = [part for part in parts if part not in passed]
    return views_result(estimator, joint, passed, findings, weaker, before)


def views_result(
    estimator: PoseEstimator,
    joint: JointEstimator,
    parts: Sequence[WorldDetection],
    findings: Sequence[str],
    weaker: Sequence[WorldDetection],
    before: Mapping[str, float],
    identities: Sequence[int] | None = None,
    velocities: Sequence[Step] | None = None,
) -> ViewsResult:
    """Return the result of a set of images, with each part drawn in the views that show it.

    Args:
        estimator: Estimator of the parts.
        joint: Estimator of joint poses on the images.
        parts: Reported parts.
        findings: Contradictions between the views.
        weaker: Parts that are not reported.
        before: ``estimator.spent_ms`` before the images; every view gets an equal share of the time
            since then.
        identities: Number of each tracked part (default: not tracked).
        velocities: Motion of each tracked part per set of images, world axes.
    """
    assert estimator.refiner is not None
    shapes = {
        part.name: Shape(part.diameter, estimator.refiner.mesh(part.name))
        for part in estimator.solid_parts
    }
    elapsed = elapsed_by_step(before, estimator.spent_ms)
    speed = {step: ms / len(joint.views) for step, ms in elapsed.items()}
    results = []
    for number, (view, name) in enumerate(zip(joint.views, joint.names, strict=True)):
        shown = [n for n, part in enumerate(parts) if part.evidence[number].status == "supports"]
        detections = [parts[n].evidence[number].detection for n in shown]
        numbers = None if identities is None else [identities[n] for n in shown]
        given = view.image, view.K, detections, speed, name, number, None, numbers, shapes
        results.append(PoseResult(*given))
    return ViewsResult(parts, findings, results, weaker, identities, velocities)


def _observations(
    estimator: PoseEstimator,
    views: Sequence[PosedImage],
    distances: Distances | None,
    regions: Sequence[Region | None] | None,
) -> tuple[list[list[PartObservation]], list[list[SeenMaps]]]:
    """Detect parts in each view alone, and return each view's maps; see :func:`search`."""
    observations: list[list[PartObservation]] = []
    maps: list[list[SeenMaps]] = []
    for number, view in enumerate(views):
        region = None if regions is None else regions[number]
        starts: list[Detection] = []
        seen: list[SeenMaps] = []
        if regions is None or region is not None:
            starts, seen = estimator.start_detections(view.image, view.K, distances, region)
        candidates = estimator.candidates_from(starts, view.image, view.K, view.depth)
        observations.append([make_observation(number, candidate, view) for candidate in candidates])
        maps.append(seen)
    return observations, maps
