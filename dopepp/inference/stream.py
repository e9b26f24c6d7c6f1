"""From a source of pictures to a stream of results: one way for files, videos and cameras."""

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
from dopepp.inference.overlay import make_shape
from dopepp.inference.picture import Distances, Region
from dopepp.inference.results import PoseResult, spent_between
from dopepp.inference.sources import Frame, SourceLike, open_sources
from dopepp.inference.sources.source import Lens, one_camera
from dopepp.inference.tracker import PoseTracker

if TYPE_CHECKING:
    from dopepp.inference.estimator import PoseEstimator


class StreamOptions(TypedDict, total=False):
    """How a source is looked at."""

    stride: int  # every so manieth picture only
    # Follow the parts from picture to picture, with an estimator that refines by region
    track: bool
    least_score: float  # leave out detections of lower scores, in [0, 1]
    distances: Distances | None  # as predict takes it; not with `track`
    roi: Region | None  # idem
    K_size: Size | None  # (width, height) that K belongs to, where the pictures were resized
    # (x, y, width, height) of the pictures in the calibrated one, where they were cut out
    crop: Crop | None
    topic: str | None  # of a bag's pictures, where it has several
    # Of the one picture of a source: a 16-bit PNG, 0 where unknown; not with `track`
    depth: Path | None
    depth_scale: float  # metres per unit of it


def stream(
    estimator: PoseEstimator,
    source: SourceLike,
    K: CameraMatrix | None = None,
    camera: Camera | Path | str | None = None,
    **options: Unpack[StreamOptions],
) -> Iterator[PoseResult]:
    """Yield what an estimator finds on each picture of a source, as it is found.

    A camera's or a stream's pictures that came while the estimator was busy are left out: each
    result is of the newest picture there was. Files are read to the end, cameras for ever.

    Args:
        estimator: Finds the parts.
        source: A path, a glob pattern, a camera's number, a URL, or an open source.
        K: Camera matrix of pictures without distortion, pixels.
        camera: In its place, a camera or its file; of a bag, its own where neither is given.
        options: See :class:`StreamOptions`.

    Raises:
        UserError: The source cannot be read, or K cannot belong to its pictures.
        RunError: A camera stopped delivering.
    """
    _check(options)
    stride = check("stride", options.get("stride", 1), int, Range(1, 1_000_000))
    least = check("least_score", options.get("least_score", 0.0), float, Range(0, 1))
    shapes = {part.name: make_shape(part) for part in estimator.solid_parts}
    for one in open_sources([source], options.get("topic")):
        lens = Lens(one_camera(K, camera, one), options.get("K_size"), options.get("crop"))
        if options.get("depth") is not None and one.count != 1:
            got = f"--depth with {one.count or 'many'} pictures"
            raise UserError(got, "one picture, which it belongs to", "pass that picture alone")
        look = _Look(estimator, lens, options)
        for frame in one.frames(stride):
            result = look.at(frame)
            chosen = [number for number, d in enumerate(result.detections) if d.score >= least]
            ids = result.identities
            yield replace(
                result,
                detections=[result.detections[number] for number in chosen],
                identities=None if ids is None else [ids[number] for number in chosen],
                shapes=shapes,
            )


def _check(options: StreamOptions) -> None:
    """Refuse what does not go with following parts."""
    wrong = [one for one in ("distances", "roi", "depth") if options.get(one) is not None]
    if options.get("track") and wrong:
        raise UserError(
            "--track with --distance, --roi or --depth", "--track alone", "leave it out"
        )


class _Look:
    """How an estimator looks at the frames of one source."""

    def __init__(self, estimator: PoseEstimator, lens: Lens, options: StreamOptions) -> None:
        self._estimator, self._lens = estimator, lens
        self._options = options
        self._tracker = PoseTracker(estimator) if options.get("track") else None

    def at(self, frame: Frame) -> PoseResult:
        """Return what there is on one frame."""
        before, start = dict(self._estimator.spent_ms), time.perf_counter()
        image, K = self._lens.seen(frame.image)
        self._estimator.spent_ms["pre"] += 1000 * (time.perf_counter() - start)
        cropped, identities = self._lens.crop is not None, None
        if self._tracker is None:
            own = self._options
            path, scale = own.get("depth"), own.get("depth_scale", 0.001)
            depth = None if path is None else self._lens.depth(path, scale, K)
            found = self._estimator.predict(
                image, K, None, depth, own.get("distances"), own.get("roi"), cropped
            )
        else:
            tracks = self._tracker.track(image, K, cropped)
            found, identities = [t.detection for t in tracks], [t.identity for t in tracks]
        speed = spent_between(before, self._estimator.spent_ms)
        return PoseResult(image, K, found, speed, frame.name, frame.number, frame.time, identities)
