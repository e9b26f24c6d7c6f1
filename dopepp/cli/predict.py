"""``dopepp predict``: the poses on pictures, in videos, and before a camera."""

from __future__ import annotations

import gc
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dopepp.cli.errors import resumable
from dopepp.cli.options import (
    CameraFile,
    Crop,
    Device,
    Distances,
    Intrinsics,
    KSize,
    MaxMs,
    Meshes,
    Track,
    Unit,
)
from dopepp.core.errors import UserError

if TYPE_CHECKING:
    from dopepp.cli.outputs import Output, Outputs
    from dopepp.drawing.pictures import Picture
    from dopepp.geometry.camera import CameraMatrix
    from dopepp.geometry.camera_file import Camera
    from dopepp.inference.estimator import PoseEstimator
    from dopepp.inference.frames import FrameSource
    from dopepp.inference.pose_result import PoseResult
    from dopepp.inference.stream import StreamOptions
    from dopepp.parts.part import Part
    from dopepp.recovery.detection import Detection


def predict(
    model: Annotated[Path, typer.Argument(help="best.ckpt of a run, or a released network")],
    source: Annotated[
        list[str],
        typer.Argument(
            help="pictures, folders, 'frames/*.png', videos, ROS bags (.bag, .mcap, a folder), "
            "a camera's number, an rtsp:// or http:// stream"
        ),
    ],
    intrinsics: Intrinsics = None,
    camera: CameraFile = None,
    K_size: KSize = None,
    crop: Crop = None,
    topic: Annotated[
        str | None, typer.Option(help="of a ROS bag's pictures, where it has several")
    ] = None,
    distance: Distances = None,
    roi: Annotated[
        tuple[int, int, int, int] | None,
        typer.Option(help="x y width height: look at this part of the picture only"),
    ] = None,
    conf: Annotated[float, typer.Option(help="least score of a detection, 0 to 1")] = 0.0,
    stride: Annotated[int, typer.Option(help="use every n-th picture only")] = 1,
    track: Track = False,
    refine: Annotated[
        str | None, typer.Option(help="region: on the picture; depth: with --depth; region,depth")
    ] = None,
    max_ms: MaxMs = None,
    depth: Annotated[
        Path | None, typer.Option(help="16-bit PNG aligned to the picture, 0 where unknown")
    ] = None,
    depth_scale: Annotated[float, typer.Option(help="metres per unit of --depth")] = 0.001,
    verify: Annotated[
        bool, typer.Option("--verify", help="print how well picture and drawn part agree, 0 to 1")
    ] = False,
    parts: Meshes = None,
    unit: Unit = None,
    device: Device = "cpu",
    save: Annotated[
        Path | None, typer.Option(help="folder for pictures and videos with the poses drawn")
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="file with a line of JSON for each picture")
    ] = None,
    csv: Annotated[
        Path | None, typer.Option(help="file of poses in the BOP challenge's format")
    ] = None,
    rerun: Annotated[Path | None, typer.Option(help="recording for the Rerun viewer, .rrd")] = None,
    show: Annotated[bool, typer.Option("--show", help="open the Rerun viewer")] = False,
) -> None:
    """Print the poses on pictures as JSON, a line per detection, and on stderr how it went.

    Where nothing is found on a picture, it is said why. Exit codes: 0 done; 1 stopped (a camera
    delivers no more, the disk is full); 2 wrong input; 130, 143 interrupted.
    """
    gc.disable()  # what imports create stays: searching it takes a fifth of the start
    with resumable("what was written is complete"):
        from dopepp.cli.outputs import Outputs
        from dopepp.geometry.camera import camera_matrix
        from dopepp.inference.frames import open_sources
        from dopepp.inference.frames.source import choose_camera

        terms = () if refine is None else tuple(refine.split(","))
        _check_options(terms, depth, track, verify, distance or roi)
        terms = ("region",) if track else terms
        outputs = _outputs(save, json_file, csv, stride)
        sources = open_sources(source, topic)
        K = None if intrinsics is None else camera_matrix(*intrinsics)
        cameras = [choose_camera(K, camera, one) for one in sources]
        estimator, known = _estimator(model, device, terms, verify, parts, unit, max_ms)
        gc.enable()
        outputs += _viewers(estimator, rerun, show)
        options: StreamOptions = {
            "stride": stride, "track": track, "least_score": conf, "distances": distance,
            "roi": roi, "K_size": K_size, "crop": crop, "depth": depth, "depth_scale": depth_scale,
        }  # fmt: skip
        session = _Session(estimator, options, known if verify else None)
        with Outputs(outputs) as written:
            for one, its_camera in zip(sources, cameras, strict=True):
                session.run(one, its_camera, written)


def _check_options(
    refine: Sequence[str], depth: Path | None, track: bool, verify: bool, where: object
) -> None:
    """Refuse options that do not go together."""
    if ("depth" in refine) != (depth is not None):
        raise UserError(
            "--depth without --refine depth" if depth else "--refine depth without --depth",
            "both or none of them",
            "add --refine depth" if depth else "add --depth FILE",
        )
    if track and (verify or depth is not None or where):
        got = "--track with --verify, --depth, --distance or --roi"
        raise UserError(got, "--track alone", "leave it out")


