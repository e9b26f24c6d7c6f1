"""Estimation of poses in every frame of an image file, video, camera or recording."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, TypedDict, Unpack

from dopepp.core.errors import UserError
from dopepp.core.validation import Range, check
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix
from dopepp.geometry.camera_file import Camera, Crop
from dopepp.geometry.camera_formats import Size
from dopepp.inference.frames import CameraFrame, SourceLike, open_sources
from dopepp.inference.frames.source import Lens, choose_camera
from dopepp.inference.input_image import Depth, Distances, Region, prepare_image
from dopepp.inference.pose_result import PoseResult, Shape, make_shape
from dopepp.inference.tracker import PoseTracker
from dopepp.recovery.detection import Detection

if TYPE_CHECKING:
    from dopepp.inference.estimator import PoseEstimator

MAX_AGE_S: Final = 0.05
"""Time after which a camera's frame is too old for its poses to be reported next, seconds."""


class StreamOptions(TypedDict, total=False):
    """Options for reading and processing a source."""

    stride: int  # use every n-th frame only
    track: bool  # track parts from frame to frame; the estimator must refine by region
    min_score: float | None  # threshold instead of the checkpoint's; see PoseEstimator.reporting
    distances: Distances | None  # expected depths, as in predict; not supported with `track`
    roi: Region | None  # region (x, y, width, height) in pixels; not supported with `track`
    K_size: Size | None  # (width, height) that K belongs to, if images were resized
    crop: Crop | None  # region (x, y, width, height) of the calibrated image, if images are crops
    topic: str | None  # image topic of a ROS recording that has several
    depth: Path | None  # 16-bit PNG of the source's only image, 0 where unknown; not with `track`
    depth_scale: float  # metres per unit of the depth image


def stream(
    estimator: PoseEstimator,
    source: SourceLike,
    K: CameraMatrix | None = None,
    camera: Camera | Path | str | None = None,
    **options: Unpack[StreamOptions],
) -> Iterator[PoseResult]:
    """Yield the detections in each frame of a source as soon as they are estimated.

    Frames of a camera or network stream that arrive while the estimator is busy are dropped: each
    result belongs to the newest frame. Files are read to their end, cameras without end.

    While the poses in one frame are refined, a thread detects the parts in the next frame.

    Args:
        estimator: Detects the parts.
        source: Path, glob pattern, camera number, URL, or opened frame source.
        K: Camera matrix of undistorted images, pixels.
        camera: Camera or camera file, instead of K (default: the camera of a recording).
        **options: Entries of :class:`StreamOptions`.

    Raises:
        UserError: The source cannot be read, or K does not belong to its images.
        RunError: A camera has stopped delivering frames.
    """
    limited = [name for name in ("distances", "roi", "depth") if options.get(name) is not None]
    if options.get("track") and limited:
        names = " and ".join(f"--{name.removesuffix('s')}" for name in limited)
        allowed = "--track without --distance, --roi and --depth"
        raise UserError(f"--track with {names}", allowed, f"leave out --track or {names}")
    stride = check("stride", options.get("stride", 1), int, Range(1, 1_000_000))
    estimator = estimator.reporting(options.get("min_score"))
    shapes = {part.name: make_shape(part) for part in estimator.solid_parts}
    distances, roi = options.get("distances"), options.get("roi")
    path, scale = options.get("depth"), options.get("depth_scale", 0.001)
    for opened in open_sources([source], options.get("topic")):
        lens = Lens(choose_camera(K, camera, opened), options.get("K_size"), options.get("crop"))
        if path is not None and opened.count != 1:
            problem = f"--depth with {opened.count or 'many'} images"
            fix = "pass only the image that the depth belongs to"
            raise UserError(problem, "one image", fix)
        read_depth = None if path is None else partial(lens.read_depth, path, scale)
        tracker = PoseTracker(estimator) if options.get("track") else None
        given = estimator, shapes, lens.undistort, lens.is_cropped, tracker
        frame_estimator = FrameEstimator(*given, read_depth, distances, roi)
        frames = opened.frames(stride)
        if tracker is not None or opened.count == 1:
            yield from map(frame_estimator, frames)
        else:
            yield from _overlapped(frame_estimator, frames, MAX_AGE_S if opened.is_live else None)


