"""Web page of ``dopepp serve``: upload an image and its camera; see and download the poses.

The server accepts requests from this machine only, and the page loads nothing from other hosts.
Errors about files and numbers appear on the page as one line, as on the command line. Uploaded
images are deleted when the server stops.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
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
from dopepp.core.files import write_file
from dopepp.core.validation import Range, check
from dopepp.drawing.pictures import RGBImage, photo_size
from dopepp.drawing.sheet import belief_tiles, contact_sheet
from dopepp.geometry.camera import MAX_VIEW_DEG, MIN_VIEW_DEG, CameraMatrix, camera_matrix
from dopepp.geometry.camera_file import Camera, read_camera
from dopepp.geometry.cuboid import NUM_KEYPOINTS
from dopepp.geometry.rotation import matrix_to_quaternion
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.frames.media import Images
from dopepp.inference.network_estimator import NetworkEstimator, search_again
from dopepp.parts.size import part_in_words

HOST: Final = "127.0.0.1"  # reachable from this machine only
MAX_UPLOAD: Final = "64mb"  # size of an uncompressed image of 20 megapixels
SHOWN_PX: Final = 1600  # longest side of the drawn image, pixels

VIEW, NUMBERS, FILE = "field of view", "K", "camera file"  # ways to specify the camera
COLUMNS: Final = ["part", "score", "x mm", "y mm", "z mm", "qw", "qx", "qy", "qz", "error px"]
"""Table: position and quaternion in the camera frame, and the reprojection error."""

FRAME: Final = "Poses in the camera's frame: x right, y down, z forward"

STYLE: Final = """
.gradio-container { max-width: 1500px !important; margin: auto; }
.said { font-size: 1.05em; padding: 0.7em 1em; border-radius: 8px; color: #123; }
.said { background: #e8f3ec; }
.said.wrong { background: #fdecea; }
footer { display: none !important; }
"""

DISABLED: Final = ("share", "run_history", "ssr_mode", "pwa", "mcp_server", "enable_monitoring")

LAUNCH: Final[dict[str, Any]] = {
    "server_name": HOST,
    "prevent_thread_lock": True,
    "max_file_size": MAX_UPLOAD,
    "css": STYLE,
    "theme": gr.themes.Soft(font=["system-ui", "sans-serif"], font_mono=["monospace"]),
    "footer_links": [],
    "quiet": True,
    # Requests under another host name that resolves to this machine are rejected.
    "app_kwargs": {"middleware": [Middleware(TrustedHostMiddleware, [HOST])]},
    **dict.fromkeys(DISABLED, False),
}
"""Settings of Gradio's server."""

Outputs = tuple[RGBImage | None, str, list[list[object]], Any, RGBImage | None]
"""Outputs of the page: drawn poses, message, table, download button, belief maps."""


@contextmanager
def serve_page(estimator: PoseEstimator, port: int | None = None) -> Iterator[str]:
    """Serve the page in another thread while the block runs; yield its address.

    The default port is the first free port from 7860 on.

    Raises:
        UserError: Another program uses the port.
    """
    with TemporaryDirectory(prefix="dopepp-") as folder:
        os.environ["GRADIO_TEMP_DIR"] = folder
        page = make_page(estimator, Path(folder))
        try:
            _, address, _ = page.launch(server_port=port, **LAUNCH)
        except OSError as error:
            taken = "no free port from 7860 on" if port is None else f"--port {port} already in use"
            fix = "pass another port, e.g. --port 8000, or stop the program that uses the port"
            raise UserError(taken, "a free port", fix) from error
        try:
            yield address
        finally:
            page.close(verbose=False)


def make_page(estimator: PoseEstimator, folder: Path) -> gr.Blocks:
    """Build the page; downloads are written to a folder."""

    def find_poses(path: str | None, kind: str, *camera: Any) -> Outputs:
        try:
            if path is None:
                raise UserError("no image", "an image file", "drop an image onto the page")
            return _outputs(estimator, Path(path), kind, camera, folder)
        except UserError as error:
            message = str(error)
            for upload in filter(None, (path, camera[-1])):
                message = message.replace(upload, Path(upload).name)
            return None, _message(message, is_error=True), [], _button(None), None

    page = gr.Blocks(title="DOPE++", analytics_enabled=False)
    with page:
        parts = "; ".join(part_in_words(part) for part in estimator.parts)
        gr.Markdown(f"# DOPE++\ndetects {parts}")
        with gr.Row():
            with gr.Column(scale=1, min_width=320):
                formats = "Image: PNG, JPEG, TIFF, BMP or WEBP"
                image = gr.File(label=formats, height=160, elem_id="image")
                camera = _camera_inputs()
                button = gr.Button("Find poses", variant="primary")
                maps = _image("Belief maps", "maps", isinstance(estimator, NetworkEstimator))
            with gr.Column(scale=2, min_width=480):
                greeting = _message("Drop an image, specify its camera, and find the poses.")
                message = gr.HTML(greeting, padding=False)
                drawn = _image("Poses", "poses")
                table = gr.Dataframe(headers=COLUMNS, label=FRAME, interactive=False)
                file = gr.DownloadButton("Download JSON", interactive=False)
        outputs = [drawn, message, table, file, maps]
        button.click(find_poses, [image, *camera], outputs, api_visibility="private")
    return page


def _image(label: str, name: str, is_visible: bool = True) -> gr.Image:
    """Return an image output without Gradio's button that publishes the image."""
    shared: dict[str, Any] = {"format": "png", "buttons": ["download", "fullscreen"]}
    return gr.Image(label=label, elem_id=name, interactive=False, visible=is_visible, **shared)


def _camera_inputs() -> list[Any]:
    """Return the input fields of all camera types, and show only the chosen type's fields."""
    kind = gr.Radio([VIEW, NUMBERS, FILE], value=VIEW, label="Camera")
    view = gr.Number(label="Degrees across the image's width", placeholder="60")
    with gr.Row(visible=False) as row:
        numbers = [
            gr.Number(label=name, placeholder="pixels", min_width=80)
            for name in ("fx", "fy", "cx", "cy")
        ]
    formats = "ROS, OpenCV, BOP, COLMAP, or 3×3 numbers"
    file = gr.File(label=formats, height=140, visible=False, elem_id="camera")

    def show(chosen: str) -> list[Any]:
        return [gr.update(visible=kind == chosen) for kind in (VIEW, NUMBERS, FILE)]

    kind.change(show, kind, [view, row, file], api_visibility="private", show_progress="hidden")
    return [kind, view, *numbers, file]


def _outputs(
    estimator: PoseEstimator, path: Path, kind: str, inputs: Sequence[Any], folder: Path
) -> Outputs:
    """Estimate the poses on an uploaded image, and return the contents of the page's outputs."""
    camera, remark = _camera(kind, inputs, *photo_size(path)), ""
    (result,) = estimator.stream(Images([path]), camera=camera)
    if not result.detections:
        result, reason = search_again(estimator, camera, result)
        beyond = " (not at the trained sizes, but in a search at all sizes)"
        remark = f": {reason}" if reason else beyond
    result = replace(result, name=path.name)
    file = Path(mkdtemp(dir=folder), f"{path.stem}.json")
    write_file(file, json.dumps(result.records(), ensure_ascii=False, indent=1).encode())
    rows: list[list[object]] = []
    for detection in result.detections:
        position = [f"{mm:.1f}" for mm in 1000 * detection.T_cam_obj[:3, 3]]
        rotation = [f"{q:.3f}" for q in matrix_to_quaternion(detection.T_cam_obj[:3, :3])]
        error = f"{detection.reprojection_error_px:.1f}"
        rows.append([detection.object, f"{detection.score:.2f}", *position, *rotation, error])
    drawn = result.plot()
    scale = SHOWN_PX / max(drawn.shape)
    if scale < 1:
        area = cv2.INTER_AREA
        drawn = np.asarray(cv2.resize(drawn, None, fx=scale, fy=scale, interpolation=area))
    summary = _message(f"{result.summary}{remark}", is_error=not result.detections)
    maps = None
    if isinstance(estimator, NetworkEstimator):
        maps = belief_sheet(estimator, result.image, result.K)
    return drawn, summary, rows, _button(file), maps


def _camera(kind: str, inputs: Sequence[Any], width: int, height: int) -> Camera:
    """Return the camera of the page's inputs; ``kind`` is ``VIEW``, ``NUMBERS`` or ``FILE``."""
    view, fx, fy, cx, cy, file = inputs
    if kind == VIEW:
        check("field of view", view, float, Range(MIN_VIEW_DEG, MAX_VIEW_DEG, "degrees"))
        focal = width / 2 / math.tan(math.radians(view) / 2)
        K = camera_matrix(focal, focal, (width - 1) / 2, (height - 1) / 2)
        return Camera(None, K, (), "the field of view")
    if kind == FILE:
        if file is None:
            fix = "drop the camera file onto the page"
            raise UserError("no camera file", "a file of a calibrated camera", fix)
        return read_camera(file)
    for name, number in {"fx": fx, "fy": fy, "cx": cx, "cy": cy}.items():
        if number is None:
            raise UserError(f"K without {name}", "fx, fy, cx and cy, pixels", f"enter {name}")
    return Camera(None, camera_matrix(fx, fy, cx, cy), (), "K")


def belief_sheet(estimator: NetworkEstimator, image: RGBImage, K: CameraMatrix) -> RGBImage:
    """Draw the belief maps over the image at every size that the network processes."""
    tiles = []
    for view in estimator.views(image, K):
        belief = estimator.maps(view.pixels)[0].cpu().numpy()
        strongest = belief.reshape(-1, NUM_KEYPOINTS, *belief.shape[1:]).max(axis=0)
        width, height = view.box.width, view.box.height
        unpadded = view.pixels[:height, :width]
        tiles += belief_tiles(unpadded, strongest, estimator.network.stride, f"{width}×{height}")
    return contact_sheet(tiles, columns=2)


def _message(text: str, is_error: bool = False) -> str:
    """Return a message as HTML."""
    return f'<p class="said{" wrong" * is_error}">{escape(text)}</p>'


def _button(file: Path | None) -> Any:
    """Return the download button, disabled without a file."""
    return gr.update(value=None if file is None else str(file), interactive=file is not None)
