"""``dopepp predict``: estimate poses in images, videos and camera streams."""

from __future__ import annotations

import gc
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from dopepp.cli import options
from dopepp.core.errors import UserError, interruptible

if TYPE_CHECKING:
    from dopepp.cli.outputs import Outputs
    from dopepp.geometry.camera_file import Camera
    from dopepp.inference.estimator import PoseEstimator
    from dopepp.inference.frames import FrameSource
    from dopepp.inference.pose_result import PoseResult
    from dopepp.inference.stream import StreamOptions
    from dopepp.parts.part import Part
    from dopepp.recovery.detection import Detection

    Verification = Callable[[PoseResult, Detection], float]


def predict(
    model: options.Model,
    source: Annotated[
        list[str],
        Argument(
            help="Images, folders, 'frames/*.png', videos, ROS bags (.bag, .mcap, a folder), "
            "a camera number, or an rtsp:// or http:// stream."
        ),
    ],
    intrinsics: options.Intrinsics = None,
    camera: options.CameraFile = None,
    K_size: options.KSize = None,
    crop: options.Crop = None,
    topic: Annotated[str | None, Option(help="Image topic, if a ROS bag has several.")] = None,
    distance: options.Distances = None,
    roi: Annotated[
        tuple[int, int, int, int] | None, Option(help="Region of interest: x y width height.")
    ] = None,
    conf: options.Conf = None,
    stride: Annotated[int, Option(min=1, help="Use every n-th frame only.")] = 1,
    track: options.Track = False,
    refine: Annotated[
        str | None, Option(help="region, depth (with --depth), or region,depth.")
    ] = None,
    max_ms: options.MaxMs = None,
    scale_error: options.ScaleError = None,
    depth: Annotated[
        Path | None, Option(help="Depth aligned with the image: 16-bit PNG, 0 = unknown.")
    ] = None,
    depth_scale: Annotated[float, Option(help="Metres per unit of --depth.")] = 0.001,
    views: Annotated[
        Path | None,
        Option(
            help="Camera poses, if all images show one static scene (with --track: the n-th image "
            "of each source): views.yaml, BOP's scene_camera.json or COLMAP's images.txt."
        ),
    ] = None,
    verify: Annotated[
        bool, Option("--verify", help="Compare rendered parts with the image.")
    ] = False,
    parts: options.Meshes = None,
    unit: options.Unit = None,
    working_distance: options.WorkingDistance = None,
    tilt: options.Tilt = None,
    device: options.Device = "cpu",
    save: Annotated[Path | None, Option(help="Folder for drawn images and videos.")] = None,
    json_file: Annotated[Path | None, Option("--json", help="File with a line per image.")] = None,
    csv: Annotated[Path | None, Option(help="Poses in the format of the BOP challenge.")] = None,
    rerun: Annotated[Path | None, Option(help="Recording for the Rerun viewer, .rrd")] = None,
    show: Annotated[bool, Option("--show", help="Open the Rerun viewer.")] = False,
) -> None:
    """Estimate poses in images and print one line of JSON per detection.

    Progress goes to stderr, with the reason if nothing was detected. Exit codes: 0 success; 1
    stopped (the camera stream ended, the disk is full); 2 wrong input; 130 or 143 interrupted.
    """
    gc.disable()  # all imported objects stay alive; collecting them would slow down the start
    with interruptible("the written files are complete"):
        from dopepp.cli.predict_scene import predict_scene, track_scene
        from dopepp.drawing.pictures import photo_size
        from dopepp.geometry.camera import camera_matrix
        from dopepp.inference.frames import open_sources
        from dopepp.inference.frames.source import choose_camera, given_camera
        from dopepp.parts.mesh.read import READERS

        if meshes := [word for word in source if Path(word).suffix.lower() in READERS]:
            fix = "run the command for each part, or train a network for all parts"
            raise UserError(f"the mesh {meshes[0]} as a source", "one mesh, as the model", fix)
        excluded: dict[str, object] = {"--verify": verify, "--depth": depth, "--roi": roi}
        if track:
            _exclude("--track", {**excluded, "--distance": distance})
        if views is not None:
            excluded |= {"--csv": csv, "--rerun": rerun, "--show": show}
            excluded |= {"--crop": crop, "--K-size": K_size, "--topic": topic}
            _exclude("--views", {**excluded, "--stride": stride != 1})
        terms = _terms(refine, depth, "--track" if track else "--views" if views else None)
        words = [[word] for word in source] if track and views else [source]  # one for each camera
        sources = [
            opened for group in words for opened in open_sources(group, topic, csv is not None)
        ]
        outputs = _files(sources, stride, save, json_file, csv)
        K = None if intrinsics is None else camera_matrix(*intrinsics)
        cameras = [] if views else [choose_camera(K, camera, opened) for opened in sources]
        for opened, its_camera in zip(sources, cameras, strict=False):
            if opened.rate is None:  # refuse K of another image size before the model is loaded
                its_camera.for_picture(photo_size(Path(opened.name)), K_size, crop)

        from dopepp.parts.catalogue import with_meshes

        estimator = options.load_estimator(
            model, device, unit, working_distance, tilt, parts, max_ms, scale_error
        ).reporting(conf)
        known_parts = estimator.parts
        if parts or verify or "region" in terms:
            known_parts = with_meshes(known_parts, parts or (), unit)
        if parts or terms:
            estimator = estimator.refining(terms or None, known_parts)
        gc.enable()
        if views is not None:
            lens = given_camera(K, camera)
            if track:
                track_scene(estimator, sources, views, lens, save, json_file)
            else:
                predict_scene(estimator, sources, views, lens, distance, save, json_file)
            return
        if rerun is not None or show:
            from dopepp.inference.viewer import Viewer

            recordings = [rerun] * (rerun is not None) + [None] * show
            outputs += [(path or Path("viewer"), Viewer(estimator, path)) for path in recordings]
        from dopepp.cli.outputs import Outputs

        verification = _verification(known_parts) if verify else None
        stream_options: StreamOptions = {
            "stride": stride,
            "track": track,
            "distances": distance,
            "roi": roi,
            "K_size": K_size,
            "crop": crop,
            "depth": depth,
            "depth_scale": depth_scale,
        }
        with Outputs(outputs) as written:
            for opened, its_camera in zip(sources, cameras, strict=True):
                written.begin(opened)
                _predict_source(
                    estimator, opened, its_camera, stream_options, verification, written
                )


