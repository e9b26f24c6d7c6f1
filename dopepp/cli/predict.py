"""``dopepp predict``: estimate poses in images, videos and camera streams."""

from __future__ import annotations

import gc
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from dopepp.cli.common import (
    CameraFile,
    Conf,
    Crop,
    Device,
    Distances,
    Intrinsics,
    KSize,
    MaxMs,
    Meshes,
    Model,
    ScaleError,
    Tilt,
    Track,
    Unit,
    WorkingDistance,
    load_estimator,
    resumable,
)
from dopepp.core.errors import UserError

if TYPE_CHECKING:
    from dopepp.cli.outputs import Output, Outputs
    from dopepp.geometry.camera_file import Camera
    from dopepp.inference.estimator import PoseEstimator
    from dopepp.inference.frames import FrameSource
    from dopepp.inference.pose_result import PoseResult
    from dopepp.inference.stream import StreamOptions
    from dopepp.parts.part import Part


def predict(
    model: Model,
    source: Annotated[
        list[str],
        Argument(
            help="Images, folders, 'frames/*.png', videos, ROS bags (.bag, .mcap, a folder), "
            "a camera number, or an rtsp:// or http:// stream."
        ),
    ],
    intrinsics: Intrinsics = None,
    camera: CameraFile = None,
    K_size: KSize = None,
    crop: Crop = None,
    topic: Annotated[str | None, Option(help="Image topic of a ROS bag with several.")] = None,
    distance: Distances = None,
    roi: Annotated[
        tuple[int, int, int, int] | None, Option(help="Region of interest: x y width height.")
    ] = None,
    conf: Conf = None,
    stride: Annotated[int, Option(help="Use every n-th frame only.")] = 1,
    track: Track = False,
    refine: Annotated[
        str | None, Option(help="region, depth (with --depth), or region,depth.")
    ] = None,
    max_ms: MaxMs = None,
    scale_error: ScaleError = None,
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
    parts: Meshes = None,
    unit: Unit = None,
    working_distance: WorkingDistance = None,
    tilt: Tilt = None,
    device: Device = "cpu",
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
    with resumable("the written files are complete"):
        from dopepp.cli.outputs import Outputs
        from dopepp.cli.predict_scene import predict_scene, track_scene
        from dopepp.geometry.camera import camera_matrix
        from dopepp.inference.frames import open_sources
        from dopepp.inference.frames.source import choose_camera, given_camera

        terms = () if refine is None else tuple(refine.split(","))
        if ("depth" in terms) != (depth is not None):
            raise UserError(
                "--depth without --refine depth" if depth else "--refine depth without --depth",
                "both options or neither",
                "add --refine depth" if depth else "add --depth FILE",
            )
        excluded: dict[str, object] = {"--verify": verify, "--depth": depth, "--roi": roi}
        if track:
            _exclude("--track", {**excluded, "--distance": distance})
        if views is not None:
            excluded |= {"--csv": csv, "--rerun": rerun, "--show": show}
            excluded |= {"--crop": crop, "--K-size": K_size, "--topic": topic}
            _exclude("--views", {**excluded, "--stride": stride != 1})
        terms = ("region",) if track or views else terms
        outputs = _file_outputs(save, json_file, csv, stride)
        words = [[word] for word in source] if track and views else [source]  # one for each camera
        sources = [opened for group in words for opened in open_sources(group, topic)]
        K = None if intrinsics is None else camera_matrix(*intrinsics)
        cameras = [] if views else [choose_camera(K, camera, opened) for opened in sources]

        from dopepp.parts.catalogue import with_meshes

        estimator = load_estimator(
            model, device, unit, working_distance, tilt, parts, max_ms, scale_error
        ).reporting(conf)
        known_parts = estimator.parts
        if verify or "region" in terms:
            known_parts = with_meshes(known_parts, parts or (), unit)
        if terms:
            estimator = estimator.refining(terms, known_parts)
        gc.enable()
        if views is not None:
            lens = given_camera(K, camera)
            if track:
                track_scene(estimator, sources, views, lens, save, json_file)
                return
            predict_scene(estimator, sources, views, lens, distance, save, json_file)
            return
        if rerun is not None or show:
            from dopepp.inference.viewer import Viewer

            recordings = [rerun] * (rerun is not None) + [None] * show
            outputs += [(path or Path("viewer"), Viewer(estimator, path)) for path in recordings]
        options: StreamOptions = {
            "stride": stride,
            "track": track,
            "distances": distance,
            "roi": roi,
            "K_size": K_size,
            "crop": crop,
            "depth": depth,
            "depth_scale": depth_scale,
        }
        session = _Session(estimator, options, known_parts if verify else None)
        with Outputs(outputs) as written:
            for opened, its_camera in zip(sources, cameras, strict=True):
                session.run(opened, its_camera, written)


def _exclude(option: str, others: dict[str, object]) -> None:
    """Reject ``others`` (values by option name, false if not set), which ``option`` excludes.

    Raises:
        UserError: One of the other options is set.
    """
    if given := ", ".join(name for name, value in others.items() if value):
        fix = f"leave out {option}, or {given}"
        raise UserError(f"{option} with {given}", f"{option} without these options", fix)


def _file_outputs(
    save: Path | None, json_file: Path | None, csv: Path | None, stride: int
) -> list[tuple[Path, Output[PoseResult]]]:
    """Return (path, output) pairs of the requested files; ``stride`` is the option's value."""
    from dopepp.cli.outputs import BopCsv, JsonLines, OverlayFolder

    requests: tuple[tuple[Path | None, Callable[[Path], Output[PoseResult]]], ...] = (
        (save, lambda folder: OverlayFolder(folder, stride)),
        (json_file, JsonLines),
        (csv, BopCsv),
    )
    return [(path, make(path)) for path, make in requests if path is not None]


def _floor(score: float) -> float:
    return math.floor(1000 * score) / 1000


class _Session:
    """Estimator of the poses in the images of sources, which it also prints.

    Args:
        estimator: Estimator of the poses in a single image.
        options: Options of :func:`dopepp.inference.stream.stream` for all sources.
        verified: Parts whose contours are compared with the image; None for no comparison.
    """

    def __init__(
        self, estimator: PoseEstimator, options: StreamOptions, verified: Sequence[Part] | None
    ) -> None:
        self._estimator, self._options, self._verified = estimator, options, verified

    def run(self, source: FrameSource, camera: Camera, outputs: Outputs[PoseResult]) -> None:
        """Print the poses in each image of a source, and pass them to the outputs."""
        from dopepp.inference.pose_result import format_speed

        total = source.count and math.ceil(source.count / self._options["stride"])
        outputs.begin(source)
        results = self._estimator.stream(source, camera=camera, **self._options)
        for number, result in enumerate(results, 1):
            reason = ""
            if not result.detections and source.rate is None and not self._options["track"]:
                result, reason = self._search_again(result, camera)
            for record in self._records(result):
                typer.echo(json.dumps(record, ensure_ascii=False))
            summary = result.summary
            if result.weaker:
                summary += f" (--conf {_floor(min(result.weaker)):g} shows them)"
            summary += f": {reason}" if reason else ""
            progress = f"{number}/{total or '…'} {Path(result.name).name}: " if total != 1 else ""
            typer.echo(f"{progress}{summary}; speed: {format_speed(result.speed)}", err=True)
            outputs.write(result)

    def _search_again(self, result: PoseResult, camera: Camera) -> tuple[PoseResult, str]:
        """Search for parts at all distances in an image without detections.

        Returns:
            The new result, and why it has no detections (an empty string if it has any).
        """
        if not self._estimator.has_network:
            return result, "no pose at these distances passes the verification"
        from dopepp.inference.frames.source import Lens
        from dopepp.recovery.recover import format_reasons

        options, image, K = self._options, result.image, result.K
        depth = options["depth"]
        metres = (
            None if depth is None else Lens(camera).read_depth(depth, options["depth_scale"], K)
        )
        region = (options["roi"], options["crop"] is not None)
        if options["distances"] is None:
            candidates = self._estimator.candidates(image, K, None, metres, "any", *region)
            detections, weaker = self._estimator.split(candidates)
            if detections:
                text = "nothing detected at the trained sizes; searched at all sizes"
                typer.echo(text, err=True)
                return replace(result, detections=detections, weaker=weaker), ""
        reason = self._estimator.explain(image, K, metres, options["distances"], *region)
        return result, format_reasons(reason)

    def _records(self, result: PoseResult) -> list[dict[str, object]]:
        """Return a JSON object for each detection.

        With ``--verify``, its ``agreement`` in [0, 1] states how well the part's outline and
        creases agree with the image.
        """
        records = result.records()
        if self._verified is None:
            return records
        from dopepp.virtual.agreement import agreement
        from dopepp.virtual.surface import make_surface

        meshes = {part.name: make_surface(part.mesh) for part in self._verified if part.mesh}
        for record, detection in zip(records, result.detections, strict=True):
            surface = meshes[detection.object]
            record["agreement"] = agreement(result.image, result.K, detection.T_cam_obj, surface)
        return records
