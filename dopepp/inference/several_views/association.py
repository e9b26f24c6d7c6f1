"""Association of the detections of several views, in the world.

Two detections can show the same part if their poses differ by less than :data:`GATE` standard
deviations of both, at the nearest of the part's equivalent poses. Every detection, best first,
gathers the nearest free detection of each other view.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.geometry.camera import Transform, moved, transform
from dopepp.geometry.cuboid import Cuboid
from dopepp.inference.refinement.refiner import LOOSER
from dopepp.inference.refinement.several_views import PosedPicture
from dopepp.inference.refinement.solver import PoseMatrix, Prior
from dopepp.recovery.detection import Detection

GATE: Final = 4.5
"""Largest Mahalanobis distance between detections of one part, with loosened covariances."""

Group = Float[np.ndarray, "group 4 4"]  # transforms that map the part onto itself


@dataclass(frozen=True, eq=False)
class Sighting:
    """A detection of one view, in the world."""

    view: int
    detection: Detection  # in the camera
    T_world_obj: Transform
    covariance: PoseMatrix  # loosened, with the error of the camera's pose; world axes


def sight(view: int, detection: Detection, picture: PosedPicture) -> Sighting:
    """Express a detection in the world."""
    loose = LOOSER**2 * detection.covariance
    return Sighting(view, detection, *picture.to_world(detection.T_cam_obj, loose))


def nearest_equivalent(
    T_world_obj: Transform, to: Transform, group: Group, cuboid: Cuboid
) -> Transform:
    """Return the pose in which a symmetric part looks the same that is nearest to another pose."""
    equal = T_world_obj @ group
    points = cuboid @ equal[:, :3, :3].swapaxes(1, 2) + equal[:, None, :3, 3]
    distances = ((points - transform(to, cuboid)) ** 2).sum(axis=(1, 2))
    return np.asarray(equal[distances.argmin()])


def distance(first: Sighting, second: Sighting, group: Group, cuboid: Cuboid) -> float:
    """Return the Mahalanobis distance between two sightings."""
    pose = nearest_equivalent(second.T_world_obj, first.T_world_obj, group, cuboid)
    information = np.linalg.inv(first.covariance + second.covariance)
    return math.sqrt(Prior(first.T_world_obj, information).squared_distance(pose))


def associate(
    views: Sequence[Sequence[Sighting]],
    groups: Mapping[str, Group],
    cuboids: Mapping[str, Cuboid],
) -> list[list[Sighting]]:
    """Return the sightings of each possible part, those of the best detection first.

    Args:
        views: Sightings of each view.
        groups: Symmetry group of each part.
        cuboids: Cuboid of each part, metres.
    """
    free = sorted(
        (sighting for view in views for sighting in view), key=lambda item: -item.detection.score
    )
    clusters: list[list[Sighting]] = []
    while free:
        seed, *free = free
        name, cluster = seed.detection.object, [seed]
        for view in range(len(views)):
            others = [
                (distance(seed, other, groups[name], cuboids[name]), number)
                for number, other in enumerate(free)
                if other.view == view != seed.view and other.detection.object == name
            ]
            apart, number = min(others, default=(math.inf, 0))
            if apart <= GATE:
                cluster.append(free.pop(number))
        clusters.append(cluster)
    return clusters


def fused(cluster: Sequence[Sighting], group: Group, cuboid: Cuboid) -> Prior:
    """Return the mean of the sightings of a part, weighted by their information."""
    seed = Prior(cluster[0].T_world_obj, np.linalg.inv(cluster[0].covariance))
    information, gradient = seed.information, np.zeros(6)
    for other in cluster[1:]:
        pose = nearest_equivalent(other.T_world_obj, seed.T_cam_obj, group, cuboid)
        weight = np.linalg.inv(other.covariance)
        information = information + weight
        gradient += weight @ Prior(pose, weight).offset(seed.T_cam_obj)
    return Prior(moved(seed.T_cam_obj, np.linalg.solve(information, gradient)), information)
