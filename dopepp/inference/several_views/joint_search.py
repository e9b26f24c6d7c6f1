"""Search for a part's pose in the belief maps of all views together.

In each view, too few keypoints may be visible for PnP. The sum of the log beliefs of all views then
still determines the pose, because one pose in the world explains the keypoints in all images
(:mod:`dopepp.recovery.search`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from dopepp.geometry.camera import (
    focal_length,
    invert_transform,
    project_keypoints,
    transform,
)
from dopepp.geometry.cuboid import CENTROID
from dopepp.inference.refinement.joint_refinement import PosedImage
from dopepp.inference.several_views.observations import PartObservation, make_observation
from dopepp.recovery.detection import Detection, log_odds, recalibrate, to_probability
from dopepp.recovery.search import (
    JOINT_STEP,
    PosedMaps,
    PoseSearch,
    centres_on_ray,
    search_covariance,
)

if TYPE_CHECKING:
    from dopepp.inference.estimator import PoseEstimator, SeenMaps


@dataclass(eq=False)
class JointSearch:
    """Searches poses at the centroid of a detection in one view."""

    estimator: PoseEstimator  # estimator of the parts
    views: Sequence[PosedImage]  # images with the poses of their cameras
    maps: Sequence[Sequence[SeenMaps]]  # maps of each view in all sizes

    def __post_init__(self) -> None:
        self._numbers = {part.name: number for number, part in enumerate(self.estimator.parts)}
        self._searches: dict[str, PoseSearch] = {}

    def __call__(self, observation: PartObservation) -> PartObservation | None:
        """Return the observation of the best pose at an observation's centroid.

        The pose is refined and verified in the view of the observation.

        Returns:
            The observation; None if the centroid or the range of depths is unknown.
        """
        detection, view = observation.detection, self.views[observation.view]
        number, seen = self._numbers[detection.object], self.maps[observation.view]
        ranges = [item.depths[number] for item in seen if item.depths is not None]
        known = [depths for depths in ranges if depths is not None]
        centroid = detection.peaks[CENTROID]
        if not known or not np.isfinite(centroid).all():
            return None
        depths = min(near for near, _ in known), max(far for _, far in known)
        tried = centres_on_ray(centroid, view.K, depths, JOINT_STEP)
        T_world_obj = self._search(detection.object).pose(
            transform(invert_transform(view.T_cam_world), tried)
        )
        cuboid, focal_px = self.estimator.parts[number].cuboid, focal_length(seen[0].K)
        T_cam_obj, stride = view.pose(T_world_obj), seen[0].stride
        covariance = search_covariance(T_cam_obj, cuboid, focal_px, stride)
        searched = replace(
            detection,
            T_cam_obj=T_cam_obj,
            keypoints=project_keypoints(cuboid, T_cam_obj, view.K),
            covariance=covariance,
        )
        return make_observation(observation.view, self._refined(searched, view), view)

    def _refined(self, detection: Detection, view: PosedImage) -> Detection:
        """Return a refined detection, whose score contains the log odds of the refined pose."""
        refiner = self.estimator.refiner
        assert refiner is not None  # several views require refinement
        refined = refiner(detection, view.image, view.K, view.depth)
        options, before = self.estimator.recovery, log_odds(detection.probability or 0.0)
        gain = options.refined_verification * (log_odds(refined.probability or 0.0) - before)
        by_depth = view.depth is not None and refiner.uses_depth
        (calibrated,) = recalibrate([refined], options, by_depth)
        return replace(calibrated, score=to_probability(log_odds(detection.score) + gain))

    def _search(self, name: str) -> PoseSearch:
        """Return the search of a part in the maps of all views, prepared once."""
        if name not in self._searches:
            number = self._numbers[name]
            cuboid = self.estimator.parts[number].cuboid
            channels = slice(number * len(cuboid), (number + 1) * len(cuboid))
            posed = [
                PosedMaps(
                    item.belief[channels].float().cpu().numpy(),
                    item.K,
                    item.stride,
                    view.T_cam_world,
                )
                for view, seen in zip(self.views, self.maps, strict=True)
                for item in seen
            ]
            self._searches[name] = PoseSearch(posed, cuboid)
        return self._searches[name]