def _estimator(
    model: Path,
    device: str,
    refine: Sequence[str],
    verify: bool,
    parts: Sequence[str] | None,
    unit: str | None,
    max_ms: float | None,
) -> tuple[PoseEstimator, Sequence[Part]]:
    """Return what is to look at the picture, and its parts, with meshes where these are needed."""
    from dopepp.inference.estimator import PoseEstimator
    from dopepp.parts.catalogue import with_meshes

    estimator = PoseEstimator.load(model, device, max_ms=max_ms)
    known = estimator.parts
    if verify or "region" in refine:
        known = with_meshes(known, parts or (), unit)
    return (estimator.refining(refine, known) if refine else estimator), known


def _agreements(
    picture: Picture, K: CameraMatrix, found: Sequence[Detection], known: Sequence[Part]
) -> list[float]:
    """Return how well the picture agrees with every part, drawn at its pose."""
    from dopepp.virtual.agreement import agreement
    from dopepp.virtual.surface import make_surface

    meshes = {part.name: make_surface(part.mesh) for part in known if part.mesh}
    return [agreement(picture, K, one.T_cam_obj, meshes[one.object]) for one in found]


def _outputs(
    save: Path | None, json_file: Path | None, csv: Path | None, stride: int
) -> list[tuple[Path, Output]]:
    """Return what is to be written; where it cannot be, that is told before the work is done."""
    from dopepp.cli.outputs import BopCsv, JsonLines, Overlays

    outputs: list[tuple[Path, Output]] = []
    if save is not None:
        outputs.append((save, Overlays(save, stride)))
    if json_file is not None:
        outputs.append((json_file, JsonLines(json_file)))
    if csv is not None:
        outputs.append((csv, BopCsv(csv)))
    return outputs


def _viewers(estimator: PoseEstimator, rerun: Path | None, show: bool) -> list[tuple[Path, Output]]:
    """Return the recording and the window that were asked for."""
    if rerun is None and not show:
        return []
    from dopepp.inference.viewer import Viewer

    paths = [rerun] * (rerun is not None) + [None] * show
    return [(path or Path("the viewer"), Viewer(estimator, path)) for path in paths]


class _Session:
    """Looks at one source after the other, and tells what it finds.

    ``verified`` are the parts to draw and compare with the picture, None where that is not asked.
    """

    def __init__(
        self, estimator: PoseEstimator, options: StreamOptions, verified: Sequence[Part] | None
    ) -> None:
        self._estimator, self._options, self._verified = estimator, options, verified

    def run(self, source: FrameSource, camera: Camera, outputs: Outputs) -> None:
        """Print and write the poses on every picture of a source."""
        total = source.count and math.ceil(source.count / self._options["stride"])
        outputs.begin(source)
        results = self._estimator.stream(source, camera=camera, **self._options)
        for done, result in enumerate(results, 1):
            why = ""
            if not result.detections and source.rate is None and not self._options["track"]:
                result, why = self._searched(result, camera)
            self._print(result)
            place = "" if total == 1 else f"{done}/{total or '…'} {Path(result.name).name}: "
            typer.echo(place + _in_words(result, why), err=True)
            outputs.take(result)

    def _searched(self, result: PoseResult, camera: Camera) -> tuple[PoseResult, str]:
        """Look at any distance where nothing was found, or say why nothing is."""
        from dopepp.inference.frames.source import Lens
        from dopepp.recovery.recover import explained

        own, image, K = self._options, result.image, result.K
        depth = own["depth"]
        metres = None if depth is None else Lens(camera).read_depth(depth, own["depth_scale"], K)
        where = (own["roi"], own["crop"] is not None)
        if own["distances"] is None:
            found = self._estimator.predict(image, K, None, metres, "any", *where)
            found = [one for one in found if one.score >= own["least_score"]]
            if found:
                said = "nothing where training had the parts; found at another distance"
                typer.echo(said, err=True)
                return replace(result, detections=found), ""
        why = self._estimator.explain(image, K, metres, own["distances"], *where)
        least = f"no score of {own['least_score']:g}; " if own["least_score"] else ""
        return result, least + explained(why)

    def _print(self, result: PoseResult) -> None:
        """Print a line of JSON for each detection."""
        records = result.records()
        if self._verified is not None:
            agreements = _agreements(result.image, result.K, result.detections, self._verified)
            records = [
                {**one, "agreement": agreement}
                for one, agreement in zip(records, agreements, strict=True)
            ]
        for one in records:
            typer.echo(json.dumps(one, ensure_ascii=False))


def _in_words(result: PoseResult, why: str) -> str:
    """Say how many poses there are, or why there is none, and where the time went."""
    from dopepp.inference.pose_result import format_speed

    count = len(result.detections)
    found = f"{count} pose{'s' * (count > 1)}" if count else "nothing found"
    return f"{found}{': ' * bool(why)}{why}; speed: {format_speed(result.speed)}"
