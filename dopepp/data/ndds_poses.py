"""A pose as an NDDS file writes it, under any of the conventions that occur in the wild."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final, Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from dopepp.data.ndds_fields import NddsObject
from dopepp.geometry.camera import make_transform, project, transform
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.geometry.rotation import quaternion_to_matrix
from dopepp.parts.part import Part

Quaternion = Literal["xyzw", "wxyz"]
Unit = Literal["cm", "m", "mm"]
CameraAxes = Literal["opencv", "opengl"]
Frame = Literal["mesh", "mesh, front x", "centred", "fixed", "fixed, centred"]

METRES: Final[dict[Unit, float]] = {"cm": 0.01, "m": 1.0, "mm": 0.001}
QUATERNIONS: Final[tuple[Quaternion, ...]] = ("xyzw", "wxyz")
CAMERAS: Final[tuple[CameraAxes, ...]] = ("opencv", "opengl")
FRAMES: Final[tuple[Frame, ...]] = ("mesh", "mesh, front x", "centred", "fixed", "fixed, centred")
"""Whose pose it is: ``mesh``: the mesh's. ``mesh, front x``: the mesh's, but corners are listed as
seen along its x axis with z up (nvisii). ``centred``: of the mesh moved so that its box's centre is
at ``cuboid_centroid``, or at ``location`` without one. ``fixed``: of the mesh transformed by
``fixed_model_transform``. ``fixed, centred``: of the mesh rotated by it, then centred."""

_FRONT_X: Final = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Rotation of a mesh with x forward, y left, z up into NDDS axes (x right, y down, z forward)."""

_OPENGL: Final = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Convention:
    """One way to write poses; the defaults are NDDS's own."""

    quaternion: Quaternion = "xyzw"
    unit: Unit = "cm"
    camera: CameraAxes = "opencv"
    frame: Frame = "mesh"

    def __str__(self) -> str:
        """Say it in one phrase."""
        return (
            f"quaternion {','.join(self.quaternion)}, lengths in {self.unit}, "
            f"{self.camera} camera axes, frame: {self.frame}"
        )


CONVENTIONS: Final = tuple(
    Convention(quaternion, unit, camera, frame)
    for frame in FRAMES
    for camera in CAMERAS
    for unit in METRES
    for quaternion in QUATERNIONS
)
"""All hypotheses, the documented ones first: of two that fit alike, the first one counts."""


@dataclass(frozen=True)
class Observation:
    """An object of the data set whose part is known.

    Attributes:
        item: What the annotation says.
        part: The part.
        K: The image's camera matrix, pixels.
        fixed: The class's ``fixed_model_transform``, rigid, translation in the file's unit; None
            where there is none.
        path: The annotation, for errors.
    """

    item: NddsObject
    part: Part
    K: Float[np.ndarray, "3 3"]
    fixed: Float[np.ndarray, "4 4"] | None
    path: Path

    def T_cam_obj(self, convention: Convention) -> Float[np.ndarray, "4 4"] | None:  # noqa: N802
        """Return the pose of the part's mesh, metres, or None where the convention cannot apply."""
        fixed = convention.frame.startswith("fixed")
        if fixed and self.fixed is None:
            return None
        order = 1 if convention.quaternion == "xyzw" else 0
        rotation = quaternion_to_matrix(np.roll(self.item.quaternion, order))
        scale = METRES[convention.unit]
        location = self.item.location * scale
        if self.fixed is not None and fixed:
            rotation_file, offset = rotation, self.fixed[:3, 3] * scale
            rotation = rotation_file @ self.fixed[:3, :3]
            location = location + rotation_file @ offset
        if convention.frame.endswith("centred"):
            centroid = self.item.location if self.item.centroid is None else self.item.centroid
            location = centroid * scale - rotation @ self._corners(convention).mean(axis=0)
        axes = _OPENGL if convention.camera == "opengl" else np.eye(3)
        return make_transform(axes @ rotation, axes @ location)

    def predicted_px(self, convention: Convention) -> Float[np.ndarray, "8 2"] | None:
        """Return where the convention puts the file's corners, NaN behind the camera."""
        T_cam_obj = self.T_cam_obj(convention)
        if T_cam_obj is None:
            return None
        return project(transform(T_cam_obj, self._corners(convention)), self.K)

    def error_px(self, convention: Convention) -> float:
        """Return the median distance from ``projected_cuboid``, infinite behind the camera."""
        predicted = self.predicted_px(convention)
        if predicted is None or self.item.corners_px is None:
            return np.inf
        distances = np.linalg.norm(predicted - self.item.corners_px, axis=1)
        return float(np.median(np.nan_to_num(distances, nan=np.inf)))

    def _corners(self, convention: Convention) -> NDArray[np.float64]:
        """Return the corners the file lists, in its order, in the mesh frame, metres."""
        if convention.frame == "mesh, front x":
            return self._front_corners
        return self._fixed_corners if convention.frame.startswith("fixed") else self.part.cuboid[:8]

    @cached_property
    def _front_corners(self) -> NDArray[np.float64]:
        return _turned_corners(self.part, _FRONT_X)

    @cached_property
    def _fixed_corners(self) -> NDArray[np.float64]:
        rotation = np.eye(3) if self.fixed is None else self.fixed[:3, :3]
        return _turned_corners(self.part, rotation)


def _turned_corners(part: Part, rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "8 3"]:
    """Return the corners of the box along turned axes, in NDDS order, in the part's frame.

    A turn by other than right angles needs the shape itself; the cuboid's box would be too large.
    """
    quarter_turns = np.abs(np.abs(rotation).max(axis=0) - 1).max() < 1e-6
    shape = part.points if part.mesh is None else part.mesh.vertices
    turned = (part.cuboid[:8] if quarter_turns else shape) @ rotation.T
    return np.asarray(cuboid_keypoints(turned.min(axis=0), turned.max(axis=0))[:8] @ rotation)
