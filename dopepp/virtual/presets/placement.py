"""Distributions of the targets' orientations (turnings) and positions (placements).

To add a distribution, write a frozen dataclass with a ``draw`` method and a ``kind``, and name it
in :data:`Turning` or :data:`Placement`; a preset's file selects it by its ``kind``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Final, Literal

import numpy as np
from numpy.random import Generator
from pydantic import Discriminator

from dopepp.core.errors import UserError
from dopepp.core.validation import Checked, Pair, Range, Span
from dopepp.drawing.pictures import Size
from dopepp.geometry.camera import CameraMatrix, project
from dopepp.geometry.rotation import (
    RotationMatrix,
    Vector,
    random_rotation,
    rotation_vector_to_matrix,
)
from dopepp.parts.mesh import Points

Angle = Annotated[float, Range(0.0, 180.0, "degrees")]
Metres = Annotated[float, Range(0.0, 1000.0, "metres")]
Depth = Annotated[float, Range(1e-6, 1000.0, "metres")]
ImageShare = Annotated[float, Range(1e-3, 1.0, "share of the image")]

FACING: Final = np.diag([1.0, -1.0, -1.0])
"""Rotation that turns an object's +z face towards the camera, +x staying on the right."""


@dataclass(frozen=True)
class FreeTurning(Checked):
    """Any orientation in the camera frame, uniform over SO(3)."""

    kind: Literal["free"] = "free"

    def draw(self, rng: Generator) -> RotationMatrix:
        """Sample a rotation from the object to the camera frame."""
        return random_rotation(rng)


@dataclass(frozen=True)
class FacingTurning(Checked):
    """The part's +z face points at the camera, slightly tilted and turned in the image plane.

    ``R = R_z(in-plane) · R_(axis in the image plane)(tilt) · diag(1, −1, −1)``. The tilted axis is
    uniform over the spherical cap, the in-plane angle over its range.

    Attributes:
        in_plane_deg: Largest rotation about the optical axis to either side.
        tilt_deg: Largest angle between the part's +z axis and the reversed optical axis.
    """

    in_plane_deg: Angle = 45.0
    tilt_deg: Angle = 40.0
    kind: Literal["facing"] = "facing"

    def draw(self, rng: Generator) -> RotationMatrix:
        """Sample a rotation from the object to the camera frame."""
        in_plane = np.radians(rng.uniform(-self.in_plane_deg, self.in_plane_deg))
        tilt = np.arccos(rng.uniform(np.cos(np.radians(self.tilt_deg)), 1.0))
        azimuth = rng.uniform(0.0, 2 * np.pi)
        axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        turned = rotation_vector_to_matrix(np.array([0.0, 0.0, in_plane]))
        return np.asarray(turned @ rotation_vector_to_matrix(tilt * axis) @ FACING)


@dataclass(frozen=True)
class UprightTurning(Checked):
    """The part stands upright at any azimuth, and the camera looks down at it.

    ``R = R_z(roll) · R_(camera above the plane) · R_z(azimuth) · R_(up to z)``; elevation, roll and
    azimuth are uniform.

    Attributes:
        up: Axis of the part that points upwards.
        elevation_deg: Angle between the line of sight and the horizontal.
        roll_deg: Largest rotation of the camera about its line of sight to either side.
    """

    up: Literal["x", "y", "z"] = "z"
    elevation_deg: Annotated[Pair, Span(-90.0, 90.0, "degrees")] = (20.0, 85.0)
    roll_deg: Angle = 45.0
    kind: Literal["upright"] = "upright"

    def draw(self, rng: Generator) -> RotationMatrix:
        """Sample a rotation from the object to the camera frame."""
        elevation = np.radians(rng.uniform(*self.elevation_deg))
        roll = np.radians(rng.uniform(-self.roll_deg, self.roll_deg))
        azimuth = rng.uniform(0.0, 2 * np.pi)
        rolled, turned = (
            rotation_vector_to_matrix(np.array([0.0, 0.0, angle])) for angle in (roll, azimuth)
        )
        # A cyclic permutation of the axes turns the up axis into z.
        standing = np.roll(np.eye(3), 2 - "xyz".index(self.up), axis=0)
        return np.asarray(rolled @ looking_down(elevation) @ turned @ standing)


Turning = Annotated[FreeTurning | FacingTurning | UprightTurning, Discriminator("kind")]
"""Distribution of a target's orientation."""


