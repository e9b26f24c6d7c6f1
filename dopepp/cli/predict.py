"""``dopepp predict``: the poses on one picture."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from dopepp.cli.errors import report_errors
from dopepp.core.errors import UserError

if TYPE_CHECKING:
    from dopepp.drawing.overlay import Wireframe
    from dopepp.drawing.pictures import Picture
    from dopepp.geometry.camera import CameraMatrix
    from dopepp.geometry.camera_file import Camera, Crop
    from dopepp.inference.estimator import PoseEstimator
    from dopepp.inference.refinement.view import Depth32
    from dopepp.parts.part import Part
    from dopepp.recovery.detection import Detection

FRAMES: Final = (".png", ".jpg", ".jpeg")
"""Suffixes of a folder's frames."""


def predict(
    checkpoint: Annotated[Path, typer.Argument(help="best.ckpt of a run")],
    image: Annotated[
        Path, typer.Argument(help="a picture (PNG, JPEG, TIFF); with --track, a folder of frames")
    ],
    intrinsics: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option("--K", help="fx fy cx cy, pixels; or --camera"),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(help="camera file: ROS, OpenCV, BOP, COLMAP, or text with 3×3 numbers"),
    ] = None,
    K_size: Annotated[
        tuple[int, int] | None,
        typer.Option("--K-size", help="width height that K is of, if the picture was resized"),
    ] = None,
    crop: Annotated[
        tuple[int, int, int, int] | None,
        typer.Option(help="x y width height, if the picture was cut out of the calibrated one"),
    ] = None,
    distance: Annotated[
        tuple[float, float] | None,
        typer.Option(help="nearest and farthest part, metres; else those of training, then any"),
    ] = None,
    roi: Annotated[
        tuple[int, int, int, int] | None,
        typer.Option(help="x y width height: look at this part of the picture only"),
    ] = None,
    overlay: Annotated[
        Path | None,
        typer.Option(help="write the picture with wireframes (.png, .jpg); with --track, a folder"),
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
        str | None, typer.Option(help="region: on the picture; depth: with --depth; region,depth")
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
    from dopepp.core.files import write_picture
    from dopepp.drawing.overlay import overlay as draw
    from dopepp.recovery.silence import explained

    with report_errors():
        terms = () if refine is None else tuple(refine.split(","))
        _check_options(terms, depth, track, verify, distance or roi)
        _check_overlay(overlay, track)
        lens = _Lens(_camera(intrinsics, camera), K_size, crop)
        terms = ("region",) if track else terms
        estimator, known = _estimator(checkpoint, device, terms, verify, parts, unit, max_ms)
        if track:
            _track(estimator, image, lens, overlay)
            return
        picture, K = lens.picture(image)
        metres = None if depth is None else lens.depth(depth, depth_scale, K)
        where: dict[str, Any] = {"depth": metres, "roi": roi, "cropped": crop is not None}
        found = estimator.predict(picture, K, distances=distance, **where)
        if not found and distance is None:
            found = estimator.predict(picture, K, distances="any", **where)
            if found:
                typer.echo(
                    "nothing where training had the parts; found at another distance", err=True
                )
        agreements = _agreements(picture, K, found, known) if verify else []
        why = "" if found else explained(estimator.explain(picture, K, distances=distance, **where))
    if not found:
        typer.echo(f"nothing found: {why}", err=True)
    for number, one in enumerate(found):
        record = _record(one)
        if terms:
            record["kept"] = one.kept or None
        if verify:
            record["agreement"] = agreements[number]
        typer.echo(json.dumps(record))
    if overlay is not None:
        write_picture(overlay, draw(picture, _wireframes(found)))


@dataclass(frozen=True)
class _Lens:
    """What the options say of the camera, and how the pictures came about."""

    camera: Camera
    K_size: tuple[int, int] | None
    crop: Crop | None

    def picture(self, path: Path) -> tuple[Picture, CameraMatrix]:
        """Return a picture without distortion and its K."""
        from dopepp.drawing.pictures import read_photo

        picture = read_photo(path)
        size = (picture.shape[1], picture.shape[0])
        camera = self.camera.for_picture(size, self.K_size, self.crop)
        return camera.undistorted(picture), camera.K

    def depth(self, path: Path, scale: float, K: CameraMatrix) -> Depth32:
        """Return a depth image without distortion, metres."""
        from dopepp.inference.refinement.view import read_depth, undistorted_depth

        metres, lens = read_depth(path, scale), self.camera.coefficients
        return metres if lens is None else undistorted_depth(metres, K, lens)


def _camera(intrinsics: tuple[float, float, float, float] | None, path: Path | None) -> Camera:
    """Return the camera of the one of two options that is given."""
    from dopepp.geometry.camera import camera_matrix
    from dopepp.geometry.camera_file import Camera, read_camera

    if (intrinsics is None) == (path is None):
        got = "--K and --camera" if path else "neither --K nor --camera"
        fix = "pass --K fx fy cx cy (pixels of this picture) or --camera FILE"
        raise UserError(got, "one of the two", fix)
    if path is not None:
        return read_camera(path)
    assert intrinsics is not None
    return Camera(None, camera_matrix(*intrinsics), (), "--K")


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


def _check_overlay(overlay: Path | None, track: bool) -> None:
    """Refuse a place where no picture can be written, before the work is done for it."""
    from dopepp.core.files import PICTURES, check_target

    if overlay is not None and track:
        check_target(overlay / "frame.png")
    elif overlay is not None:
        check_target(overlay, PICTURES)


def _estimator(
    checkpoint: Path,
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

    estimator = PoseEstimator.load(checkpoint, device, max_ms=max_ms)
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


def _track(estimator: PoseEstimator, folder: Path, lens: _Lens, overlay: Path | None) -> None:
    """Print the parts on every frame of a folder, in the order of the frames' names."""
    from dopepp.core.files import write_png
    from dopepp.drawing.overlay import overlay as draw
    from dopepp.inference.tracker import PoseTracker

    frames = [path for path in sorted(folder.glob("*")) if path.suffix.lower() in FRAMES]
    if not frames:
        allowed = f"a folder with frames ({', '.join(FRAMES)})"
        raise UserError(f"--track of {folder}", allowed, "pass the folder of a sequence")
    tracker = PoseTracker(estimator)
    for frame in frames:
        picture, K = lens.picture(frame)
        tracks = tracker.track(picture, K, cropped=lens.crop is not None)
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
