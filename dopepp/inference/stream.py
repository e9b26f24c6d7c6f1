"""Estimation of poses in every frame of an image file, video, camera or recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict, Unpack

from dopepp.core.errors import UserError
from dopepp.core.validation import Range, check
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import CameraMatrix
from dopepp.geometry.camera_file import Camera, Crop
from dopepp.geometry.camera_formats import Size
from dopepp.inference.frames import CameraFrame, SourceLike, open_sources
from dopepp.inference.frames.source import Lens, choose_camera
from dopepp.inference.network_input import Depth, Distances, Region
from dopepp.inference.pose_result import PoseResult, Shape, elapsed_by_step, make_shape
from dopepp.inference.tracker import PoseTracker

if TYPE_CHECKING:
    from dopepp.inference.estimator import PoseEstimator


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
        given, cropped = (estimator, tracker, shapes), lens.crop is not None
        for frame in opened.frames(stride):
            yield estimate_frame(*given, frame, lens.undistort, cropped, read_depth, distances, roi)


def estimate_frame(
    estimator: PoseEstimator,
    tracker: PoseTracker | None,
    shapes: Mapping[str, Shape],
    frame: CameraFrame,
    undistort: Callable[[RGBImage], tuple[RGBImage, CameraMatrix]],
    cropped: bool,
    read_depth: Callable[[CameraMatrix], Depth] | None = None,
    distances: Distances | None = None,
    roi: Region | None = None,
) -> PoseResult:
    """Detect the parts in one frame or, with a tracker, track them.

    Args:
        estimator: Estimator with the minimum score of the result.
        tracker: Tracker of the source; None without tracking.
        shapes: Shape of each part, for drawing.
        frame: Frame of the source.
        undistort: Returns an image without lens distortion, and its K.
        cropped: Whether the image may be a crop; see :meth:`PoseEstimator.predict`.
        read_depth: Returns the depth image for K; not with a tracker, like ``distances`` and
            ``roi`` of :meth:`PoseEstimator.predict`.
        distances: Expected depths of the parts.
        roi: Region to process.
    """
    before, identities = dict(estimator.spent_ms), None
    with estimator.timed("pre"):
        image, K = undistort(frame.image)
    if tracker is None:
        depth = None if read_depth is None else read_depth(K)
        candidates = estimator.candidates(image, K, None, depth, distances, roi, cropped)
        detections, weaker = estimator.split(candidates)
    else:
        tracker.estimator = estimator
        tracks, weaker = tracker.track(image, K, cropped), tracker.weaker
        detections = [track.detection for track in tracks]
        identities = [track.identity for track in tracks]
    speed = elapsed_by_step(before, estimator.spent_ms)
    source, threshold = (frame.name, frame.number, frame.time), estimator.min_score
    return PoseResult(image, K, detections, speed, *source, identities, shapes, weaker, threshold)