def looking_down(elevation: float) -> RotationMatrix:
    """Return the rotation from a z-up frame to a camera that looks along +y and downwards.

    The elevation is the angle of the line of sight below the horizontal, radians.
    """
    sine, cosine = np.sin(elevation), np.cos(elevation)
    return np.array([[1, 0, 0], [0, -sine, -cosine], [0, cosine, -sine]])


class _Placement(Checked):
    """Base of the placements.

    A placement samples where the centre of an object's bounding box is in the camera frame. The
    origin of a CAD file may be far from its part.
    """

    _ends: ClassVar[tuple[str, str] | None] = None  # names of the smallest and largest value

    def __post_init__(self) -> None:
        super().__post_init__()
        if self._ends is None:
            return
        low, high = (getattr(self, end) for end in self._ends)
        if low > high:
            first, last = self._ends
            problem = f"{first}={low} and {last}={high} of {type(self).__name__}"
            raise UserError(problem, f"{first} <= {last}", f"lower {first}, or raise {last}")

    def redraw(self, rng: Generator, position: Vector) -> Vector | None:
        """Return another position (camera frame, metres) after ``position`` was rejected, or None.

        A coordinate that is the same in both positions keeps its distribution for any number of
        rejections. After None, the caller samples a new orientation too.
        """
        return None


@dataclass(frozen=True)
class OffsetPlacement(_Placement):
    """A box of positions around a point on the optical axis (the paper's scene, section 2.1).

    An object outside the image is moved along the optical axis. Lateral offsets and
    orientations therefore keep their uniform distributions.

    Attributes:
        distance: Depth of the box's middle, metres.
        axial: Largest offset along the optical axis to either side, metres.
        lateral: Largest offset along image x and along image y to either side, metres.

    Raises:
        UserError: ``axial`` is not below ``distance``.
    """

    distance: Metres = 0.20
    axial: Metres = 0.10
    lateral: Metres = 0.15
    kind: Literal["offset"] = "offset"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.axial < self.distance:
            raise UserError(
                f"distance={self.distance} and axial={self.axial} of OffsetPlacement",
                "axial < distance, in metres",
                "raise distance, or lower axial, so that all positions are in front of the camera",
            )

    def draw(self, rng: Generator, K: CameraMatrix, size: Size, rotated_hull: Points) -> Vector:
        """Sample the centre of the object's box in the camera frame, metres."""
        x, y = rng.uniform(-self.lateral, self.lateral, 2)
        return np.array([x, y, self._draw_depth(rng)])

    def redraw(self, rng: Generator, position: Vector) -> Vector:
        """Return ``position`` with another depth, metres."""
        return np.array([position[0], position[1], self._draw_depth(rng)])

    def _draw_depth(self, rng: Generator) -> float:
        """Sample a depth within ``axial`` of ``distance``, metres."""
        return self.distance + rng.uniform(-self.axial, self.axial)


@dataclass(frozen=True)
class DistancePlacement(_Placement):
    """Uniform in the depth of the object's centre and, laterally, over the image.

    Attributes:
        nearest: Smallest depth, metres.
        farthest: Largest depth, metres.
        margin: Smallest distance of the centre from the border, in image widths and heights.
    """

    _ends = ("nearest", "farthest")

    nearest: Depth = 0.5
    farthest: Depth = 1.2
    margin: Annotated[float, Range(0.0, 0.49, "share")] = 0.1
    kind: Literal["distance"] = "distance"

    def draw(self, rng: Generator, K: CameraMatrix, size: Size, rotated_hull: Points) -> Vector:
        """Sample the centre of the object's box in the camera frame, metres."""
        depth = rng.uniform(self.nearest, self.farthest)
        pixel = rng.uniform(self.margin, 1 - self.margin, 2) * size - 0.5
        return np.asarray(depth * np.linalg.solve(K, [*pixel, 1.0]))


