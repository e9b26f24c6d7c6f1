"""Worker: what a node makes of each picture, whatever has brought it.

What is wrong with a picture or its camera ends nothing: it is said once, with what to do, and the
next picture is looked at.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from dopepp.core.errors import UserError
from dopepp.core.validation import Range, check
from dopepp.geometry.camera_file import Camera
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.frames import CameraFrame
from dopepp.inference.frames.ros import CameraInfo, decode_image, is_rectified
from dopepp.inference.pose_result import PoseResult, make_shape, spent_between
from dopepp.inference.tracker import PoseTracker

PATIENCE: Final = 5
"""Pictures in a row without a ``camera_info`` before that is said: the first may come earlier."""

OPTICAL: Final = "optical"  # what the name of a frame has in it whose z looks forward (REP 103)

logger = logging.getLogger(__name__)


class Stamp(NamedTuple):
    """When a picture was taken, as ROS counts: seconds since 1970 and nanoseconds."""

    sec: int
    nanosec: int

    @property
    def seconds(self) -> float:
        """Both as one number."""
        return self.sec + self.nanosec / 1e9


@dataclass(frozen=True)
class Settings:
    """What may change while a node runs."""

    confidence: float = 0.0  # least score of a pose, in [0, 1]
    refine: bool = False  # whether poses are made precise on the picture
    overlay: bool = False  # whether the picture with the poses drawn on it is wanted

    def __post_init__(self) -> None:
        check("confidence", self.confidence, float, Range(0, 1))
        check("refine", self.refine, bool)
        check("overlay", self.overlay, bool)


@dataclass(frozen=True, eq=False)
class Answer:
    """Poses on a picture, with its stamp and its camera's optical frame, which they are in."""

    stamp: Stamp
    frame_id: str
    result: PoseResult

    @property
    def numbers(self) -> list[int]:
        """The n of every pose's frame ``<object>_<n>``.

        That is its identity where parts are followed, else its place among its object's, the best
        score first.
        """
        if self.result.identities is not None:
            return [*self.result.identities]
        names = [detection.object for detection in self.result.detections]
        return [names[:index].count(name) for index, name in enumerate(names)]


