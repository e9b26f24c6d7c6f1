"""``dopepp predict``: the poses on one picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from dopepp.cli.errors import report_errors
from dopepp.core.errors import UserError


def predict(
    checkpoint: Annotated[Path, typer.Argument(help="best.ckpt of a run")],
    image: Annotated[Path, typer.Argument(help="a picture (PNG, JPEG)")],
    intrinsics: Annotated[
        tuple[float, float, float, float], typer.Option("--K", help="fx fy cx cy, pixels")
    ],
    overlay: Annotated[Path | None, typer.Option(help="write the picture with wireframes")] = None,
    device: Annotated[str, typer.Option(help="cpu, cuda, …")] = "cpu",
    verify: Annotated[
        bool, typer.Option("--verify", help="add how well picture and drawn part agree, 0 to 1")
    ] = False,
    parts: Annotated[
        list[str] | None,
        typer.Option("--part", help="for --verify: built-in part, mesh file, or NAME=FILE"),
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
) -> None:
    """Print the poses on one picture as JSON, a line per detection; why, where there is none."""
    from dopepp.core.files import write_png
    from dopepp.drawing.overlay import YELLOW, Wireframe
    from dopepp.drawing.overlay import overlay as draw
    from dopepp.drawing.pictures import read_rgb
    from dopepp.geometry.camera import camera_matrix
    from dopepp.inference.estimator import PoseEstimator
    from dopepp.inference.refinement.view import read_depth
    from dopepp.parts.catalogue import with_meshes
    from dopepp.virtual.agreement import agreement
    from dopepp.virtual.surface import make_surface

    with report_errors():
        picture, K = read_rgb(image), camera_matrix(*intrinsics)
        if (refine == "depth") != (depth is not None):
            raise UserError(
                "--depth without --refine depth" if depth else "--refine depth without --depth",
                "both or none of them",
                "add --refine depth" if depth else "add --depth FILE",
            )
        estimator = PoseEstimator.load(checkpoint, device, max_ms=max_ms)
        known = (
            with_meshes(estimator.parts, parts or (), unit)
            if verify or refine == "region"
            else estimator.parts
        )
        if refine is not None:
            estimator = estimator.refining(refine, known)
        metres = None if depth is None else read_depth(depth, depth_scale)
        found = estimator.predict(picture, K, depth=metres)
        agreements: list[float] = []
        if verify:
            meshes = {part.name: make_surface(part.mesh) for part in known if part.mesh}
            agreements = [agreement(picture, K, one.T_cam_obj, meshes[one.object]) for one in found]
    if not found:
        typer.echo("nothing found: " + "; ".join(estimator.explain(picture, K)), err=True)
    for number, one in enumerate(found):
        record = {
            "object": one.object,
            "score": one.score,
            "T_cam_obj": one.T_cam_obj.tolist(),
            "keypoints": one.keypoints.tolist(),
            "reprojection_error_px": one.reprojection_error_px,
        }
        if refine is not None:
            record["kept"] = one.kept or None
        if verify:
            record["agreement"] = agreements[number]
        typer.echo(json.dumps(record))
    if overlay is not None:
        wireframes = [Wireframe(one.keypoints, YELLOW, one.object) for one in found]
        write_png(overlay, draw(picture, wireframes))
