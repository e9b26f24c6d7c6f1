"""Objects as the camera projects them: vertices in camera and pixel coordinates, and bounds."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dopepp.core.compiled import Array
from dopepp.virtual.renderers.raster.visibility import PIXEL_SAMPLES, bounds, project_vertices
from dopepp.virtual.scene import NEAR, SceneObject

Box = tuple[int, int, int, int]
"""(left, top, right, bottom) in pixels, right and bottom excluded."""

_REACH = float(np.abs(PIXEL_SAMPLES).max())


@dataclass(frozen=True, eq=False)
class Projected:
    """An object's vertices as the camera sees them.

    Attributes:
        cam: Camera frame, metres, shape (V, 3).
        hom: Homogeneous pixels ``K x_cam``, shape (V, 3).
        extent: Smallest and largest pixel coordinates (left, top, right, bottom) of its image;
            infinite if it crosses the camera plane, left > right if it lies behind.
    """

    cam: Array
    hom: Array
    extent: tuple[float, float, float, float]

    def box(self, size: tuple[int, int]) -> Box | None:
        """Return the pixels of an image of a size that it may touch; None if there are none."""
        left, top, right, bottom = self.extent
        if left > right:
            return None
        box = (
            math.ceil(max(left - _REACH, 0.0)),
            math.ceil(max(top - _REACH, 0.0)),
            math.floor(min(right + _REACH, size[0] - 1)) + 1,
            math.floor(min(bottom + _REACH, size[1] - 1)) + 1,
        )
        return box if box[0] < box[2] and box[1] < box[3] else None

    def inside(self, size: tuple[int, int]) -> bool:
        """Tell whether its whole image lies within the pixel centres of an image of a size."""
        left, top, right, bottom = self.extent
        return 0 <= left <= right <= size[0] - 1 and 0 <= top <= bottom <= size[1] - 1


def project_object(item: SceneObject, K: Array) -> Projected:
    """Project an object's vertices."""
    cam, hom = np.empty_like(item.surface.vertices), np.empty_like(item.surface.vertices)
    project_vertices(item.surface.vertices, item.T_cam_obj, K, cam, hom)
    return Projected(cam, hom, bounds(hom, NEAR))
