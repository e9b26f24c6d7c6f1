"""The page of ``dopepp serve``: a picture and its camera in; poses drawn, listed and as a file.

The server answers this machine alone, and the page loads nothing from anywhere else. What is wrong
with a file or a number stands on the page in one line, as the command line says it. Pictures that
were uploaded are gone when the server ends.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any, Final

import cv2
import gradio as gr
import numpy as np
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware

from dopepp.core.errors import UserError
from dopepp.core.files import write_whole
from dopepp.core.validation import Range, check
from dopepp.drawing.pictures import Picture, read_photo
from dopepp.drawing.sheet import belief_tiles, contact_sheet
from dopepp.geometry.camera import LEAST_VIEW_DEG, MOST_VIEW_DEG, CameraMatrix, camera_matrix
from dopepp.geometry.camera_file import Camera, read_camera
from dopepp.geometry.cuboid import NUM_KEYPOINTS
from dopepp.geometry.rotation import matrix_to_quaternion
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.pose_result import PoseResult, make_shape
from dopepp.parts.size import part_in_words
from dopepp.recovery.recover import explained

HOST: Final = "127.0.0.1"  # nobody but this machine reaches it
MAX_UPLOAD: Final = "64mb"  # of a file: a picture of 20 million pixels without compression
SHOWN_PX: Final = 1600  # longer side of the drawn picture: a browser shows no more

VIEW, NUMBERS, FILE = "field of view", "K", "camera file"
"""How the page can be told what took the picture."""

COLUMNS: Final = ("part", "score", "x mm", "y mm", "z mm", "qw", "qx", "qy", "qz", "error px")
"""Of the table: the part's place and turn in the camera's frame, and the reprojection error."""

FRAME: Final = "Poses in the camera's frame: x right, y down, z forward"

STYLE: Final = """
.gradio-container { max-width: 1500px !important; margin: auto; }
.said { font-size: 1.05em; padding: 0.7em 1em; border-radius: 8px; color: #123; }
.said { background: #e8f3ec; }
.said.wrong { background: #fdecea; }
footer { display: none !important; }
"""

Shown = tuple[Picture | None, str, list[list[object]], Any, Picture | None]
"""What a look at a picture puts on the page: poses, message, table, the file's button, maps."""


@contextmanager
def served(estimator: PoseEstimator, port: int | None = None) -> Iterator[str]:
    """Serve the page beside this thread while the block runs; yield its address.

    Without a port it takes the first free one from 7860. A :class:`UserError`: the port is taken.
    """
    with TemporaryDirectory(prefix="dopepp-") as folder:
        os.environ["GRADIO_TEMP_DIR"] = folder
        page = make_page(estimator, Path(folder))
        try:
            _, address, _ = page.launch(
                server_name=HOST, server_port=port, share=False, prevent_thread_lock=True,
                max_file_size=MAX_UPLOAD, footer_links=[], run_history=False, ssr_mode=False,
                pwa=False, mcp_server=False, enable_monitoring=False, quiet=True, css=STYLE,
                theme=gr.themes.Soft(font=["system-ui", "sans-serif"], font_mono=["monospace"]),
                # Another site's name that leads to this machine gets no answer.
                app_kwargs={"middleware": [Middleware(TrustedHostMiddleware, [HOST])]},
            )  # fmt: skip
        except OSError as error:
            got = "every port from 7860 on" if port is None else f"--port {port}"
            raise UserError(f"{got}, which is taken", "a free port", "choose another") from error
        try:
            yield address
        finally:
            page.close(verbose=False)


def make_page(estimator: PoseEstimator, folder: Path) -> gr.Blocks:
    """Lay the page out; what it hands out is written to a folder."""

    def look(path: str | None, kind: str, *camera: Any) -> Shown:
        try:
            return _looked(estimator, path, kind, camera, folder)
        except UserError as error:
            said = str(error)
            for one in filter(None, (path, camera[-1])):
                said = said.replace(one, Path(one).name)
            return None, _said(said, wrong=True), [], _button(None), None

    page = gr.Blocks(title="DOPE++", analytics_enabled=False)
    with page:
        gr.Markdown(f"# DOPE++\nlooks for {_in_words(estimator)}")
        with gr.Row():
            with gr.Column(scale=1, min_width=320):
                kinds = "PNG, JPEG, TIFF, BMP or WEBP"
                picture = gr.File(label=f"Picture: {kinds}", height=160, elem_id="picture")
                camera = _camera_inputs()
                button = gr.Button("Find poses", variant="primary")
                maps = _picture("Belief maps", "maps")
            with gr.Column(scale=2, min_width=480):
                greeting = _said("Drop a picture, say what took it, and find the poses.")
                message = gr.HTML(greeting, padding=False)
                drawn = _picture("Poses", "poses")
                table = gr.Dataframe(headers=list(COLUMNS), label=FRAME, interactive=False)
                file = gr.DownloadButton("Download JSON", interactive=False)
        outputs = [drawn, message, table, file, maps]
        button.click(look, [picture, *camera], outputs, api_visibility="private")
    return page


def _picture(label: str, name: str) -> gr.Image:
    """Lay out a place for a picture; of Gradio's buttons, the one that publishes it is left out."""
    return gr.Image(
        label=label, elem_id=name, interactive=False, format="png",
        buttons=["download", "fullscreen"],
    )  # fmt: skip


def _camera_inputs() -> list[Any]:
    """Lay out the ways to tell the camera, of which one is shown."""
    kind = gr.Radio([VIEW, NUMBERS, FILE], value=VIEW, label="Camera")
    view = gr.Number(label="Degrees across the picture's width", placeholder="60")
    with gr.Row(visible=False) as row:
        numbers = [
            gr.Number(label=name, placeholder="pixels", min_width=80)
            for name in ("fx", "fy", "cx", "cy")
        ]
    formats = "ROS, OpenCV, BOP, COLMAP, or 3×3 numbers"
    file = gr.File(label=formats, height=140, visible=False, elem_id="camera")

    def chosen(one: str) -> list[Any]:
        return [gr.update(visible=one == this) for this in (VIEW, NUMBERS, FILE)]

    kind.change(chosen, kind, [view, row, file], api_visibility="private", show_progress="hidden")
    return [kind, view, *numbers, file]


def _looked(
    estimator: PoseEstimator, path: str | None, kind: str, given: Sequence[Any], folder: Path
) -> Shown:
    """Return what is on a picture; see :func:`look` of the page for the arguments."""
    if path is None:
        raise UserError("no picture", "a picture's file", "drop one")
    picture = read_photo(Path(path))
    size = (picture.shape[1], picture.shape[0])
    camera = _camera(kind, given, size[0], size[1]).for_picture(size)
    image, K = camera.undistorted(picture), camera.K
    found, said = estimator.predict(image, K), ""
    if not found:
        found = estimator.predict(image, K, distances="any")
        said = ", not where training had the parts, but at another distance"
    if not found:
        said = f": {explained(estimator.explain(image, K))}"
    shapes = {part.name: make_shape(part) for part in estimator.parts}
    result = PoseResult(image, K, found, {}, Path(path).name, shapes=shapes)
    count = f"{len(found)} pose{'s' * (len(found) > 1)} found" if found else "Nothing found"
    file = Path(mkdtemp(dir=folder), f"{Path(path).stem}.json")
    write_whole(file, json.dumps(result.records(), ensure_ascii=False, indent=1).encode())
    rows = _rows(result)
    maps = belief_sheet(estimator, image, K)
    return _shrunk(result.plot()), _said(count + said, wrong=not found), rows, _button(file), maps


def _camera(kind: str, given: Sequence[Any], width: int, height: int) -> Camera:
    """Return the camera of a picture, as the page tells it."""
    view, fx, fy, cx, cy, file = given
    if kind == VIEW:
        check("field of view", view, float, Range(LEAST_VIEW_DEG, MOST_VIEW_DEG, "degrees"))
        focal = width / 2 / math.tan(math.radians(view) / 2)
        K = camera_matrix(focal, focal, (width - 1) / 2, (height - 1) / 2)
        return Camera(None, K, (), "the field of view")
    if kind == FILE:
        if file is None:
            raise UserError("no camera file", "the calibration's file", "drop it")
        return read_camera(file)
    numbers = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
    missing = [name for name, number in numbers.items() if number is None]
    if missing:
        raise UserError(f"K without {missing[0]}", "fx, fy, cx and cy, pixels", "fill it in")
    return Camera(None, camera_matrix(fx, fy, cx, cy), (), "K")


def belief_sheet(estimator: PoseEstimator, image: Picture, K: CameraMatrix) -> Picture:
    """Draw the belief maps on a picture in every size in which the network looks at it."""
    tiles = []
    for view in estimator.views(image, K):
        box = view.box
        belief = estimator.maps(view.pixels)[0].cpu().numpy()
        strongest = belief.reshape(-1, NUM_KEYPOINTS, *belief.shape[1:]).max(axis=0)
        shown = view.pixels[: box.height, : box.width]  # without its padding
        size = f"{box.width}×{box.height}"
        tiles += belief_tiles(shown, strongest, estimator.network.stride, size)
    return contact_sheet(tiles, columns=2)


def _rows(result: PoseResult) -> list[list[object]]:
    rows: list[list[object]] = []
    for one in result.detections:
        place = [f"{number:.1f}" for number in 1000 * one.T_cam_obj[:3, 3]]
        turn = [f"{number:.3f}" for number in matrix_to_quaternion(one.T_cam_obj[:3, :3])]
        error = f"{one.reprojection_error_px:.1f}"
        rows.append([one.object, f"{one.score:.2f}", *place, *turn, error])
    return rows


def _shrunk(picture: Picture) -> Picture:
    scale = SHOWN_PX / max(picture.shape)
    if scale >= 1:
        return picture
    return np.asarray(cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def _in_words(estimator: PoseEstimator) -> str:
    return "; ".join(part_in_words(part) for part in estimator.parts)


def _said(text: str, wrong: bool = False) -> str:
    return f'<p class="said{" wrong" * wrong}">{escape(text)}</p>'


def _button(file: Path | None) -> Any:
    """Return the button with its file, or one that cannot be pressed."""
    return gr.update(value=None if file is None else str(file), interactive=file is not None)
