"""Images of a calibration board, from folders, videos and cameras, for ``dopepp calibrate``."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import typer

from dopepp.core.errors import Interruption, RunError, UserError, interruptible
from dopepp.drawing.pictures import RGBImage, Size, read_photo
from dopepp.geometry.camera_file import read_camera
from dopepp.robot.calibration.board import Board, BoardDetection, BoardPose, board_pose, parse_board
from dopepp.robot.calibration.lens import CHECKS_PER_S, Views


def image_names(folder: Path) -> list[str]:
    """Return the file names of a folder's images in natural order: 10 after 9.

    Raises:
        UserError: The path is not a folder, or the folder has no images.
    """
    from dopepp.inference.frames.media import list_images

    if not folder.is_dir():
        fix = "pass the path of an existing folder"
        raise UserError(f"{folder}, which is not a folder", "a folder with images", fix)
    return [path.name for path in list_images(folder) or ()]


def board_poses(folder: Path, spec: str, camera: Path) -> list[BoardPose]:
    """Estimate the pose of the board ``spec`` in each image of a folder that shows it."""
    detections, size = detect_in_folder(folder, parse_board(spec))
    lens = read_camera(camera).for_picture(size)
    return [board_pose(detection, lens) for detection in detections]


def detect_in_folder(folder: Path, board: Board) -> tuple[list[BoardDetection], Size]:
    """Detect the board in a folder's images; return the detections and the images' common size."""
    detections: list[BoardDetection] = []
    first_size, names = None, image_names(folder)
    for name in names:
        image = read_photo(folder / name)
        size = (image.shape[1], image.shape[0])
        first_size = first_size or size
        if size != first_size:
            problem = f"{folder / name} of {size[0]}×{size[1]} pixels among images of "
            problem += f"{first_size[0]}×{first_size[1]}"
            raise UserError(problem, "images of one size", "delete the images of the other size")
        if detection := _detect(board, image, name):
            detections.append(detection)
        else:
            typer.echo(f"{name}: no board", err=True)
    return _checked(detections, first_size, f"{folder}", len(names))


def detect_in_stream(source: str, board: Board) -> tuple[list[BoardDetection], Size]:
    """Detect the board in a video or a camera stream; return distinct views and the image size.

    The search ends with the stream, on Ctrl-C, or with 60 views.
    """
    from dopepp.inference.frames import open_sources

    views, first_size, count = Views(0), None, 0
    try:
        with suppress(Interruption), interruptible(""):
            for opened in open_sources([source]):
                is_live = opened.count is None
                stride = 1 if is_live else max(1, round((opened.rate or 0) / CHECKS_PER_S))
                for frame in opened.frames(stride):
                    size = (frame.image.shape[1], frame.image.shape[0])
                    if first_size is None:
                        views, first_size = Views(size[0]), size
                    count += 1
                    name = Path(frame.name).name if opened.rate is None else f"frame {frame.number}"
                    detection = _detect(board, frame.image, name) if size == first_size else None
                    if detection is not None and views.add(detection):
                        typer.echo(f"{name}: view {len(views.kept)}", err=True)
                    if views.is_full:
                        break
    except RunError as error:  # the camera has stopped
        if not views.kept:
            raise
        typer.echo(f"{error}; the views so far are used", err=True)
    detections = _checked(views.kept, first_size, source, count)
    typer.echo(f"{len(views.kept)} distinct views in {count} images", err=True)
    return detections


def _detect(board: Board, image: RGBImage, name: str) -> BoardDetection | None:
    """Detect the board in an image; skip an image of two boards with a message."""
    try:
        return board.detect(image, name)
    except UserError as error:
        typer.echo(f"{name}: skipped, {error}", err=True)
        return None


def _checked(
    detections: list[BoardDetection], size: Size | None, source: str, count: int
) -> tuple[list[BoardDetection], Size]:
    """Return detections and image size; raise a ``UserError`` if no image shows the board."""
    if not detections or size is None:
        raise UserError(
            f"{source}: no board in any of {count} images",
            "images of the board described by --board",
            "compare --board with the board: kind, numbers of columns and rows, dictionary",
        )
    return detections, size