class Worker:
    """Looks at one picture after the other.

    Args:
        estimator: Finds the parts.
        settings: To begin with; may be replaced at any time (:meth:`set`).
        camera: Of all pictures, in place of what comes with each.
        frame_id: Of the camera's optical frame, in place of the pictures' own.
        track: Follow the parts from picture to picture, which refines.
        say: Where warnings go.

    Raises:
        UserError: The settings ask for what this estimator cannot do.
    """

    def __init__(
        self,
        estimator: PoseEstimator,
        settings: Settings | None = None,
        camera: Camera | None = None,
        frame_id: str | None = None,
        track: bool = False,
        say: Callable[[str], None] = logger.warning,
    ) -> None:
        self._estimators = {estimator.refiner is not None: estimator}
        self._camera, self._frame_id, self._say = camera, frame_id, say
        self._tracker = PoseTracker(self._estimator(True)) if track else None
        self._said: set[str] = set()
        self._last: Stamp | None = None
        self._number = self._without_info = 0
        self._shapes = {part.name: make_shape(part) for part in estimator.solid_parts}
        self.trouble = ""
        """What is wrong with the last picture, empty where nothing is."""
        self.parts = estimator.solid_parts
        self.settings = Settings()
        self.set(settings or Settings(refine=track or estimator.refiner is not None))

    def set(self, settings: Settings) -> None:
        """Change the settings; a :class:`UserError`, and no change, where they cannot be."""
        if self._tracker is not None and not settings.refine:
            raise UserError("refine=false with --track", "refine=true", "start without --track")
        self._estimator(settings.refine)
        self.settings = settings

    def _estimator(self, refine: bool) -> PoseEstimator:
        """Return the estimator that refines, or the one that does not; they share the network."""
        if refine not in self._estimators:
            own = self._estimators[not refine]
            self._estimators[refine] = (
                own.refining("region", own.solid_parts) if refine
                else PoseEstimator(own.network, own.checkpoint, own.device)
            )  # fmt: skip
        return self._estimators[refine]

    def take(self, message: Any, info: Any | None, topic: str) -> Answer | None:
        """Process the picture of a ROS message; ``info`` is the ``camera_info`` that holds for it.

        None where that is not possible, which was said.
        """
        try:
            image = decode_image(message)
        except Exception as error:  # whatever is wrong with a message that anybody sent
            fix = "let the driver send rgb8 or bgr8, or JPEG"
            self._trouble("picture", f"a picture of {topic}: {error!s:.300}; fix: {fix}")
            return None
        try:
            lens = None if info is None else CameraInfo.from_message(info)
        except Exception as error:
            self._trouble("info", f"the camera_info beside {topic}: {error!s:.300}")
            return None
        if lens is None and self._camera is None:
            self._without_info += 1
            if self._without_info == PATIENCE:
                self._trouble(
                    "no info", f"pictures on {topic} without a camera_info beside them: let the "
                    "driver publish it, or pass --camera camera.yaml (`dopepp calibrate camera`)",
                )  # fmt: skip
            return None
        self._without_info = 0
        stamp = stamp_of(message.header.stamp)
        frame_id = self._checked_frame(message.header.frame_id, lens, topic)
        self._check_time(stamp, topic)
        try:
            camera = self._camera or lens.camera(f"camera_info of {topic}", is_rectified(topic))  # type: ignore[union-attr]
            cropped = self._camera is None and lens is not None and lens.roi is not None
            frame = CameraFrame(image, topic, self._number, stamp.seconds)
            result = self.result(frame, camera, cropped)
        except ValueError as error:  # a UserError, or fields of odd lengths
            self._trouble("camera", str(error))
            return None
        self.trouble = ""
        self._number += 1
        return Answer(stamp, frame_id, result)

    def result(self, frame: CameraFrame, camera: Camera, cropped: bool = False) -> PoseResult:
        """Return the poses on a picture; a :class:`UserError` where the camera cannot be its.

        Pictures that are ``cropped`` may have the principal point anywhere.
        """
        size = (frame.image.shape[1], frame.image.shape[0])
        if camera.size is not None and camera.size != size:
            raise UserError(
                f"{camera.source} of {camera.size[0]}×{camera.size[1]}, and pictures of "
                f"{size[0]}×{size[1]}", "one size", "let the driver publish the camera_info of "
                "these pictures, or calibrate the camera at this size",
            )  # fmt: skip
        settings = self.settings
        estimator = self._estimator(settings.refine)
        before, start = dict(estimator.spent_ms), time.perf_counter()
        image = camera.undistorted(frame.image)
        estimator.spent_ms["pre"] += 1000 * (time.perf_counter() - start)
        ids: list[int] | None = None
        if self._tracker is None:
            found = estimator.predict(image, camera.K, cropped=cropped)
        else:
            tracks = self._tracker.track(image, camera.K, cropped)
            found, ids = [one.detection for one in tracks], [one.identity for one in tracks]
        chosen = [k for k, one in enumerate(found) if one.score >= settings.confidence]
        return PoseResult(
            image, camera.K, [found[k] for k in chosen], spent_between(before, estimator.spent_ms),
            frame.name, frame.number, frame.time, ids and [ids[k] for k in chosen], self._shapes,
        )  # fmt: skip

    def _checked_frame(self, frame_id: str, info: CameraInfo | None, topic: str) -> str:
        """Return the frame that poses are in, and say what is odd about it."""
        if self._frame_id is not None:
            return self._frame_id
        fix = "name the camera's optical frame: --frame camera_optical_frame"
        if OPTICAL not in frame_id:
            self._warn(
                "frame", f"pictures on {topic} are in frame {frame_id!r:.80}, which is not named "
                f"as an optical one; poses have x right, y down and z forward in it; {fix}",
            )  # fmt: skip
        elif info is not None and info.frame_id not in ("", frame_id):
            self._warn(
                "frame", f"pictures on {topic} are in frame {frame_id!r:.80}, their camera_info in "
                f"{info.frame_id!r:.80}; the pictures' is used; {fix}",
            )  # fmt: skip
        return frame_id

    def _check_time(self, stamp: Stamp, topic: str) -> None:
        """Say where pictures have no stamp, or one before the last; then follow parts anew."""
        last, self._last = self._last, stamp
        if stamp == Stamp(0, 0):
            self._warn(
                "no stamp", f"pictures on {topic} without a stamp, which TF cannot place in time: "
                "let the driver set header.stamp",
            )  # fmt: skip
        elif last is not None and stamp < last:
            back = last.seconds - stamp.seconds
            self._warn(
                "back", f"stamps on {topic} went back by {back:.3f} s: a recording or simulation "
                "that began again, or two cameras on one topic? parts are looked for anew",
            )  # fmt: skip
            if self._tracker is not None:
                self._tracker = PoseTracker(self._estimator(True))

    def _trouble(self, kind: str, text: str) -> None:
        """Say what keeps a picture from being processed."""
        self.trouble = text
        self._warn(kind, text)

    def _warn(self, kind: str, text: str) -> None:
        if kind not in self._said:
            self._said.add(kind)
            self._say(text)


def stamp_of(stamp: Any) -> Stamp:
    """Return a message's stamp."""
    return Stamp(int(stamp.sec), int(stamp.nanosec))
