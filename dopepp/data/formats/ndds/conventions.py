"""Determine the pose convention of an NDDS data set by reprojection.

``quaternion_xyzw`` holds x, y, z, w or w, x, y, z; lengths are centimetres (NDDS, FAT), metres
(nvisii) or millimetres; camera axes are OpenCV's or, in old nvisii files, OpenGL's. Poses refer to
the mesh frame or to a frame into which ``fixed_model_transform`` maps the mesh (FAT). No field
states this, but every object has ``projected_cuboid``, its box in the image, on which the right
:class:`PoseConvention` projects the mesh's box.

To add a convention, add its value to a ``Literal`` below, and its meaning to
:meth:`Observation.T_cam_obj`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal, get_args

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from dopepp.core.errors import UserError
from dopepp.data.formats.ndds import NddsObject
from dopepp.geometry.camera import CameraMatrix, Transform, make_transform, project, transform
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.geometry.rotation import RotationMatrix, quaternion_to_matrix
from dopepp.parts.part import Part

Quaternion = Literal["xyzw", "wxyz"]
Unit = Literal["cm", "m", "mm"]
CameraAxes = Literal["opencv", "opengl"]
Frame = Literal["mesh", "mesh, front x", "centred", "fixed", "fixed, centred"]
"""The object frame of the stated pose.

- ``mesh``: the mesh frame.
- ``mesh, front x``: the mesh frame; corners in the order seen along its x axis, z up (nvisii).
- ``centred``: the mesh with its box's centre at the origin, which the pose moves to
  ``cuboid_centroid``, or else to ``location``.
- ``fixed``: the mesh after ``fixed_model_transform``.
- ``fixed, centred``: the mesh after the rotation of ``fixed_model_transform``, then centred.
"""

METRES: Final[dict[Unit, float]] = {"cm": 0.01, "m": 1.0, "mm": 0.001}

_FRONT_X: Final = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Rotation of a mesh with x forward, y left, z up into NDDS axes (x right, y down, z forward)."""

OPENGL: Final = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class PoseConvention:
    """Units, axes and frame in which a file states its poses (default: as NDDS documents)."""

    quaternion: Quaternion = "xyzw"
    unit: Unit = "cm"
    camera: CameraAxes = "opencv"
    frame: Frame = "mesh"

    def __str__(self) -> str:
        return (
            f"quaternion {','.join(self.quaternion)}, lengths in {self.unit}, "
            f"{self.camera} camera axes, frame: {self.frame}"
        )


POSE_CONVENTIONS: Final = tuple(
    PoseConvention(quaternion, unit, camera, frame)
    for frame in get_args(Frame)
    for camera in get_args(CameraAxes)
    for unit in METRES
    for quaternion in get_args(Quaternion)
)
"""All combinations, defaults first; the first of equally good fits is chosen."""


@dataclass(frozen=True)
class Observation:
    """An annotated object of a known part; its reprojection error serves to test conventions.

    ``fixed`` is the ``fixed_model_transform`` of its class, mesh to object frame; None if missing.
    """

    item: NddsObject
    part: Part
    K: CameraMatrix
    fixed: Transform | None

    def T_cam_obj(self, convention: PoseConvention) -> Transform | None:  # noqa: N802
        """Return the mesh's pose in metres; None if the convention needs a missing ``fixed``."""
        order = 1 if convention.quaternion == "xyzw" else 0
        rotation = quaternion_to_matrix(np.roll(self.item.quaternion, order))
        scale = METRES[convention.unit]
        location = self.item.location * scale
        if convention.frame.startswith("fixed"):
            if self.fixed is None:
                return None
            location = location + rotation @ (self.fixed[:3, 3] * scale)
            rotation = rotation @ self.fixed[:3, :3]
        if convention.frame.endswith("centred"):
            centroid = self.item.location if self.item.centroid is None else self.item.centroid
            location = centroid * scale - rotation @ self._corners[convention.frame].mean(axis=0)
        axes = OPENGL if convention.camera == "opengl" else np.eye(3)
        return make_transform(axes @ rotation, axes @ location)

    def predicted_px(self, convention: PoseConvention) -> Float[np.ndarray, "8 2"] | None:
        """Project the part's corners, in the file's order, at this pose; NaN behind the camera."""
        T_cam_obj = self.T_cam_obj(convention)
        if T_cam_obj is None:
            return None
        return project(transform(T_cam_obj, self._corners[convention.frame]), self.K)

    def error_px(self, convention: PoseConvention) -> float:
        """Return the corners' median distance from ``projected_cuboid``; inf behind the camera."""
        predicted = self.predicted_px(convention)
        if predicted is None or self.item.corners_px is None:
            return np.inf
        distances = np.linalg.norm(predicted - self.item.corners_px, axis=1)
        return float(np.median(np.nan_to_num(distances, nan=np.inf)))

    @cached_property
    def _corners(self) -> dict[Frame, NDArray[np.float64]]:
        """The part's corners in the file's order, by kind of object frame; mesh frame, metres."""
        part_corners, front = self.part.cuboid[:8], _rotated_corners(self.part, _FRONT_X)
        rotation = np.eye(3) if self.fixed is None else self.fixed[:3, :3]
        fixed = _rotated_corners(self.part, rotation)
        return dict(
            zip(get_args(Frame), (part_corners, front, part_corners, fixed, fixed), strict=True)
        )


