"""Files with the camera and the camera pose of each image.

- YAML with a mapping ``views`` from each image to its pose ``T_world_cam``, in one of the forms
  that :func:`parse_transform` accepts. With ``hand_eye``, a file of ``dopepp calibrate handeye``,
  images have the robot's pose ``T_base_flange`` instead. ``camera`` is a camera file, for all views
  or for a single view.
- BOP's ``scene_camera.json``, with ``cam_R_w2c`` and ``cam_t_w2c``.
- COLMAP's ``images.txt``, with ``cameras.txt`` in the same folder.

To read another format, write a function that returns :data:`CameraPoses`, and call it in
:func:`read_camera_poses`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.core.files import read_limited
from dopepp.core.json import read_json
from dopepp.core.validation import Range, check
from dopepp.core.yaml import read_yaml
from dopepp.geometry.camera import Transform, invert_transform, make_transform
from dopepp.geometry.camera_file import Camera, camera_of_fields, camera_of_text, read_camera
from dopepp.geometry.transform_file import ROUNDED, parse_transform, read_transform

FORMATS: Final = (
    "YAML with `views: {a.png: {T_world_cam: …}}`, BOP's scene_camera.json, or COLMAP's images.txt"
)
MAX_COLMAP_BYTES: Final = 64_000_000


@dataclass(frozen=True, eq=False)
class CameraPose:
    """Pose and calibration of an image's camera."""

    T_world_cam: Transform
    camera: Camera | None  # None if the file names no camera


@dataclass(frozen=True, eq=False)
class CameraPoses:
    """Camera poses and calibrations of several images, from a file."""

    poses: Mapping[str, CameraPose]  # by name of an image, with or without folders, or of a folder
    error: tuple[float, float] | None  # deviations, metres and radians; None if the file has none
    source: str  # path of the file
    are_numbered: bool = False  # whether ``poses`` has the numbers of images in place of names

    def of(self, image: Path) -> CameraPose:
        """Return the camera of an image, looked up by the image's name, folder or number.

        The file may name images with folders. A pose of an image in another folder counts if it is
        the only pose of this name, and the file has no image of the given folder.

        Raises:
            UserError: The file has no pose of the image.
        """
        parts = image.absolute().parts
        by_name = ["/".join(parts[start:]) for start in range(1, len(parts))]
        named = [name for name in self.poses if Path(name).name == image.name]
        if len(named) == 1 and all(Path(name).parent.name != parts[-2] for name in self.poses):
            by_name += named
        by_name += [image.parent.name, image.stem]
        number = image.stem.lstrip("0") or "0"
        for name in [number] if self.are_numbered else by_name:
            if name in self.poses:
                return self.poses[name]
        names = ", ".join(list(self.poses)[:5]) + ", …" * (len(self.poses) > 5)
        fix = "add the image to the file, or correct its name"
        problem = f"{self.source} without a camera pose for {image.name}"
        raise UserError(problem, names or "names of images", fix)


def read_camera_poses(path: Path) -> CameraPoses:
    """Read a file of camera poses.

    Raises:
        UserError: The file is missing, has another format, or has an invalid pose or camera.
    """
    if path.name == "scene_camera.json":
        return _bop(path)
    if path.suffix == ".txt":
        return _colmap(path)
    content = read_yaml(path)
    views = content.get("views") if isinstance(content, Mapping) else None
    if not isinstance(content, Mapping) or not isinstance(views, Mapping) or not views:
        raise UserError(
            f"{path} without camera poses", FORMATS, "write a file of one of these forms"
        )
    camera, hand_eye, error = (content.get(key) for key in ("camera", "hand_eye", "camera_error"))
    T_flange_cam = None
    if hand_eye is not None:
        T_flange_cam = read_transform(path.parent / str(hand_eye), "T_flange_cam", ROUNDED)
    pose_name = "T_world_cam" if T_flange_cam is None else "T_base_flange"
    poses = {}
    for name, view in views.items():
        fields = view if isinstance(view, Mapping) else {}
        T = parse_transform(fields.get(pose_name), f"{path}: {name}: {pose_name}")
        T_world_cam = T if T_flange_cam is None else T @ T_flange_cam
        file = fields.get("camera", camera)
        lens = None if file is None else read_camera(path.parent / str(file))
        poses[str(name)] = CameraPose(T_world_cam, lens)
    return CameraPoses(poses, None if error is None else _error(error, path), str(path))


def _error(value: object, path: Path) -> tuple[float, float]:
    """Return ``camera_error`` in metres and radians; the file states metres and degrees."""
    metres, degrees = check(f"{path}: camera_error", value, tuple[float, float], Range(0.0, 10.0))
    return metres, math.radians(degrees)


def _bop(path: Path) -> CameraPoses:
    """Read BOP's ``scene_camera.json``, whose lengths are millimetres."""
    content: Any = read_json(path)
    poses = {}
    for name, record in content.items() if isinstance(content, Mapping) else ():
        where = f"{path}: image {name}"
        try:
            R = np.array(record["cam_R_w2c"], np.float64).reshape(3, 3)
            t = np.array(record["cam_t_w2c"], np.float64).reshape(3) / 1000.0
        except (KeyError, TypeError, ValueError):
            allowed = "cam_R_w2c (9 numbers) and cam_t_w2c (3 numbers, millimetres)"
            problem = f"{where} without a valid camera pose"
            raise UserError(problem, allowed, "use a data set with camera poses") from None
        T_cam_world = parse_transform({"matrix": make_transform(R, t)}, where)
        camera = camera_of_fields({"cam_K": record.get("cam_K")}, where)
        poses[name] = CameraPose(invert_transform(T_cam_world), camera)
    return CameraPoses(poses, None, str(path), are_numbered=True)


def _colmap(path: Path) -> CameraPoses:
    """Read COLMAP's ``images.txt``, and ``cameras.txt`` next to it.

    Each image has two lines: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and its points.
    """
    lines = _lines(path)
    cameras = {
        line.split()[0]: camera_of_text(line, f"{path.with_name('cameras.txt')}")
        for line in _lines(path.with_name("cameras.txt"))
        if line
    }
    poses = {}
    for line in lines[::2]:
        words = line.split(maxsplit=9)
        if len(words) != 10 or words[8] not in cameras:
            allowed = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of points"
            raise UserError(f"{path}: {line:.100}", allowed, "export the model as text again")
        fields = {"quaternion_wxyz": words[1:5], "position": words[5:8]}
        T_cam_world = parse_transform(fields, f"{path}: {words[9]}")
        poses[words[9]] = CameraPose(invert_transform(T_cam_world), cameras[words[8]])
    return CameraPoses(poses, None, str(path))


def _lines(path: Path) -> list[str]:
    """Return the lines of a COLMAP file without comments, but with empty lines."""
    try:
        text = read_limited(path, MAX_COLMAP_BYTES).decode("utf-8")
    except (OSError, ValueError) as error:
        problem = f"{path}: {getattr(error, 'strerror', None) or error}"
        raise UserError(
            problem, FORMATS, "pass images.txt with cameras.txt in its folder"
        ) from error
    return [line.strip() for line in text.splitlines() if not line.startswith("#")]
