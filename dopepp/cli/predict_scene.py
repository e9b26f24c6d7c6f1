"""``dopepp predict --views``: poses in a world frame from images of several posed cameras."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import typer

from dopepp.core.errors import UserError

if TYPE_CHECKING:
    from dopepp.drawing.pictures import RGBImage
    from dopepp.geometry.camera import Transform
    from dopepp.geometry.camera_file import Camera
    from dopepp.inference.estimator import PoseEstimator
    from dopepp.inference.frames import CameraFrame, FrameSource
    from dopepp.inference.input_image import Distances
    from dopepp.inference.several_views.view_files import CameraPoses
    from dopepp.inference.several_views.views_result import ViewsResult


def predict_scene(
    estimator: PoseEstimator,
    sources: Sequence[FrameSource],
    views: Path,
    camera: Camera | None,
    distances: Distances | None,
    save: Path | None,
    json_file: Path | None,
) -> None:
    """Estimate the poses of parts from all images of a static scene; print and write the poses.

    The estimator refines by region. ``camera`` is that of images for which ``views``, the file of
    the camera poses, names no camera file.

    Raises:
        UserError: There are fewer than two images, a source is not a still image, or an image
            has no pose or no camera.
        RunError: A file cannot be written.
    """
    from dopepp.cli.outputs import disk_errors
    from dopepp.core.files import write_file
    from dopepp.inference.several_views.view_files import read_camera_poses

    poses = read_camera_poses(views)
    is_video = any(source.rate is not None for source in sources)  # a camera never ends
    frames = [] if is_video else [frame for source in sources for frame in source.frames()]
    if len(frames) < 2:
        images = f"{len(frames)} image{'s' * (len(frames) != 1)}"
        problem = f"--views with {'a video, a recording or a camera' if is_video else images}"
        raise UserError(problem, "two images or more", "pass the images of one static scene")
    given = _posed(frames, poses, camera)
    result = estimator.predict_views(
        *given[:3], distances=distances, camera_error=poses.error, names=given.names
    )
    _show(result)
    content = f"{result.to_json()}\n".encode()
    for path, write in (save, result.save), (json_file, lambda path: write_file(path, content)):
        if path is not None:
            with disk_errors(path):
                write(path)


def track_scene(
    estimator: PoseEstimator,
    sources: Sequence[FrameSource],
    views: Path,
    camera: Camera | None,
    save: Path | None,
    json_file: Path | None,
) -> None:
    """Track the parts through synchronised sources; print and write the poses of each set.

    The arguments are those of :func:`predict_scene`. The n-th frames of all sources are a set.

    Raises:
        UserError: There are fewer than two sources, a source is a camera, the numbers of frames
            differ, or an image has no pose or no camera.
    """
    from dopepp.cli.outputs import JsonLines, Outputs, OverlayFolder
    from dopepp.inference.several_views.view_files import read_camera_poses
    from dopepp.inference.several_views.views_tracker import ViewsTracker

    counts = [source.count for source in sources]
    problem = " and ".join(f"{source.name} with {source.count} frames" for source in sources)
    differ = UserError(
        f"--views with --track, and {problem}",
        "two or more folders or videos with equal numbers of frames",
        "pass a folder or a video of each camera, e.g. left/ right/",
    )
    if len(sources) < 2 or None in counts or len(set(counts)) > 1:
        raise differ
    poses, tracker = read_camera_poses(views), ViewsTracker(estimator)
    lines = [] if json_file is None else [(json_file, JsonLines(json_file))]
    with ExitStack() as files:
        written, drawn = files.enter_context(Outputs(lines)), []
        written.begin(sources[0])
        for number, source in enumerate(sources if save is not None else ()):
            assert save is not None
            stem = source.stem if source.rate else Path(source.name).absolute().parent.name
            folder = save / f"{number}_{stem}"
            overlays = OverlayFolder(folder, sources)
            drawn.append(files.enter_context(Outputs([(folder, overlays)])))
            drawn[-1].begin(source)
        for number, frames in enumerate(zip_longest(*(source.frames() for source in sources)), 1):
            if None in frames:  # a video whose header states more frames
                raise differ
            given = _posed(frames, poses, camera)
            result = tracker.track(*given[:3], camera_error=poses.error, names=given.names)
            _show(result, f"{number}/{counts[0]}: ")
            written.write(result)
            for output, view, frame in zip(drawn, result.views, frames, strict=False):
                output.write(replace(view, number=frame.number, time=frame.time))


def _show(result: ViewsResult, progress: str = "") -> None:
    """Print a line of JSON for each part, and findings and summary on stderr."""
    for record in result.records():
        typer.echo(json.dumps(record, ensure_ascii=False))
    for line in (*result.findings, f"{progress}{result.summary}"):
        typer.echo(line, err=True)


class _PosedFrames(NamedTuple):
    """Images of one moment with their cameras."""

    images: Sequence[RGBImage]
    cameras: Sequence[Camera]
    T_world_cam: Sequence[Transform]
    names: Sequence[str]


def _posed(
    frames: Sequence[CameraFrame], poses: CameraPoses, camera: Camera | None
) -> _PosedFrames:
    """Return frames with their cameras; ``camera`` is used where the file names none."""
    paths = [Path(frame.name) for frame in frames]
    names = [path.name for path in paths]
    if len(set(names)) < len(names):  # images of one moment, in a folder for each camera
        names = ["/".join(path.parts[-2:]) for path in paths]
    shots = [poses.of(path) for path in paths]
    cameras: list[Camera] = []
    for frame, shot in zip(frames, shots, strict=True):
        lens = shot.camera or camera
        if lens is None:
            fix = f"add `camera: FILE` to {poses.source}, or pass --camera or --K"
            raise UserError(f"no camera of {frame.name}", "a camera for every image", fix)
        cameras.append(lens)
    images, T_world_cam = [frame.image for frame in frames], [shot.T_world_cam for shot in shots]
    return _PosedFrames(images, cameras, T_world_cam, names)
