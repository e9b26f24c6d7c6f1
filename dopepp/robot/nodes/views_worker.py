"""ViewsWorker: estimates poses in the world from images that several cameras took at one time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from dopepp.core.errors import UserError
from dopepp.geometry.camera import Transform
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.several_views.view_files import CameraPose
from dopepp.inference.several_views.views_tracker import ViewsTracker
from dopepp.robot.nodes.worker import Answer, Shot, Worker, WorkerSettings

WORLD: Final = "world"  # default name of the frame of all poses


class ViewsWorker(Worker):
    """Worker for sets of images; the poses are in a world frame.

    Args:
        estimator: Estimator that refines by region.
        poses: Pose and calibration of each camera. None: the poses are those of :attr:`look_up`.
        camera_error: See :meth:`PoseEstimator.predict_views`.
        track: Track the parts from set to set.

    Raises:
        UserError: The estimator does not support the settings.
    """

    look_up: Callable[[str, int], Transform]
    """Returns the pose of a camera's optical frame in the world at a stamp, e.g. from TF."""

    def __init__(
        self,
        estimator: PoseEstimator,
        poses: Sequence[CameraPose] | None,
        world: str = WORLD,
        camera_error: tuple[float, float] | None = None,
        settings: WorkerSettings | None = None,
        track: bool = False,
    ) -> None:
        super().__init__(estimator, settings)
        self.poses, self.world, self._camera_error = poses, world, camera_error
        self._views_tracker = ViewsTracker(self._estimator(True)) if track else None

    def update(self, settings: WorkerSettings) -> None:
        """Replace the settings for all further images; see :meth:`Worker.update`."""
        if not settings.refine:
            problem = "refine=false with images of several cameras"
            raise UserError(problem, "refine=true", "set refine=true, or pass a single --topic")
        super().update(settings)

    def process(self, *shots: Shot) -> Answer | None:
        """Estimate the poses in the world in a set of images, one of each camera, in order.

        The answer has the first image's stamp. It is None (after a warning) if an image cannot be
        processed or has no camera pose.
        """
        given = [None] * len(shots) if self.poses is None else [p.camera for p in self.poses]
        decoded = [self._decoded(shot, camera) for shot, camera in zip(shots, given, strict=True)]
        views = [view for view in decoded if view is not None]
        if len(views) < len(shots):
            return None
        self._check_time(views[0].stamp, shots[0].topic)
        estimator = self._estimator(True).reporting(self.settings.confidence)
        tracker = self._views_tracker
        if tracker is not None:
            tracker.estimator = estimator
        try:
            if self.poses is None:
                T_world_cam = [self.look_up(view.frame_id, view.stamp) for view in views]
            else:
                T_world_cam = [pose.T_world_cam for pose in self.poses]
            images, cameras = [view.frame.image for view in views], [view.camera for view in views]
            names, error = [shot.topic for shot in shots], self._camera_error
            estimate = estimator.predict_views if tracker is None else tracker.track
            result = estimate(images, cameras, T_world_cam, camera_error=error, names=names)
        except ValueError as problem:
            self._reject("views", str(problem))
            return None
        for finding in result.findings:
            self._warn("finding", finding)
        return self._answer(views[0].stamp, self.world, result)

    def restart(self) -> None:
        """Begin the tracking anew."""
        if self._views_tracker is not None:
            self._views_tracker = ViewsTracker(self._estimator(True))
