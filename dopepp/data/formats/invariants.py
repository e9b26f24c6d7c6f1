"""Check poses, cameras and boxes of any layout.

Tolerances: a rotation is orthogonal to 1e-3, BOP's to 1e-2; the visible pixels of an object lie in
the reprojected box within 8 px (released poses of YCB-Video are up to 6 px off) or 5 % of the box's
longer side; a fully visible object covers at least a third of that box in width or in height; the
camera is 0.1 to 300 diameters away from an object, which no mix-up of mm and m satisfies.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from dopepp.core.errors import UserError
from dopepp.data.formats.problems import Node
from dopepp.drawing.pictures import Shape
from dopepp.geometry.camera import CameraMatrix, check_camera, project
from dopepp.geometry.rotation import RotationMatrix, Vector, is_rotation
from dopepp.parts.mesh import Points

BOX_TOLERANCE_PX: Final = 8.0
BOX_TOLERANCE_SHARE: Final = 0.05
SMALLEST_COVER: Final = 1 / 3
FULLY_VISIBLE: Final = 0.95
DIAMETERS_AWAY: Final = (0.1, 300.0)
PIXEL_ASPECT: Final = (0.5, 2.0)


class Box(NamedTuple):
    """Axis-aligned box in an image, pixels; pixels whose centres lie on its sides are inside."""

    left: float
    top: float
    right: float
    bottom: float

    @classmethod
    def of_points(cls, points_px: Float[np.ndarray, "points 2"]) -> Box | None:
        """Return the smallest box around points, or None if a coordinate is not finite."""
        if not len(points_px) or not np.isfinite(points_px).all():
            return None
        (left, top), (right, bottom) = points_px.min(axis=0), points_px.max(axis=0)
        return cls(float(left), float(top), float(right), float(bottom))

    @classmethod
    def of_mask(cls, mask: NDArray[Any]) -> Box | None:
        """Return the smallest box around a mask's pixels, or None for an empty mask."""
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        if not len(rows):
            return None
        return cls(float(columns[0]), float(rows[0]), float(columns[-1]), float(rows[-1]))

    def excess_px(self, other: Box) -> float:
        """Return by how many pixels another box exceeds this box on any side; negative inside."""
        left, top = self.left - other.left, self.top - other.top
        return max(left, top, other.right - self.right, other.bottom - self.bottom)

    def is_inside(self, shape: Shape) -> bool:
        """Return whether an image of (height, width) contains the box."""
        height, width = shape
        return min(self.left, self.top) >= 0 and self.right < width and self.bottom < height

    def __str__(self) -> str:
        return f"({self.left:.0f}, {self.top:.0f})–({self.right:.0f}, {self.bottom:.0f})"


def rotation_problem(rotation: RotationMatrix, tolerance: float = 1e-3) -> str | None:
    """Return why R·Rᵀ is not the identity within ``tolerance``, or None; also None for a NaN."""
    if is_rotation(rotation, tolerance) or not np.isfinite(rotation).all():
        return None
    deviation = np.abs(rotation @ rotation.T - np.eye(3)).max()
    allowed = f"{deviation:.2g} (allowed {tolerance:.0e})"
    return f"not a rotation: R·Rᵀ off by {allowed}, determinant {np.linalg.det(rotation):.3g}"


def check_translation(node: Node, translation: Vector, diameter: float | None) -> bool:
    """Report a position behind the camera (field ``z``) or an implausible distance (``unit``).

    Returns:
        Whether the position (camera frame, in the unit of the object's diameter) is plausible;
        True for a NaN.
    """
    depth = float(translation[2])
    if depth <= 0:
        node["z"].report(f"behind the camera (z = {depth:.4g})")
        return False
    if diameter is None or not diameter > 0 or not np.isfinite(translation).all():
        return True
    distance = float(np.linalg.norm(translation)) / diameter
    least, most = DIAMETERS_AWAY
    if least <= distance <= most:
        return True
    node["unit"].report(
        f"{distance:.3g} diameters ({diameter:.4g}) from the camera; {least:g} … {most:g} allowed: "
        "is the position or the diameter in another unit (mm, m)?"
    )
    return False


def plausible_camera(
    node: Node, K: CameraMatrix | None, shape: Shape | None
) -> CameraMatrix | None:
    """Return K (pixels), or None if it is missing, not finite or reported as implausible."""
    if K is None or not np.isfinite(K).all():
        return None
    if shape is None:
        return K
    try:
        check_camera(K, shape[::-1], "the data set")
    except UserError as error:
        node.report(error.got, error.allowed)
        return None
    ratio = float(K[0, 0] / K[1, 1])
    if PIXEL_ASPECT[0] <= ratio <= PIXEL_ASPECT[1]:
        return K
    node.report(f"fx/fy = {ratio:.3g}", f"{PIXEL_ASPECT[0]} … {PIXEL_ASPECT[1]}")
    return None


def check_box(
    node: Node,
    points_cam: Points,
    K: CameraMatrix,
    visible: Box | None,
    visible_fraction: float | None = None,
    shape: Shape | None = None,
) -> None:
    """Report visible pixels outside the reprojected box, or too few for a fully visible object.

    Args:
        node: The box's field.
        points_cam: Points in the camera frame whose hull contains the object.
        K: Camera matrix in pixels.
        visible: Box of the visible pixels; None if no pixel is visible.
        visible_fraction: Visible share of the object, if known.
        shape: (height, width) of the image, if ``visible_fraction`` ignores truncation.
    """
    predicted = Box.of_points(project(points_cam, K))
    if predicted is None or visible is None:
        return
    width, height = predicted.right - predicted.left, predicted.bottom - predicted.top
    tolerance = max(BOX_TOLERANCE_PX, BOX_TOLERANCE_SHARE * max(width, height))
    excess_px = predicted.excess_px(visible)
    if excess_px > tolerance:
        distance = f"{excess_px:.0f} px outside the reprojected box {predicted}"
        node.report(f"visible at {visible}, {distance} (allowed {tolerance:.0f} px)")
        return
    is_whole = visible_fraction is not None and visible_fraction >= FULLY_VISIBLE
    if not is_whole or (shape is not None and not predicted.is_inside(shape)):
        return
    columns, rows = visible.right - visible.left + 1, visible.bottom - visible.top + 1
    cover = max(columns / (width + 1), rows / (height + 1))
    if cover < SMALLEST_COVER:
        allowed = f"(allowed: at least {SMALLEST_COVER:.0%} of its width or height)"
        share = f"{cover:.0%} of the reprojected box {predicted}"
        node.report(f"fully visible at {visible}, {share} {allowed}")
