"""``dopepp predict``: the poses on one picture."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from dopepp.cli.errors import report_errors
from dopepp.core.errors import UserError

if TYPE_CHECKING:
    from dopepp.drawing.overlay import Wireframe
    from dopepp.geometry.camera import CameraMatrix
    from dopepp.inference.estimator import PoseEstimator
    from dopepp.recovery.detection import Detection

FRAMES: Final = (".png", ".jpg", ".jpeg")
"""Suffixes of a folder's frames."""


def predict(
    checkpoint: Annotated[Path, typer.Argument(help="best.ckpt of a run")],
    image: Annotated[
        Path, typer.Argument(help="a picture (PNG, JPEG); with --track, a folder of frames")
    ],
    intrinsics: Annotated[
        tuple[float, float, float, float], typer.Option("--K", help="fx fy cx cy, pixels")
    ],
    overlay: Annotated[
        Path | None, typer.Option(help="write the picture with wireframes; with --track, a folder")
    ] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, …")] = "cpu",
    verify: Annotated[
        bool, typer.Option("--verify", help="add how well picture and drawn part agree, 0 to 1")
    ] = False,
    parts: Annotated[
        list[str] | None,
        typer.Option(
            "--part", help="mesh in place of the checkpoint's: built-in part, file, or NAME=FILE"
        ),
    ] = None,
    unit: Annotated[str | None, typer.Option(help="of the mesh files: mm, cm, m, inch")] = None,
    refine: Annotated[
        str | None, typer.Option(help="region: on the picture; depth: with --depth")
    ] = None,
    max_ms: Annotated[
        float | None, typer.Option(help="of refining, then detections keep the network's poses")
    ] = None,
    depth: Annotated[
        Path | None, typer.Option(help="16-bit PNG aligned to the picture, 0 where unknown")
    ] = None,
    depth_scale: Annotated[float, typer.Option(help="metres per unit of --depth")] = 0.001,
    track: Annotated[
        bool, typer.Option("--track", help="follow the parts through a folder of frames")
    ] = False,
) -> None:
    """Print the poses on one picture, or a folder's, as JSON, a line per detection.

    Where nothing is found on a picture, it is said why.
    """
    from dopepp.core.files import write_png
    from dopepp.drawing.overlay import overlay as draw
    from dopepp.drawing.pictures import read_rgb
    from dopepp.geometry.camera import camera_matrix
    from dopepp.inference.estimator import PoseEstimator
    from dopepp.inference.refinement.view import read_depth
    from dopepp.parts.catalogue import with_meshes
    from dopepp.virtual.agreement import agreement
    from dopepp.virtual.surface import make_surface

    with report_errors():
        K = camera_matrix(*intrinsics)
        if (refine == "depth") != (depth is not None):
            raise UserError(
                "--depth without --refine depth" if depth else "--refine depth without --depth",
                "both or none of them",
                "add --refine depth" if depth else "add --depth FILE",
            )
        if track and (verify or depth is not None):
            raise UserError("--track with --verify or --depth", "--track alone", "leave it out")
        refine = "region" if track else refine
        estimator = PoseEstimator.load(checkpoint, device, max_ms=max_ms)
        known = estimator.parts
        if verify or refine == "region":
            known = with_meshes(known, parts or (), unit)
        if refine is not None:
            estimator = estimator.refining(refine, known)
        if track:
            _track(estimator, image, K, overlay)
            return
        picture = read_rgb(image)
        metres = None if depth is None else read_depth(depth, depth_scale)
        found = estimator.predict(picture, K, depth=metres)
        agreements: list[float] = []
        if verify:
            meshes = {part.name: make_surface(part.mesh) for part in known if part.mesh}
            agreements = [agreement(picture, K, one.T_cam_obj, meshes[one.object]) for one in found]
    if not found:
        typer.echo("nothing found: " + "; ".join(estimator.explain(picture, K)), err=True)
    for number, one in enumerate(found):
        record = _record(one)
        if refine is not None:
            record["kept"] = one.kept or None
        if verify:
            record["agreement"] = agreements[number]
        typer.echo(json.dumps(record))
    if overlay is not None:
        write_png(overlay, draw(picture, _wireframes(found)))


def _track(estimator: PoseEstimator, folder: Path, K: CameraMatrix, overlay: Path | None) -> None:
    """Print the parts on every frame of a folder, in the order of the frames' names."""
    from dopepp.core.files import write_png
    from dopepp.drawing.overlay import overlay as draw
    from dopepp.drawing.pictures import read_rgb
    from dopepp.inference.tracker import PoseTracker

    frames = [path for path in sorted(folder.glob("*")) if path.suffix.lower() in FRAMES]
    if not frames:
        allowed = f"a folder with frames ({', '.join(FRAMES)})"
        raise UserError(f"--track of {folder}", allowed, "pass the folder of a sequence")
    tracker = PoseTracker(estimator)
    for frame in frames:
        picture = read_rgb(frame)
        tracks = tracker.track(picture, K)
        for one in tracks:
            record = {"frame": frame.name, "identity": one.identity, **_record(one.detection)}
            typer.echo(json.dumps(record))
        if overlay is not None:
            labels = [f"{one.detection.object} {one.identity}" for one in tracks]
            wireframes = _wireframes([one.detection for one in tracks], labels)
            write_png(overlay / f"{frame.stem}.png", draw(picture, wireframes))


def _record(one: Detection) -> dict[str, object]:
    return {
        "object": one.object,
        "score": one.score,
        "T_cam_obj": one.T_cam_obj.tolist(),
        "keypoints": one.keypoints.tolist(),
        "reprojection_error_px": one.reprojection_error_px,
    }


def _wireframes(found: Sequence[Detection], labels: Sequence[str] = ()) -> list[Wireframe]:
    from dopepp.drawing.overlay import YELLOW, Wireframe

    names = labels or [one.object for one in found]
    return [Wireframe(one.keypoints, YELLOW, name) for one, name in zip(found, names, strict=True)]
