"""Association of the detections of several views, in the world.

Two detections can show the same part if the Mahalanobis distance between their poses is at most
:data:`GATE`. Of the equivalent poses of a symmetric part, the nearest pair counts. In the order of
scores, each detection is associated with the nearest free detection of every other view.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.geometry.camera import Transform, move_pose, transform
from dopepp.geometry.cuboid import Cuboid
from dopepp.geometry.symmetry import symmetry_group
from dopepp.inference.refinement.joint_refinement import PosedImage
from dopepp.inference.refinement.refiner import INFLATION
from dopepp.inference.refinement.solver import Prior
from dopepp.parts.part import Part
from dopepp.recovery.detection import Detection

GATE: Final = 4.5 * INFLATION
"""Largest Mahalanobis distance between detections of one part. The limit is generous: covariances
were fitted to images like the training images, and the joint pose is verified."""


@dataclass(frozen=True, eq=False)
class PartGeometry:
    """Cuboid and symmetries of a part, to compare poses that are equivalent by symmetry."""

    cuboid: Cuboid
    group: Float[np.ndarray, "group 4 4"]  # transforms that map the part onto itself

    @classmethod
    def of(cls, part: Part) -> PartGeometry:
        """Return the geometry of a part, with its sampled continuous symmetries."""
        group = symmetry_group(part.symmetries_discrete, part.symmetries_continuous)
        return cls(part.cuboid, group)

    def nearest(self, pose: Prior, to: Transform) -> Prior:
        """Return the symmetric equivalent of ``pose`` that is nearest to ``to``.

        The distance is the sum of the squared distances between corresponding keypoints.
        """
        equal = pose.T_cam_obj @ self.group
        points = self.cuboid @ equal[:, :3, :3].swapaxes(1, 2) + equal[:, None, :3, 3]
        distances = ((points - transform(to, self.cuboid)) ** 2).sum(axis=(1, 2))
        return Prior(np.asarray(equal[distances.argmin()]), pose.information)

    def separation(self, pose: Prior, other: Prior) -> float:
        """Return two poses' Mahalanobis distance; see :meth:`nearest` for symmetric parts."""
        return separation(pose, self.nearest(other, pose.T_cam_obj))

    def mean(self, poses: Sequence[Prior]) -> Prior:
        """Return the information-weighted mean; see :meth:`nearest` for symmetric parts."""
        first = poses[0].T_cam_obj
        information, gradient = np.zeros((6, 6)), np.zeros(6)
        for pose in poses:
            information = information + pose.information
            gradient += pose.information @ self.nearest(pose, first).offset(first)
        return Prior(move_pose(first, np.linalg.solve(information, gradient)), information)


@dataclass(frozen=True, eq=False)
class PartObservation:
    """Detection in one view, with its poses in the world before and after refinement."""

    view: int  # index of the view
    detection: Detection  # detection in the camera
    pose: Prior  # refined pose in the world, with the error of the camera's pose
    start: Prior  # pose before refinement, with a covariance that admits the refined pose


def make_observation(view: int, detection: Detection, image: PosedImage) -> PartObservation:
    """Return the observation in the world for a detection in the view with index ``view``."""
    pose = image.to_world(detection.T_cam_obj, detection.covariance)
    assert detection.start is not None
    start = image.to_world(*detection.start)
    # The expected squared distance of a six-dimensional error is 6.
    surprise = max(1.0, start.squared_distance(pose.T_cam_obj) / 6)
    return PartObservation(
        view, detection, pose, Prior(start.T_cam_obj, start.information / surprise)
    )


def separation(first: Prior, second: Prior) -> float:
    """Return the Mahalanobis distance between two poses under the sum of their covariances."""
    both = np.linalg.inv(first.information) + np.linalg.inv(second.information)
    return math.sqrt(Prior(first.T_cam_obj, np.linalg.inv(both)).squared_distance(second.T_cam_obj))


def associate(
    views: Sequence[Sequence[PartObservation]], geometries: Mapping[str, PartGeometry]
) -> list[list[PartObservation]]:
    """Group observations of one name with poses within :data:`GATE` of the best observation's pose.

    Args:
        views: Observations of each view.
        geometries: Geometry of each part.

    Returns:
        Observations of each possible part, at most one per view, best detection first. Parts are
        sorted by their best detection.
    """
    free = sorted(
        (observation for view in views for observation in view),
        key=lambda item: -item.detection.score,
    )
    clusters: list[list[PartObservation]] = []
    while free:
        seed, *free = free
        name, cluster = seed.detection.object, [seed]
        for view in range(len(views)):
            others = [
                (geometries[name].separation(seed.pose, other.pose), number)
                for number, other in enumerate(free)
                if other.view == view != seed.view and other.detection.object == name
            ]
            distance, number = min(others, default=(math.inf, 0))
            if distance <= GATE:
                cluster.append(free.pop(number))
        clusters.append(cluster)
    return clusters
