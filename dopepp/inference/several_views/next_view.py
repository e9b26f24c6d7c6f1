"""The next best view: the camera pose from which an image reduces a pose's covariance most.

A view adds information about the pose through the part's outline. Each point of the outline has the
same standard deviation (:data:`USUAL_PX`), and the outline has the common errors of offset and
scale that refinement assumes. Self-occlusion is computed; other objects are ignored.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.geometry.camera import (
    CameraMatrix,
    Transform,
    crop_camera,
    invert_transform,
    resize_camera,
    transform,
)
from dopepp.geometry.camera_formats import Size
from dopepp.inference.refinement.joint_refinement import rotate_covariance
from dopepp.inference.refinement.outline import (
    OutlineMesh,
    filled_mask,
    find_contour,
    outline_rows,
    posed,
)
from dopepp.inference.refinement.region.shared_errors import SCALE_ERROR, region_terms
from dopepp.inference.refinement.region.shifts import Shifts
from dopepp.inference.refinement.solver import PoseMatrix
from dopepp.recovery.detection import expected_distance

USUAL_PX: Final = 0.7
"""Standard deviation of a point of the outline, pixels."""

LONGEST_PX: Final = 200  # length of the drawn part above which the image is shrunk
NUM_POINTS: Final = 100  # approximate number of points on the outline


@dataclass(frozen=True)
class NextView:
    """Choice of the next view among candidate camera poses."""

    number: int  # index of the camera pose
    before: float  # present expected error of the part's points, metres
    # Expected error after each view, metres; infinite if the view does not show the whole part
    expected: Sequence[float]
    reason: str  # expected gain, in words


def next_best_view(
    mesh: OutlineMesh,
    T_world_obj: Transform,
    covariance: PoseMatrix,
    candidates: Sequence[Transform],
    K: CameraMatrix,
    size: Size,
    T_world_bench: Transform | None = None,
    scale_error: float = SCALE_ERROR,
) -> NextView:
    """Choose the camera pose whose image is expected to reduce a pose's error most.

    Args:
        mesh: Mesh of the part, as :func:`~dopepp.inference.refinement.outline.make_outline_mesh`
            prepares it.
        T_world_obj: Pose of the part, metres.
        covariance: Covariance of the pose, world axes; see :class:`WorldDetection`.
        candidates: Reachable camera poses ``T_world_cam``, metres.
        K: Camera matrix, pixels.
        size: (width, height) of the image, pixels.
        T_world_bench: Pose of a bench, whose plane z = 0 must be below the cameras; None without a
            bench.
        scale_error: Largest relative error of the part's size or of the focal length.

    Raises:
        UserError: No candidate shows the whole part.
    """
    prior, expected = np.linalg.inv(covariance), []
    T_bench_world = None if T_world_bench is None else invert_transform(T_world_bench)
    for T_world_cam in candidates:
        expected.append(math.inf)
        if T_bench_world is not None and transform(T_bench_world, T_world_cam[:3, 3])[2] <= 0:
            continue
        T_cam_world = invert_transform(T_world_cam)
        given = rotate_covariance(T_cam_world[:3, :3], prior)
        added = _information(mesh, T_cam_world @ T_world_obj, K, size, given, scale_error)
        if added is not None:
            posterior = prior + rotate_covariance(T_world_cam[:3, :3], added)
            expected[-1] = point_error(mesh, T_world_obj, np.linalg.inv(posterior))
    if min(expected, default=math.inf) == math.inf:
        problem = f"no view of {len(candidates)} shows the whole part"
        fix = "pass more camera poses, or poses farther away that look at the part"
        raise UserError(problem, "at least one camera pose that shows the part", fix)
    best, before = int(np.argmin(expected)), point_error(mesh, T_world_obj, covariance)
    reason = f"reduces the expected error from {1e3 * before:.2g} to {1e3 * expected[best]:.2g} mm"
    return NextView(best, before, expected, reason)


def point_error(mesh: OutlineMesh, T_world_obj: Transform, covariance: PoseMatrix) -> float:
    """Return the expected error of a part's points under a pose's covariance (RMS), metres."""
    return float(expected_distance(covariance, mesh.vertices @ T_world_obj[:3, :3].T))


def _information(
    mesh: OutlineMesh,
    T_cam_obj: Transform,
    K: CameraMatrix,
    size: Size,
    prior: PoseMatrix,
    scale_error: float,
) -> PoseMatrix | None:
    """Return the information about the pose that the outline on an image adds.

    Args:
        mesh: Mesh of the part.
        T_cam_obj: Pose, metres.
        K: Camera matrix, pixels.
        size: (width, height) of the image, pixels.
        prior: Information about the pose before the image, camera axes.
        scale_error: Largest relative error of the part's size or of the focal length.

    Returns:
        The information in camera axes, or None if the image does not show the whole part.
    """
    posed_mesh = posed(mesh, T_cam_obj, K)
    if posed_mesh is None:
        return None
    low, high = posed_mesh.pixels.min(axis=0), posed_mesh.pixels.max(axis=0)
    if low.min() < 0 or (high > np.array(size) - 1).any():
        return None
    scale = min(1.0, LONGEST_PX / float((high - low).max()))
    corner = np.floor(scale * low) - 4
    K = crop_camera(resize_camera(K, scale, scale), *corner)
    width, height = (np.ceil(scale * high) - corner + 5).astype(int).tolist()
    posed_mesh = posed(mesh, T_cam_obj, K)
    assert posed_mesh is not None
    extent = scale * float((high - low).max())
    spacing = max(1.5, 3.0 * extent / NUM_POINTS)
    contour = find_contour(
        mesh, posed_mesh, filled_mask(mesh, posed_mesh, (width, height)), spacing
    )
    precision = np.full(len(contour), 1.0 / USUAL_PX**2)
    shifts = Shifts(np.zeros(len(contour)), precision)
    rows, nothing = outline_rows(contour, T_cam_obj, K), np.zeros(6)
    position = T_cam_obj[:3, 3].copy()
    equations = region_terms(rows, shifts, (prior, nothing), spacing, extent, position, scale_error)
    return equations[0]
