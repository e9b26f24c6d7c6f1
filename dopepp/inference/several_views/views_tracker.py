"""ViewsTracker: tracks parts in the world through synchronised images of several posed cameras.

Parts are tracked as with one camera (:mod:`dopepp.inference.tracker`), but a part's pose is refined
on all views that show it. The network is run as often as with one camera: on whole images, or on
the regions around doubtful parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix, Transform
from dopepp.geometry.camera_file import Camera
from dopepp.inference.input_image import Depth, Region
from dopepp.inference.motion import Motion
from dopepp.inference.refinement.solver import Prior
from dopepp.inference.several_views import joint_estimator, search, views_result
from dopepp.inference.several_views.joint import JointEstimator
from dopepp.inference.several_views.views_result import ViewsResult, WorldDetection
from dopepp.inference.tracker import Estimate, Tracker, region_around


class ViewsTracker(Tracker[WorldDetection]):
    """Tracks the parts of an estimator in the world; see :class:`Tracker`."""

    _joint: JointEstimator  # of the last images
    _findings: Sequence[str]
    _num_views = 0  # number of the last images

    def track(
        self,
        images: Sequence[RGBImage],
        cameras: Sequence[Camera | CameraMatrix],
        T_world_cam: Sequence[Transform],
        depths: Sequence[Depth] | None = None,
        camera_error: tuple[float, float] | None = None,
        names: Sequence[str] | None = None,
    ) -> ViewsResult:
        """Track and detect the parts on the next set of images, taken at the same time.

        Arguments and errors are those of :meth:`PoseEstimator.predict_views`. The number and the
        order of the cameras must not change; the cameras may move.

        Returns:
            Parts that are not lost, with identities and velocities, by identity. Contradictions
            between the views are reported if the network was run.
        """
        before, self._findings = dict(self.estimator.spent_ms), ()
        given = images, cameras, T_world_cam, depths, camera_error, names
        joint, count = joint_estimator(self.estimator, *given), self._num_views
        if count not in (0, len(images)):
            problem = f"{len(images)} images after sets of {count}"
            fix = "pass an image of every camera, or make a new tracker"
            raise UserError(problem, f"{count} images", fix)
        self._joint, self._num_views = joint, len(images)
        tracks = self._advance()
        parts = [track.detection for track in tracks]
        identities = [track.identity for track in tracks]
        velocities = [track.velocity for track in tracks]
        found = parts, self._findings, (), before, identities, velocities
        result = views_result(self.estimator, self._joint, *found)
        return replace(result, number=self._frame - 1)

    def _distance(self, pose: Transform) -> float:
        depths = [float(view.pose(pose)[2, 3]) for view in self._joint.views]
        return min((depth for depth in depths if depth > 0), default=max(depths))

    def _refined(
        self, estimate: Estimate[WorldDetection], forecast: Motion
    ) -> Estimate[WorldDetection] | None:
        with self.estimator.timed("refine"):
            followed = self._joint.follow(estimate.detection, _prior(forecast))
        if followed is None:
            return None
        part, covariance = followed
        return replace(_estimate(part, part.agreement), covariance=covariance)

    def _moved(
        self, estimate: Estimate[WorldDetection], forecast: Motion, agreement: float
    ) -> Estimate[WorldDetection]:
        part = estimate.detection
        shown = {n for n, item in enumerate(part.evidence) if item.status == "supports"}
        moved = self._joint.moved(part, _prior(forecast), {}, shown, part.disagreement)
        return _estimate(moved, agreement)

    def _detected(
        self, near: Sequence[Estimate[WorldDetection]] | None
    ) -> list[Estimate[WorldDetection]]:
        regions = None if near is None else self._regions([part.detection for part in near])
        result = search(self.estimator, self._joint, regions=regions)
        self._findings, self.weaker = result.findings, [part.score for part in result.weaker]
        return [_estimate(part, part.agreement) for part in result.detections]

    def _regions(self, parts: Sequence[WorldDetection]) -> list[Region | None]:
        """Return the region around parts in each view, None where no part is on the image."""
        regions = []
        for number, view in enumerate(self._joint.views):
            evidence = [part.evidence[number] for part in parts]
            shown = [item.detection for item in evidence if item.status != "outside"]
            regions.append(region_around(shown, view.image) if shown else None)
        return regions


def _prior(forecast: Motion) -> Prior:
    """Return the distribution of a predicted pose."""
    return Prior(forecast.T_cam_obj, np.linalg.inv(forecast.pose_covariance))


def _estimate(part: WorldDetection, agreement: float) -> Estimate[WorldDetection]:
    """Return a detection in the world as an estimate."""
    pose, covariance = part.T_world_obj, part.covariance
    return Estimate(part, part.object, part.score, pose, covariance, agreement)
