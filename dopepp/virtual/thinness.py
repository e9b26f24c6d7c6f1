"""Width of a part's thin features, as a camera sees them."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from dopepp.drawing.pictures import Mask
from dopepp.geometry.camera import camera_matrix, make_transform
from dopepp.geometry.rotation import random_rotation
from dopepp.parts.part import Part
from dopepp.virtual.body import make_body
from dopepp.virtual.renderers.raster import silhouette
from dopepp.virtual.scene import SceneObject

_NUM_VIEWS: Final = 24
_SHARE: Final = 0.15  # share of the silhouette that features of this width make up
_SIDE: Final = 161  # side length of the images, pixels
_ACROSS: Final = 128.0  # diameter of the part in the images, pixels
_DISTANCE: Final = 5.0  # distance of the camera, diameters


def thin_width(part: Part) -> float:
    """Return the width of a part's thin features, in diameters.

    A silhouette's share that no disc of this diameter inside the silhouette covers is 15 %. The
    value is the median of 24 random orientations; it is low for rods, wires and sheets.

    Raises:
        UserError: The part has no mesh.
    """
    surface = make_body(part, is_target=False).surface
    middle = (surface.hull.min(axis=0) + surface.hull.max(axis=0)) / 2
    focal = _ACROSS * _DISTANCE
    K = camera_matrix(focal, focal, (_SIDE - 1) / 2, (_SIDE - 1) / 2)
    rng = np.random.default_rng(0)
    widths = []
    for _ in range(_NUM_VIEWS):
        rotation = random_rotation(rng)
        position = np.array([0.0, 0.0, _DISTANCE * surface.diameter]) - rotation @ middle
        item = SceneObject(surface, make_transform(rotation, position))
        widths.append(_thin_width_px(silhouette(item, K, (_SIDE, _SIDE)).mask))
    return float(np.median(widths)) / _ACROSS


def _thin_width_px(mask: Mask) -> float:
    """Return the diameter of the discs that leave 15 % of a silhouette uncovered, pixels."""
    depths = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    low, high = 0.0, float(depths.max())
    while high - low > 0.25:
        radius = (low + high) / 2
        outside = (depths < radius).astype(np.uint8)  # too near the outline for a disc's centre
        reach = cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        uncovered = mask & (reach > radius)
        low, high = (low, radius) if uncovered.sum() > _SHARE * mask.sum() else (radius, high)
    return 2 * high
