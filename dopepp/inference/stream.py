"""Estimation of poses in every frame of an image file, video, camera or recording."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict, Unpack

from dopepp.core.errors import UserError
from dopepp.core.validation import Range, check
from dopepp.geometry.camera import CameraMatrix
from dopepp.geometry.camera_file import Camera, Crop
from dopepp.geometry.camera_formats import Size
from dopepp.inference.frames import CameraFrame, SourceLike, open_sources
from dopepp.inference.frames.source import Lens, choose_camera
from dopepp.inference.network_input import Distances, Region
from dopepp.inference.pose_result import PoseResult, elapsed_by_step, make_shape
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
    for opened in open_sources([source], options.get("topic")):
        lens = Lens(choose_camera(K, camera, opened), options.get("K_size"), options.get("crop"))
        if options.get("depth") is not None and opened.count != 1:
            problem = f"--depth with {opened.count or 'many'} images"
            fix = "pass only the image that the depth belongs to"
            raise UserError(problem, "one image", fix)
        tracker = PoseTracker(estimator) if options.get("track") else None
        for frame in opened.frames(stride):
            yield replace(_process(estimator, tracker, frame, lens, options), shapes=shapes)


def _process(
    estimator: PoseEstimator,
    tracker: PoseTracker | None,
    frame: CameraFrame,
    lens: Lens,
    options: StreamOptions,
) -> PoseResult:
    """Detect the parts in one frame or, with a tracker, track them.

    Args:
        estimator: Estimator with the minimum score of the options.
        tracker: Tracker of the source; None without tracking.
        frame: Frame of the source.
        lens: Camera of the source.
        options: Options of :func:`stream`.
    """
    before, start = dict(estimator.spent_ms), time.perf_counter()
    image, K = lens.undistort(frame.image)
    estimator.spent_ms["pre"] += 1000 * (time.perf_counter() - start)
    cropped, identities = lens.crop is not None, None
    if tracker is None:
        path, scale = options.get("depth"), options.get("depth_scale", 0.001)
        depth = None if path is None else lens.read_depth(path, scale, K)
        distances, roi = options.get("distances"), options.get("roi")
        candidates = estimator.candidates(image, K, None, depth, distances, roi, cropped)
        detections, weaker = estimator.split(candidates)
    else:
        tracks, weaker = tracker.track(image, K, cropped), tracker.weaker
        detections = [track.detection for track in tracks]
        identities = [track.identity for track in tracks]
    return PoseResult(
        image,
        K,
        detections,
        elapsed_by_step(before, estimator.spent_ms),
        frame.name,
        frame.number,
        frame.time,
        identities,
        weaker=weaker,
        min_score=estimator.min_score,
    )