class DetectedFrame(NamedTuple):
    """Frame of a source with its detections before refinement."""

    frame: CameraFrame
    estimator: PoseEstimator  # measures the times of this frame only
    image: RGBImage  # without lens distortion
    K: CameraMatrix
    depth: Depth | None = None
    starts: Sequence[Detection] = ()  # empty with a tracker


@dataclass(frozen=True, eq=False)
class FrameEstimator:
    """Estimates the poses in the frames of a source.

    :meth:`detect` can process the next frame in another thread during :meth:`refine`, except with a
    tracker.
    """

    estimator: PoseEstimator
    shapes: Mapping[str, Shape]  # shape of each part, for drawing
    undistort: Callable[[RGBImage], tuple[RGBImage, CameraMatrix]]
    cropped: bool = False  # whether images may be crops; see PoseEstimator.predict
    tracker: PoseTracker | None = None  # tracks parts from frame to frame
    read_depth: Callable[[CameraMatrix], Depth] | None = None  # not supported with a tracker
    distances: Distances | None = None  # expected depths; not supported with a tracker
    roi: Region | None = None  # region to process; not supported with a tracker

    def __call__(self, frame: CameraFrame) -> PoseResult:
        """Detect or track the parts in one frame."""
        return self.refine(self.detect(frame))

    def detect(self, frame: CameraFrame) -> DetectedFrame:
        """Undistort a frame and, without a tracker, detect the parts."""
        estimator = self.estimator.with_own_times()
        with estimator.timed("pre"):
            image, K = self.undistort(frame.image)
        if self.tracker is not None:
            return DetectedFrame(frame, estimator, image, K)
        depth = None if self.read_depth is None else self.read_depth(K)
        image, K, depth = prepare_image(image, K, None, depth, self.cropped)
        starts, _ = estimator.start_detections(image, K, self.distances, self.roi)
        return DetectedFrame(frame, estimator, image, K, depth, starts)

    def refine(self, detected: DetectedFrame) -> PoseResult:
        """Refine the detections or, with a tracker, track the parts."""
        frame, estimator, image, K, depth, starts = detected
        identities = None
        if self.tracker is None:
            detections, weaker = estimator.split(estimator.candidates_from(starts, image, K, depth))
        else:
            self.tracker.estimator = estimator
            tracks, weaker = self.tracker.track(image, K, self.cropped), self.tracker.weaker
            detections = [track.detection for track in tracks]
            identities = [track.identity for track in tracks]
        source, threshold = (frame.name, frame.number, frame.time), estimator.min_score
        speed = estimator.spent_ms
        return PoseResult(
            image, K, detections, speed, *source, identities, self.shapes, weaker, threshold
        )


def _overlapped(
    frame_estimator: FrameEstimator, frames: Iterator[CameraFrame], max_age_s: float | None
) -> Iterator[PoseResult]:
    """Yield the poses in frames, while a thread detects the parts in the next frame.

    If the caller keeps a result for longer than ``max_age_s``, the next frame of a camera is too
    old. It is dropped in favour of the newest frame.
    """

    def detect_next() -> DetectedFrame | None:
        frame = next(frames, None)
        return None if frame is None else frame_estimator.detect(frame)

    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="detect") as thread:
        following = thread.submit(detect_next)
        while (detected := following.result()) is not None:
            following = thread.submit(detect_next)
            result = frame_estimator.refine(detected)
            yielded = time.monotonic()
            yield result
            if max_age_s is not None and time.monotonic() - yielded > max_age_s:
                following.result()
                following = thread.submit(detect_next)
