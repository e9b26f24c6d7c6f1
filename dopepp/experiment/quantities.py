"""What instances can be sorted by: distance, visibility, apparent size, view angle.

To add a quantity, write a function of the instances of one object and name it in
:data:`QUANTITIES`; what the state lacks for it goes into
:class:`~dopepp.metrics.pose.PoseMetrics`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float

from dopepp.geometry.camera import project_keypoints
from dopepp.geometry.cuboid import CENTROID
from dopepp.metrics.pose import Gathered


@dataclass(frozen=True)
class Quantity:
    """What instances are sorted by.

    Attributes:
        heading: Name and unit, for tables and axes.
        of: Its value for every instance of an object.
        decimals: Digits after the point in tables.
    """

    heading: str
    of: Callable[[Gathered], Float[np.ndarray, "n"]]
    decimals: int


def distances(instances: Gathered) -> Float[np.ndarray, "n"]:
    """Return the distance from the camera to the centre of the cuboid, metres."""
    return np.asarray(np.linalg.norm(_centres(instances), axis=1))


def visible_fractions(instances: Gathered) -> Float[np.ndarray, "n"]:
    """Return the visible share of the silhouette, in [0, 1]."""
    return np.asarray(instances.visible_fractions.numpy())


def sizes(instances: Gathered) -> Float[np.ndarray, "n"]:
    """Return the root of the area of the projected cuboid, pixels of the image as it came.

    The whole cuboid counts, with what is hidden or outside the image; unlike the distance it says
    when a flat part is seen from its edge.
    """
    areas = []
    for T, K in zip(instances.T_gt.numpy(), instances.K.numpy(), strict=True):
        corners = project_keypoints(instances.part.cuboid, T, K)[:CENTROID]
        # A corner behind the camera has no projection.
        corners = corners[np.isfinite(corners).all(axis=1)].astype(np.float32)
        areas.append(cv2.contourArea(cv2.convexHull(corners)) if len(corners) > 2 else 0.0)
    return np.sqrt(np.array(areas, np.float64))


def view_angles(instances: Gathered) -> Float[np.ndarray, "n"]:
    """Return the angle between the object's +z axis and the way from it to the camera, degrees.

    At 0° the +z face of the cuboid looks at the camera, at 90° it is seen from its edge.
    """
    towards_camera, axes = -_centres(instances), instances.T_gt.numpy()[:, :3, 2]
    across = np.linalg.norm(np.cross(axes, towards_camera), axis=1)
    return np.asarray(np.degrees(np.arctan2(across, (axes * towards_camera).sum(axis=1))))


def _centres(instances: Gathered) -> Float[np.ndarray, "n 3"]:
    """Return the centres of the cuboids in the camera frame, metres."""
    T = instances.T_gt.numpy()
    return np.asarray(T[:, :3, :3] @ instances.part.cuboid[CENTROID] + T[:, :3, 3])


QUANTITIES: Final[dict[str, Quantity]] = {
    "distance": Quantity("distance (m)", distances, 3),
    "visibility": Quantity("visible fraction", visible_fractions, 3),
    "size": Quantity("apparent size (px)", sizes, 1),
    "rotation": Quantity("view angle (°)", view_angles, 1),
}
"""What rates can be broken down by."""
