"""``dopepp predict --views``: poses in a world frame from several images of a static scene."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from dopepp.core.errors import UserError

if TYPE_CHECKING:
    from dopepp.geometry.camera_file import Camera
    from dopepp.inference.estimator import PoseEstimator
    from dopepp.inference.frames import FrameSource
    from dopepp.inference.network_input import Distances


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

    Args:
        estimator: Estimator that refines by region.
        sources: Images of the scene.
        views: File of the camera poses.
        camera: Intrinsics of the images for which ``views`` names no camera file.
        distances: Nearest and farthest depth of the parts, metres, or ``any``.
        save: Folder for images with drawn poses; None writes none.
        json_file: File for a line of JSON; None writes none.

    Raises:
        UserError: There are fewer than two images, a source is not a still image, or an image
            has no pose or no camera.
    """
    from dopepp.core.files import write_file
    from dopepp.inference.several_views.view_files import read_camera_poses

    poses = read_camera_poses(views)
    frames = [frame for source in sources for frame in source.frames()]
    if len(frames) < 2 or any(source.rate is not None for source in sources):
        problem = f"--views with {len(frames)} image{'s' * (len(frames) != 1)}"
        if any(source.rate is not None for source in sources):
            problem = "--views with a video, a recording or a camera"
        raise UserError(problem, "two images or more", "pass the images of one static scene")
    paths = [Path(frame.name) for frame in frames]
    names = [path.name for path in paths]
    if len(set(names)) < len(names):  # images of one moment, in a folder for each camera
        names = ["/".join(path.parts[-2:]) for path in paths]
    shots = [poses.of(path) for path in paths]
    cameras: list[Camera] = []
    for frame, shot in zip(frames, shots, strict=True):
        lens = shot.camera or camera
        if lens is None:
            fix = f"add `camera: FILE` to {views}, or pass --camera or --K"
            raise UserError(f"no camera of {frame.name}", "a camera for every image", fix)
        cameras.append(lens)
    result = estimator.predict_views(
        [frame.image for frame in frames],
        cameras,
        [shot.T_world_cam for shot in shots],
        distances=distances,
        camera_error=poses.error,
        names=names,
    )
    for record in result.records():
        typer.echo(json.dumps(record, ensure_ascii=False))
    for finding in result.findings:
        typer.echo(finding, err=True)
    typer.echo(result.summary, err=True)
    if save is not None:
        result.save(save)
    if json_file is not None:
        write_file(json_file, f"{result.to_json()}\n".encode())
