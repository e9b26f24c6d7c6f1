"""Worker: processes the images of a node, for any transport.

An invalid image or camera does not stop the node. The worker warns once about each kind of problem
and continues with the next image.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from dopepp.core.errors import UserError
from dopepp.core.validation import Range, check
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix
from dopepp.geometry.camera_file import Camera
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.frames import CameraFrame
from dopepp.inference.frames.ros import camera_of_info, decode_image, is_rectified
from dopepp.inference.frames.source import check_distortion
from dopepp.inference.pose_result import PoseResult, make_shape
from dopepp.inference.several_views.views_result import ViewsResult, WorldDetection
from dopepp.inference.stream import FrameEstimator
from dopepp.inference.tracker import PoseTracker
from dopepp.recovery.detection import Detection

PATIENCE: Final = 5  # number of consecutive images without ``camera_info`` before the warning
OPTICAL: Final = "optical"  # part of the name of each frame whose z axis is forward (REP 103)

logger = logging.getLogger(__name__)

Posed = Detection | WorldDetection  # detection in the frame of a camera, or in the world


@dataclass(frozen=True)
class WorkerSettings:
    """Settings of a worker that may change while it runs."""

    confidence: float | None = None  # minimum score of a pose; None: the checkpoint's threshold
    refine: bool = False  # whether poses are refined on the image
    overlay: bool = False  # whether images with drawn poses are published

    def __post_init__(self) -> None:
        if self.confidence is not None:
            check("confidence", self.confidence, float, Range(0, 1))
        check("refine", self.refine, bool)
        check("overlay", self.overlay, bool)


@dataclass(frozen=True, eq=False)
class Answer:
    """Poses in an image, with the time and frame for ROS messages."""

    stamp: int  # capture time of the image, nanoseconds since 1970
    frame_id: str  # reference frame: the camera's optical frame, or the world of several cameras
    result: PoseResult | ViewsResult

    @property
    def detections(self) -> Sequence[Posed]:
        """Detections in the reference frame."""
        return self.result.detections

    @property
    def numbers(self) -> list[int]:
        """Number n of each pose, for its TF frame ``<object>_<n>``.

        With tracking, n is the identity of the track; otherwise, an object's detections are
        numbered from 0 by descending score.
        """
        if self.result.identities is not None:
            return [*self.result.identities]
        names = [detection.object for detection in self.detections]
        return [names[:index].count(name) for index, name in enumerate(names)]


class Shot(NamedTuple):
    """Messages of an image."""

    message: Any  # ``sensor_msgs/Image`` or ``CompressedImage``
    info: Any | None  # ``sensor_msgs/CameraInfo``, if any
    topic: str  # topic of the image


@dataclass(frozen=True, eq=False)
class Decoded:
    """Content of an image's messages."""

    frame: CameraFrame
    camera: Camera
    stamp: int
    frame_id: str  # name of the camera's optical frame


