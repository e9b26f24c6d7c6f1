"""What an object covers in the image: its mask, or what can be said without one."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float

from dopepp.data.sample import Instance


def silhouette(instance: Instance, shape: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
    """Return the instance's mask or, where it has none, its projected cuboid's convex hull.

    The hull contains the object's true outline, so a background crop that avoids it is free of the
    object; an instance with a corner behind the camera has no hull and gives an empty map.
    """
    if instance.mask is not None:
        return instance.mask
    canvas = np.zeros(shape, np.uint8)
    if np.isfinite(instance.keypoints).all():
        # OpenCV clips to 16-bit coordinates; no useful image reaches that far.
        corners = np.clip(np.rint(instance.keypoints[:8]), -30_000, 30_000).astype(np.int32)
        cv2.fillConvexPoly(canvas, cv2.convexHull(corners), 1)
    return canvas.astype(bool)


def hull_areas(
    points_px: Float[np.ndarray, "points 2"], shape: tuple[int, ...]
) -> tuple[float, float]:
    """Return the area of the points' convex hull inside an image (height, width), and all of it.

    Points behind the camera (NaN) do not count. Areas in square pixels.
    """
    points = points_px[np.isfinite(points_px).all(axis=1)].astype(np.float32)
    if len(points) < 3:
        return 0.0, 0.0
    hull = cv2.convexHull(points)
    height, width = shape[:2]
    # Pixel 0 is a pixel's centre, so the image spans −½ … size − ½.
    corners = [[0, 0], [width, 0], [width, height], [0, height]]
    inside, _ = cv2.intersectConvexConvex(hull, np.array(corners, np.float32) - 0.5)
    return float(inside), float(cv2.contourArea(hull))