def _rotated_corners(part: Part, rotation: RotationMatrix) -> Float[np.ndarray, "8 3"]:
    """Return the corners of the part's box along rotated axes: NDDS order, mesh frame, metres."""
    # For rotations other than by right angles, the box of the rotated cuboid is too large.
    quarter_turns = np.abs(np.abs(rotation).max(axis=0) - 1).max() < 1e-6
    shape = part.points if part.mesh is None else part.mesh.vertices
    rotated = (part.cuboid[:8] if quarter_turns else shape) @ rotation.T
    return np.asarray(cuboid_keypoints(rotated.min(axis=0), rotated.max(axis=0))[:8] @ rotation)


MAX_ERROR_PX: Final = 5.0
"""Allowed reprojection error of the instances that fit (``_MIN_FITTING``), even on photos."""

_MAX_SHARE: Final = 0.05  # reprojection error as a share of the cuboid's longer side
_MIN_FITTING: Final = 0.75  # share of the instances that must fit; the others may be damaged
_MIN_RATIO: Final = 3.0  # factor by which the error of conventions with other poses is larger


_ROUNDING_PX: Final = 0.05  # error difference of equally good fits, due to rounding in files
_SAME_POSE: Final = 0.05  # largest corner distance between equal poses, diameters


@dataclass(frozen=True)
class NddsFinding:
    """The pose convention of a data set, with the reprojection errors that determine it.

    Attributes:
        error_px: Upper quartile of the instances' errors (:meth:`Observation.error_px`).
        rival_px: This quartile under the best convention with different poses.
    """

    convention: PoseConvention
    error_px: float
    rival_px: float
    num_instances: int

    def __str__(self) -> str:
        return (
            f"{self.convention} (reprojection error {self.error_px:.2g} px, next best convention "
            f"{self.rival_px:.3g} px, {self.num_instances} instances)"
        )


def find_convention(observations: Sequence[Observation], where: str) -> NddsFinding:
    """Find the only convention under which the parts' cuboids project to ``projected_cuboid``.

    One observation is enough in most cases. Messages name the data set ``where``.

    Raises:
        UserError: No convention fits three quarters of the instances within 5 px, or two
            conventions with different poses fit almost equally well.
    """
    errors = {
        convention: _quantile([observation.error_px(convention) for observation in observations])
        for convention in POSE_CONVENTIONS
    }
    ranked = sorted(errors, key=lambda convention: errors[convention])
    least, reason, listed = errors[ranked[0]], "no known convention fits", ranked[:2]
    if least <= MAX_ERROR_PX:
        best = next(c for c in POSE_CONVENTIONS if errors[c] <= least + _ROUNDING_PX)
        rivals = [c for c in ranked if c != best and not _same_poses(observations, best, c)]
        rival_px = min((errors[rival] for rival in rivals), default=np.inf)
        if rival_px >= _MIN_RATIO * errors[best] + _ROUNDING_PX:
            return NddsFinding(best, errors[best], rival_px, len(observations))
        reason, listed = "two conventions fit equally well", [best, *rivals[:1]]
    figures = "; ".join(f"{errors[convention]:.3g} px: {convention}" for convention in listed)
    raise UserError(
        f"{where}: {reason}; reprojection error: {figures}",
        f"one convention with at most {MAX_ERROR_PX:g} px and a third of any other error",
        "pass the data set's own meshes in the right unit, and check its K",
    )


def check_observation(observation: Observation, convention: PoseConvention) -> Transform:
    """Return an instance's pose (metres), checked by reprojection to its ``projected_cuboid``.

    Raises:
        UserError: The instance is behind the camera, lacks a ``fixed_model_transform``, or is off
            by more than 5 px and 5 % of the cuboid's longer side.
    """
    item = observation.item
    T_cam_obj, node = observation.T_cam_obj(convention), item.node
    if T_cam_obj is None:
        problem = f"no fixed_model_transform of {item.label} in the object settings"
        node["class"].report(problem, f"a matrix of this class, because poses are {convention}")
    assert T_cam_obj is not None
    if T_cam_obj[2, 3] <= 0:
        problem = f"an object behind the camera (z = {T_cam_obj[2, 3]:.3g} m)"
        node["location"].report(problem, f"an object in front of the camera ({convention})")
    predicted = observation.predicted_px(convention)
    # Projections of hidden objects, and of objects partly behind the camera, are meaningless.
    if predicted is None or not np.isfinite(predicted).all() or item.visibility == 0:
        return T_cam_obj
    error, extent = observation.error_px(convention), float(np.ptp(predicted, axis=0).max())
    if item.corners_px is not None and error > max(MAX_ERROR_PX, _MAX_SHARE * extent):
        problem = f"{error:.3g} px from the projection of the cuboid of {observation.part.name}"
        node["projected_cuboid"].report(problem, f"the data set's {convention}")
    return T_cam_obj


def _same_poses(observations: Sequence[Observation], a: PoseConvention, b: PoseConvention) -> bool:
    distances = []
    for observation in observations:
        T_a, T_b, part = observation.T_cam_obj(a), observation.T_cam_obj(b), observation.part
        if T_a is None or T_b is None:
            return False
        separation = np.abs(transform(T_a, part.cuboid) - transform(T_b, part.cuboid)).max()
        distances.append(float(separation) / part.diameter)
    return _quantile(distances) <= _SAME_POSE


def _quantile(values: Sequence[float]) -> float:
    """Return the upper quartile of the values, which is robust to damaged items."""
    return float(np.quantile(values, _MIN_FITTING, method="higher"))