@dataclass(frozen=True)
class FillPlacement(_Placement):
    """The part fills a random share of the image and lies inside it.

    The share is the larger of bounding-box width over image width and bounding-box height over
    image height. The distance is found by iteration.

    Attributes:
        smallest: Smallest share of the image's width or height.
        largest: Largest share of the image's width or height.
    """

    _ends = ("smallest", "largest")

    smallest: ImageShare = 0.60
    largest: ImageShare = 0.95
    kind: Literal["fill"] = "fill"

    def draw(self, rng: Generator, K: CameraMatrix, size: Size, rotated_hull: Points) -> Vector:
        """Sample the centre of the object's box in the camera frame, metres.

        ``rotated_hull`` has the vertices of the convex hull relative to this centre, camera axes.
        """
        share = rng.uniform(self.smallest, self.largest)
        offset = rng.uniform(-0.5, 0.5, 2)
        centre = (rotated_hull.min(axis=0) + rotated_hull.max(axis=0)) / 2
        pixel, hull = np.array(size) / 2 - 0.5, rotated_hull - centre
        # The image of a tilted part's box is not centred on the image of its centre, so iterate.
        for _ in range(10):
            ray = np.linalg.solve(K, [*pixel, 1.0])
            depth = _depth_that_fills(share, ray, K, size, hull)
            image = project(hull + depth * ray, K)
            lower, upper = image.min(axis=0), image.max(axis=0)
            # The bounding box stays inside the image; a box that fills the image cannot move.
            target_centre = np.array(size) / 2 - 0.5 + offset * (size - (upper - lower))
            correction = target_centre - (lower + upper) / 2
            if np.abs(correction).max() < 0.05:
                break
            pixel = pixel + correction
        return np.asarray(depth * ray - centre)


@dataclass(frozen=True)
class WorkingPlacement(_Placement):
    """Uniform in depth and over the lateral positions at which the whole part is visible.

    A position is the centre of the rotated part's bounding box. Parts larger than the image are
    centred.

    Attributes:
        nearest: Smallest depth, metres.
        farthest: Largest depth, metres.
    """

    _ends = ("nearest", "farthest")

    nearest: Depth
    farthest: Depth
    kind: Literal["working"] = "working"

    def draw(self, rng: Generator, K: CameraMatrix, size: Size, rotated_hull: Points) -> Vector:
        """Sample the centre of the object's box in the camera frame, metres."""
        depth, offset = rng.uniform(self.nearest, self.farthest), rng.uniform(-0.5, 0.5, 2)
        lower, upper = rotated_hull.min(axis=0), rotated_hull.max(axis=0)
        # The front of the part appears larger than its middle.
        front = depth - (upper[2] - lower[2]) / 2
        extent = (upper - lower)[:2] * K[[0, 1], [0, 1]] / max(front, 1e-6)
        room = np.maximum(size - extent, 0.0)
        pixel = np.array(size) / 2 - 0.5 + offset * room
        hull = rotated_hull - (lower + upper) / 2
        # Perspective moves near points outwards: shift the part back into the image.
        for _ in range(10):
            middle = depth * np.linalg.solve(K, [*pixel, 1.0])
            image = project(hull + middle, K)
            overhang = np.maximum(image.max(axis=0) - (np.array(size) - 0.5), 0.0)
            before = np.maximum(-0.5 - image.min(axis=0), 0.0)
            missing = np.where(room > 0, before - overhang, 0.0)
            if not missing.any():
                break
            pixel = pixel + missing
        return np.asarray(middle - (lower + upper) / 2)


Placement = Annotated[
    OffsetPlacement | DistancePlacement | FillPlacement | WorkingPlacement, Discriminator("kind")
]
"""Distribution of a target's position."""


def _depth_that_fills(
    share: float, ray: Vector, K: CameraMatrix, size: Size, centred_hull: Points
) -> float:
    """Return the depth on ``ray``, metres, at which the hull's box fills a share of the image."""
    closest = float(-centred_hull[:, 2].min()) * (1 + 1e-6)
    rays, rows, columns = centred_hull @ K[:2].T, ray @ K[:2].T, np.array(size, np.float64)
    low, high = closest, np.inf
    depth = 2 * closest + float(np.abs(centred_hull).max())
    for step in range(80):
        pixels = (rays + depth * rows) / (centred_hull[:, 2:] + depth)
        filled = float(((pixels.max(axis=0) - pixels.min(axis=0)) / columns).max())
        if abs(filled / share - 1) < 1e-4:  # far below a pixel
            break
        low, high = (depth, high) if filled > share else (low, depth)
        # The share is nearly proportional to 1/depth. Steps by this rule alternate with bisection,
        # because they converge from one side only near the camera.
        depth *= filled / share
        if step % 2 or not low < depth < high:
            depth = (low + high) / 2 if np.isfinite(high) else 2 * low
    return depth
