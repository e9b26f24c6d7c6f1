"""Poses of parts from several pictures of a static scene with known camera poses.

1. Each view is searched alone.
2. Detections of several views that agree in the world are joined to a part
   (:mod:`~dopepp.inference.several_views.sightings`).
3. The pose of each part is refined on all views together and verified in each view
   (:mod:`~dopepp.inference.several_views.joint`).
4. Of several parts with the same pose, the most probable remains.
5. Contradictions between views are reported
   (:mod:`~dopepp.inference.several_views.contradictions`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.core.validation import Range, check
from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import CameraMatrix, Transform, invert_transform
from dopepp.geometry.camera_file import Camera
from dopepp.geometry.rotation import is_rigid
from dopepp.geometry.symmetry import symmetry_group
from dopepp.inference.picture import Depth, Distances, are_same, prepare_image
from dopepp.inference.pose_result import PoseResult, Shape, spent_between
from dopepp.inference.refinement.joint_refinement import PosedPicture
from dopepp.inference.several_views.contradictions import contradictions
from dopepp.inference.several_views.joint import CONSISTENT, JointEstimator, JointPart
from dopepp.inference.several_views.sightings import associate, separation, sight
from dopepp.inference.several_views.views_result import ViewsResult

if TYPE_CHECKING:
    from dopepp.inference.estimator import PoseEstimator

CAMERA_ERROR: Final = (2e-4, math.radians(0.02))
"""Default standard deviations of a camera's pose along and about each axis: metres and radians.
These are the errors after a hand-eye calibration."""


def predict_views(
    estimator: PoseEstimator,
    images: Sequence[Picture],
    cameras: Sequence[Camera | CameraMatrix],
    T_world_cam: Sequence[Transform],
    depths: Sequence[Depth] | None = None,
    distances: Distances | None = None,
    camera_error: tuple[float, float] = CAMERA_ERROR,
    names: Sequence[str] | None = None,
) -> ViewsResult:
    """Estimate the poses of parts; see :meth:`PoseEstimator.predict_views`."""
    refiner, count = estimator.refiner, len(images)
    if refiner is None or not refiner.verifies:
        fix = "load the estimator with refine='region'"
        problem = f"several views with refine={estimator.refine}"
        raise UserError(problem, "a refinement with region", fix)
    lengths = {"cameras": cameras, "T_world_cam": T_world_cam, "depths": depths, "names": names}
    for name, values in lengths.items():
        if values is not None and len(values) != count:
            problem = f"{len(values)} {name} for {count} images"
            raise UserError(problem, f"{count}, one for each image", f"pass {count} {name}")
    names = names or [f"view {number}" for number in range(count)]
    shift, turn = (
        check(f"camera_error[{n}]", error, float, Range(0.0, 1.0))
        for n, error in enumerate(camera_error)
    )
    error = np.diag(np.repeat([turn, shift], 3) ** 2)
    views = [
        _posed(image, cameras[n], T_world_cam[n], depths[n] if depths else None, error, names[n])
        for n, image in enumerate(images)
    ]
    clock = [dict(estimator.spent_ms)]
    sightings = []
    for number, view in enumerate(views):
        candidates = estimator.candidates(view.image, view.K, None, view.depth, distances)
        sightings.append([sight(number, candidate, view) for candidate in candidates])
        clock.append(dict(estimator.spent_ms))
    start = time.perf_counter()
    cuboids = {part.name: part.cuboid for part in estimator.solid_parts}
    groups = {
        part.name: symmetry_group(part.symmetries_discrete, part.symmetries_continuous)
        for part in estimator.solid_parts
    }
    joint = JointEstimator(refiner, views, names, estimator.recovery.refined_verification)
    associated = partial(associate, groups=groups, cuboids=cuboids)
    parts: list[JointPart] = []
    clusters = associated(sightings)
    while clusters:
        cluster = clusters.pop()
        name = cluster[0].detection.object
        parts.append(joint.estimate(cluster, groups[name], cuboids[name]))
        clusters += [[other] for other in cluster if other not in parts[-1].sightings]
    parts.sort(key=lambda part: -part.detection.score)
    kept: list[JointPart] = []
    for part in parts:
        if not any(_is_duplicate(part, other) for other in kept):
            kept.append(part)
    joint_ms = 1000 * (time.perf_counter() - start)
    passed = [part.detection for part in kept if part.detection.score >= estimator.min_score]
    strong = [
        [sighting for sighting in view if sighting.detection.score >= estimator.min_score]
        for view in sightings
    ]
    passed, findings = contradictions(passed, strong, views, names, associated)
    weaker = [part.detection for part in kept if part.detection not in passed]
    shapes = {
        part.name: Shape(part.diameter, refiner.mesh(part.name)) for part in estimator.solid_parts
    }
    results = []
    for number, view in enumerate(views):
        evidence = [detection.evidence[number] for detection in passed]
        shown = [item.detection for item in evidence if item.status == "supports"]
        speed = spent_between(clock[number], clock[number + 1])
        results.append(
            PoseResult(view.image, view.K, shown, speed, names[number], number, shapes=shapes)
        )
    return ViewsResult(passed, findings, results, weaker, joint_ms)


def _posed(
    image: Picture,
    camera: Camera | CameraMatrix,
    T_world_cam: Transform,
    depth: Depth | None,
    error: np.ndarray,
    name: str,
) -> PosedPicture:
    """Check the arguments of a view and remove the lens distortion."""
    distortion = None
    if isinstance(camera, Camera):
        camera = camera.for_picture((image.shape[1], image.shape[0]))
        distortion, camera = camera.coefficients, camera.K
    image, K, depth = prepare_image(image, camera, distortion, depth)
    T = np.asarray(T_world_cam, np.float64)
    if not is_rigid(T):
        problem = f"T_world_cam of {name}: {T.tolist()!s:.200}"
        raise UserError(problem, "a rigid 4×4 transform", "pass the camera's pose in the world")
    return PosedPicture(image, K, invert_transform(T), error, depth)


def _is_duplicate(part: JointPart, better: JointPart) -> bool:
    """Return whether two parts are the same instance, detected twice.

    Both must be at the same position in every view. If a view supports only the first part, the
    covariances must also explain the difference of the poses. Otherwise the views contradict each
    other.
    """
    detection, other = part.detection, better.detection
    shared = {item.view for item in part.sightings} & {item.view for item in better.sightings}
    pairs = zip(detection.evidence, other.evidence, strict=True)
    if shared or not all(are_same(a.detection, b.detection) for a, b in pairs):
        return False
    is_supported = set(detection.views) <= set(other.views)
    return is_supported or separation(detection.pose, other.pose) <= CONSISTENT