class Worker:
    """Estimator of the poses in a stream of images; invalid images only cause warnings.

    Args:
        camera: Camera of all images, in place of their ``camera_info``.
        frame_id: Name of the camera's optical frame, in place of the frame in the messages.
        track: Track the parts from frame to frame; this includes refinement.

    Raises:
        UserError: The estimator does not support the settings.
    """

    def __init__(
        self,
        estimator: PoseEstimator,
        settings: WorkerSettings | None = None,
        camera: Camera | None = None,
        frame_id: str | None = None,
        track: bool = False,
    ) -> None:
        self._estimators = {estimator.refiner is not None: estimator}
        self._camera, self._frame_id = camera, frame_id
        self._tracker = PoseTracker(self._estimator(True)) if track else None
        self._warned: set[str] = set()
        self._last = 0  # stamp of the last image, nanoseconds
        self._number, self._num_without_info = 0, dict[str, int]()
        self._shapes = {part.name: make_shape(part) for part in estimator.solid_parts}
        self.problem = ""
        """Why the last image could not be processed, or an empty string."""
        self.parts = estimator.solid_parts
        self.settings = WorkerSettings()
        self.update(settings or WorkerSettings(refine=track or estimator.refiner is not None))

    def update(self, settings: WorkerSettings) -> None:
        """Replace the settings for all further images.

        Raises:
            UserError: The settings are not supported; the previous settings remain.
        """
        if self._tracker is not None and not settings.refine:
            fix = "set refine=true, or start the node without --track"
            raise UserError("refine=false with --track", "refine=true", fix)
        self._estimator(settings.refine)
        self.settings = settings

    def _estimator(self, refine: bool) -> PoseEstimator:
        """Return the estimator with or without refinement; both estimators share the network."""
        if refine not in self._estimators:
            base = self._estimators[not refine]
            term = "region" if refine else None
            self._estimators[refine] = base.refining(term, base.solid_parts)
        return self._estimators[refine]

    def process(self, *shots: Shot) -> Answer | None:
        """Estimate the poses in the only image; return None (after a warning) if it is invalid."""
        (shot,) = shots
        decoded = self._decoded(shot, self._camera)
        if decoded is None:
            return None
        self._check_time(decoded.stamp, shot.topic)
        try:
            result = self.result(decoded.frame, decoded.camera)
        except ValueError as error:
            self._reject("camera", str(error))
            return None
        return self._answer(decoded.stamp, decoded.frame_id, result)

    def _answer(self, stamp: int, frame_id: str, result: PoseResult | ViewsResult) -> Answer:
        self.problem = ""
        self._number += 1
        return Answer(stamp, frame_id, result)

    def _decoded(self, shot: Shot, given: Camera | None) -> Decoded | None:
        """Return an image with its camera (``given``, or ``camera_info``'s), or None and warn."""
        message, info, topic = shot
        try:
            image = decode_image(message)
        except Exception as error:  # a message of any sender may cause any error
            fix = "configure the driver to send rgb8, bgr8 or JPEG"
            self._reject(f"image {topic}", f"an image of {topic}: {error!s:.300}; fix: {fix}")
            return None
        missing = self._num_without_info.pop(topic, 0) + 1
        if info is None and given is None:
            self._num_without_info[topic] = missing
            if missing == PATIENCE:
                problem = f"images on {topic} without camera_info: let the driver publish it, or "
                problem += "pass --camera camera.yaml (from `dopepp calibrate camera`)"
                self._reject(f"no info {topic}", problem)
            return None
        stamp = stamp_of(message)
        frame_id = self._checked_frame(message.header.frame_id, info, topic)
        try:
            source = f"camera_info of {topic}"
            check_distortion(given, is_rectified(topic), topic)
            camera = given or camera_of_info(info, source, is_rectified(topic))
            check_size(camera, image)
        except UserError as error:
            self._reject("camera", str(error))
            return None
        except Exception as error:  # fields of wrong types or lengths
            self._reject(f"info {topic}", f"the camera_info of {topic}: {error!s:.300}")
            return None
        frame = CameraFrame(image, topic, self._number, stamp / 1e9)
        return Decoded(frame, camera, stamp, frame_id)

    def result(self, frame: CameraFrame, camera: Camera) -> PoseResult:
        """Estimate the poses in an image with the current settings, after undistorting it.

        Raises:
            UserError: The camera was calibrated for another image size.
        """
        check_size(camera, frame.image)
        estimator = self._estimator(self.settings.refine).reporting(self.settings.confidence)

        def undistort(image: RGBImage) -> tuple[RGBImage, CameraMatrix]:
            return camera.undistorted(image), camera.K

        given = estimator, self._shapes, undistort, camera.cropped, self._tracker
        return FrameEstimator(*given)(frame)

    def _checked_frame(self, frame_id: str, info: Any | None, topic: str) -> str:
        """Return the name of the poses' frame; warn if it does not contain "optical"."""
        if self._frame_id is not None:
            return self._frame_id
        problem = ""
        if OPTICAL not in frame_id:
            problem = "which is not named as an optical frame; "
            problem += "a pose's frame has x right, y down and z forward"
        elif info is not None and info.header.frame_id not in ("", frame_id):
            other = info.header.frame_id
            problem = f"their camera_info in {other!r:.80}; the images' frame is used"
        if problem:
            images = f"images on {topic} are in frame {frame_id!r:.80}"
            fix = "name the camera's optical frame: --frame camera_optical_frame"
            self._warn(f"frame {topic}", f"{images}, {problem}; {fix}")
        return frame_id

    def _check_time(self, stamp: int, topic: str) -> None:
        """Warn about zero or decreasing stamps; restart the tracking after a decrease."""
        decrease_s, self._last = (self._last - stamp) / 1e9, stamp
        if not stamp:
            problem = f"images on {topic} without a stamp, which TF needs: "
            self._warn("no stamp", f"{problem}let the driver set header.stamp")
        elif decrease_s > 0:
            self._warn(
                "back",
                f"stamps on {topic} went back by {decrease_s:.3f} s: a restarted recording or "
                "simulation, or two cameras on one topic? Parts are detected again",
            )
            self.restart()

    def restart(self) -> None:
        """Begin the tracking anew, e.g. for the images of another camera."""
        if self._tracker is not None:
            self._tracker = PoseTracker(self._estimator(True))

    def _reject(self, kind: str, problem: str) -> None:
        """Set :attr:`problem`, why the last image is not processed, and warn."""
        self.problem = problem
        self._warn(kind, problem)

    def _warn(self, kind: str, text: str) -> None:
        """Log a warning unless a warning of this kind was logged before."""
        if kind not in self._warned:
            self._warned.add(kind)
            logger.warning(text)


def check_size(camera: Camera, image: RGBImage) -> None:
    """Check that a camera was calibrated for the size of an image.

    Raises:
        UserError: It was calibrated for another size.
    """
    size = (image.shape[1], image.shape[0])
    if camera.size is not None and camera.size != size:
        sizes = f"{camera.size[0]}×{camera.size[1]}, and images of {size[0]}×{size[1]}"
        fix = "let the driver publish the camera_info of these images, or calibrate the "
        fix += "camera at this size"
        raise UserError(f"{camera.source} of {sizes}", "a camera of the images' size", fix)


def stamp_of(message: Any) -> int:
    """Return the stamp in the header of a ROS message, nanoseconds since 1970."""
    return 10**9 * int(message.header.stamp.sec) + int(message.header.stamp.nanosec)