def _terms(refine: str | None, depth: Path | None, scene_option: str | None) -> tuple[str, ...]:
    """Return the terms of ``--refine``; reject terms that the other options exclude.

    ``scene_option`` is ``--track`` or ``--views`` if one of them is given: it needs ``region``.
    """
    terms = () if refine is None else tuple(refine.split(","))
    if ("depth" in terms) != (depth is not None):
        raise UserError(
            "--depth without --refine depth" if depth else "--refine depth without --depth",
            "both options or neither",
            "add --refine depth" if depth else "add --depth FILE",
        )
    if scene_option is None:
        return terms
    if terms not in ((), ("region",)):
        allowed = f"{scene_option} with --refine region, its default"
        raise UserError(f"{scene_option} with --refine {refine}", allowed, "leave out --refine")
    return ("region",)


def _files(
    sources: Sequence[FrameSource],
    stride: int,
    save: Path | None,
    json_file: Path | None,
    csv: Path | None,
) -> list[tuple[Path, Any]]:
    """Return the outputs to files that are asked for, with their paths."""
    from dopepp.cli.outputs import BopCsv, JsonLines, OverlayFolder

    outputs: list[tuple[Path, Any]] = []
    if save is not None:
        outputs.append((save, OverlayFolder(save, sources, stride)))
    if json_file is not None:
        outputs.append((json_file, JsonLines(json_file)))
    if csv is not None:
        outputs.append((csv, BopCsv(csv)))
    return outputs


def _exclude(option: str, others: dict[str, object]) -> None:
    """Reject ``others`` (values by option name, false if not set), which ``option`` excludes."""
    if given := ", ".join(name for name, value in others.items() if value):
        fix = f"leave out {option}, or {given}"
        raise UserError(f"{option} with {given}", f"{option} without these options", fix)


def _predict_source(
    estimator: PoseEstimator,
    source: FrameSource,
    camera: Camera,
    options: StreamOptions,
    verification: Verification | None,
    outputs: Outputs,
) -> None:
    """Print the poses in each image of a source, and pass them to the outputs."""
    from dopepp.inference.pose_result import format_speed

    total = source.count and math.ceil(source.count / options["stride"])
    results = estimator.stream(source, camera=camera, **options)
    for number, result in enumerate(results, 1):
        reason = ""
        if not result.detections and source.rate is None and not options["track"]:
            from dopepp.inference.network_estimator import search_again

            result, reason = search_again(estimator, camera, result, **options)
            if result.detections:
                typer.echo("nothing detected at the trained sizes; searched at all sizes", err=True)
        if verification is not None:
            agreements = [verification(result, detection) for detection in result.detections]
            result = replace(result, agreements=agreements)
        for record in result.records():
            typer.echo(json.dumps(record, ensure_ascii=False))
        summary = result.summary
        if result.weaker:
            shown_by = math.floor(1000 * min(result.weaker)) / 1000
            summary += f" (--conf {shown_by:g} shows them)"
        summary += f": {reason}" if reason else ""
        progress = f"{number}/{total or '…'} {Path(result.name).name}: " if total != 1 else ""
        typer.echo(f"{progress}{summary}; speed: {format_speed(result.speed)}", err=True)
        outputs.write(result)


def _verification(parts: Sequence[Part]) -> Verification:
    """Return how well outline and creases of a detected part agree with the image, 0 to 1."""
    from dopepp.virtual.agreement import agreement
    from dopepp.virtual.surface import make_surface

    surfaces = {part.name: make_surface(part.mesh) for part in parts if part.mesh}

    def verify(result: PoseResult, detection: Detection) -> float:
        surface = surfaces[detection.object]
        return agreement(result.image, result.K, detection.T_cam_obj, surface)

    return verify
