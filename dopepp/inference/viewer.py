"""Viewer: results in Rerun (extra ``rerun``), in a window or a file.

The viewer shows the image with cuboids and silhouettes; the parts' meshes, cuboids and axes in 3D,
with an ellipsoid for the uncertainty of each position; and the network's belief maps.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import cv2
import numpy as np

from dopepp.core.errors import RunError, UserError, require
from dopepp.core.files import check_target, partial_path
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import crop_camera
from dopepp.geometry.cuboid import CENTROID, EDGES
from dopepp.geometry.rotation import matrix_to_quaternion
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.frames import FrameSource
from dopepp.inference.network_estimator import NetworkEstimator
from dopepp.inference.pose_result import AXIS, COLOURS, PoseResult, silhouette_contours
from dopepp.recovery.detection import Detection

if TYPE_CHECKING:
    import rerun as rr

MEMORY: Final = "2GB"  # limit of the viewer's window, which then drops the oldest data
GROUPS: Final = ("parts", "meshes", "uncertainty")
CENTRE: Final = 0.5  # coordinate of the top-left pixel's centre in Rerun
LOCALHOST: Final = "127.0.0.1"
START_S: Final = 20.0  # timeout for opening a window, seconds
ELLIPSOID: Final = 2.8  # half axes, standard deviations: 95 % of a normal distribution in space
JPEG_QUALITY: Final = 90
SINCE_1970: Final = 1e8  # seconds above which a time counts from 1970, not from a video's start


class Viewer:
    """A Rerun recording of an estimator's results, written to an ``.rrd`` file or (None) shown.

    Raises:
        UserError: The extra ``rerun`` is not installed, the file cannot be written, or there is no
            display.
    """

    def __init__(self, estimator: PoseEstimator, path: Path | None = None) -> None:
        require("rerun", "the viewer", "rerun")
        import rerun as rr

        self._estimator, self._path = estimator, path
        self._parts = {part.name: part for part in estimator.solid_parts}
        self._recording = rr.RecordingStream("dopepp")
        self._shown: set[str] = set()
        self._is_open = False
        self._first = self._next = 0  # frame number at which a source starts on the timeline
        if path is not None:
            check_target(path, (".rrd",))
        elif sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}:
            fix = "pass --rerun FILE.rrd instead, and open the file on a machine with a display"
            raise UserError("--show without a display", "a desktop session", fix)

    def begin(self, source: FrameSource) -> None:
        """Place the frames of the source after those of the previous source on the timeline."""
        self._first = self._next

    def write(self, result: PoseResult) -> None:
        """Add a frame: its image, outlines, belief maps and poses."""
        import rerun as rr

        log, distance = self._recording.log, self._distance(result)
        if not self._is_open:
            self._open(distance)
        number = self._first + result.number
        self._next = number + 1
        self._recording.set_time("frame", sequence=number)
        if result.time is not None:
            kind = "timestamp" if result.time > SINCE_1970 else "duration"
            self._recording.set_time("time", **{kind: result.time})
        pinhole = rr.Pinhole(
            image_from_camera=crop_camera(result.K, -CENTRE, -CENTRE),
            resolution=result.image.shape[1::-1],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=1.5 * distance,
        )
        log("world/camera", pinhole)
        log("world/camera/image", rr.Image(result.image).compress(JPEG_QUALITY))
        log("world/camera/outlines", _outlines(result))
        log("summary", rr.TextDocument(result.summary))
        for name, belief in belief_images(self._estimator, result).items():
            log(f"beliefs/{name}", rr.Image(belief))
        # With a tracker, a detection has the same name in every frame.
        numbers = result.identities or range(len(result.detections))
        pairs = zip(result.detections, numbers, strict=True)
        named = {f"{detection.object}_{k}": detection for detection, k in pairs}
        for number, (name, detection) in enumerate(named.items()):
            self._log_part(name, detection, COLOURS[number % len(COLOURS)])
        for name in self._shown - named.keys():
            for group in GROUPS:
                log(f"world/{group}/{name}", rr.Clear(recursive=True))
        self._shown = set(named)

    def close(self) -> None:
        """Close the recording, and move the partial file to the final path."""
        if not self._is_open:
            return
        self._recording.disconnect()
        if self._path is not None and (partial := partial_path(self._path)).exists():
            partial.replace(self._path)
        self._is_open = False

    def _distance(self, result: PoseResult) -> float:
        """Return the depth of the farthest part, or of a part that fills the image, metres."""
        if result.detections:
            return max(float(detection.T_cam_obj[2, 3]) for detection in result.detections)
        largest = max(part.diameter for part in self._parts.values())
        return float(largest * result.K[0, 0] / min(result.image.shape[:2]))

    def _open(self, distance: float) -> None:
        """Open the file or window, with a 3D view from behind the camera."""
        import rerun as rr

        blueprint = _blueprint(distance)
        if self._path is not None:
            self._recording.save(partial_path(self._path), default_blueprint=blueprint)
        else:
            self._open_window(blueprint)
        self._is_open = True
        self._recording.log("world", rr.ViewCoordinates.RDF, static=True)

    def _open_window(self, blueprint: Any) -> None:
        """Open a window that other machines can neither see nor send data to."""
        viewer = [sys.executable, "-m", "rerun_cli"]
        # Disable Rerun's usage reports; `rerun analytics enable` turns them on.
        subprocess.run([*viewer, "analytics", "disable"], capture_output=True, check=False)
        with socket.socket() as free:
            free.bind((LOCALHOST, 0))
            port = free.getsockname()[1]
        viewer += ["--bind", LOCALHOST, "--port", str(port), "--memory-limit", MEMORY]
        silent = subprocess.DEVNULL
        subprocess.Popen(viewer, stdout=silent, stderr=silent, start_new_session=True)
        deadline = time.monotonic() + START_S
        while not _is_listening(port):
            if time.monotonic() > deadline:
                raise RunError("the viewer did not start; pass --rerun FILE.rrd to write a file")
            time.sleep(0.1)
        address = f"rerun+http://{LOCALHOST}:{port}/proxy"
        self._recording.connect_grpc(address, default_blueprint=blueprint)

    def _log_part(self, name: str, detection: Detection, colour: tuple[int, int, int]) -> None:
        """Log a part at its pose, and the uncertainty of its position."""
        import rerun as rr

        log, part = self._recording.log, self._parts[detection.object]
        R, t = detection.T_cam_obj[:3, :3], detection.T_cam_obj[:3, 3]
        for group in ("parts", "meshes"):
            log(f"world/{group}/{name}", rr.Transform3D(translation=t, mat3x3=R))
        if name not in self._shown:
            log(f"world/parts/{name}", rr.TransformAxes3D(AXIS * part.diameter))
            box = rr.Boxes3D(
                centers=[part.cuboid[CENTROID]],
                half_sizes=[np.ptp(part.cuboid[:CENTROID], axis=0) / 2],
                colors=[colour],
                fill_mode=rr.components.FillMode.MajorWireframe,
            )
            log(f"world/parts/{name}/cuboid", box)
            if part.mesh is not None:
                log(f"world/meshes/{name}", _mesh(part.mesh.vertices, part.mesh.faces, colour))
        variances, axes = np.linalg.eigh(detection.covariance[3:, 3:])
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        ellipsoid = rr.Ellipsoids3D(
            centers=[t],
            half_sizes=[ELLIPSOID * np.sqrt(variances.clip(0))],
            colors=[colour],
            quaternions=[np.roll(matrix_to_quaternion(axes), -1)],
            labels=[f"{detection.score:.2f}"],
        )
        log(f"world/uncertainty/{name}", ellipsoid)


def belief_images(estimator: PoseEstimator, result: PoseResult) -> Mapping[str, RGBImage]:
    """Return each part's belief, the maximum over keypoints, in colour; empty for templates.

    The network runs again, on the largest of its image sizes.
    """
    if not isinstance(estimator, NetworkEstimator):
        return {}
    view = max(estimator.views(result.image, result.K), key=lambda view: view.box.scale_x)
    beliefs = estimator.maps(view.pixels)[0].cpu().numpy()
    by_part = beliefs.reshape(len(estimator.parts), CENTROID + 1, *beliefs.shape[1:])
    levels = np.rint(255 * by_part.max(axis=1).clip(0, 1)).astype(np.uint8)
    stride = estimator.network.stride
    rows, columns = -(-view.box.height // stride), -(-view.box.width // stride)
    images = {}
    for part, level in zip(estimator.parts, levels, strict=True):
        colours = cv2.applyColorMap(level[:rows, :columns], cv2.COLORMAP_INFERNO)
        images[part.name] = np.asarray(colours[..., ::-1])
    return images


def _is_listening(port: int) -> bool:
    """Return whether a program on this machine accepts connections at a port."""
    try:
        socket.create_connection((LOCALHOST, port), 0.5).close()
    except OSError:
        return False
    return True


def _blueprint(distance: float) -> Any:
    """Return the layout: a 3D view on the left; image, belief maps and summary on the right."""
    import rerun.blueprint as rrb

    eye = rrb.EyeControls3D(
        position=distance * np.array([0.9, -0.6, -0.5]),
        look_target=distance * np.array([0.0, 0.0, 0.9]),
        eye_up=(0, -1, 0),
    )
    space = rrb.Spatial3DView(origin="world", name="space", eye_controls=eye)
    image = rrb.Spatial2DView(origin="world/camera", contents="world/camera/**", name="image")
    beliefs = rrb.Spatial2DView(origin="beliefs", name="belief maps")
    summary = rrb.TextDocumentView(origin="summary", name="summary")
    return rrb.Blueprint(
        rrb.Horizontal(space, rrb.Vertical(image, beliefs, summary, row_shares=[8, 4, 1])),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="frame"),
    )


def _outlines(result: PoseResult) -> rr.LineStrips2D:
    """Return every part's cuboid and silhouette on the image."""
    import rerun as rr

    strips, colours = [], []
    for number, detection in enumerate(result.detections):
        edges = [detection.keypoints[[a, b]] for a, b in EDGES]
        lines = [edge + CENTRE for edge in edges if np.isfinite(edge).all()]
        if (shape := result.shapes.get(detection.object)) is not None:
            contours = silhouette_contours(shape, detection.T_cam_obj, result.K, result.image)
            lines += [np.vstack([line, line[:1]])[:, 0] + CENTRE for line in contours]
        strips += lines
        colours += [COLOURS[number % len(COLOURS)]] * len(lines)
    return rr.LineStrips2D(strips, colors=colours)


def _mesh(vertices: Any, faces: Any, colour: tuple[int, int, int]) -> rr.Mesh3D:
    """Return a mesh with one normal per triangle, because flat shading shows the shape."""
    import rerun as rr

    corners = np.asarray(vertices)[np.asarray(faces)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-30)
    return rr.Mesh3D(
        vertex_positions=corners.reshape(-1, 3),
        vertex_normals=normals.repeat(3, axis=0),
        triangle_indices=np.arange(3 * len(corners)).reshape(-1, 3),
        albedo_factor=colour,
    )
