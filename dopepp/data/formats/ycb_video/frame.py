"""The files of one YCB-Video frame: colour, label, depth and ``meta.mat``, checked together.

YCB-Video's folder: its two subsets, its class list and its image sets.

YCB-Video's ``meta.mat``: the objects of a frame with their poses, K and depth unit, checked.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import scipy.io
from jaxtyping import Float, Integer, UInt8
from numpy.typing import NDArray

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import read_image
from dopepp.geometry.camera import camera_matrix, check_camera, make_transform
from dopepp.geometry.rotation import is_rotation

Subset = Literal["real", "synthetic"]
FOLDERS: Final[dict[Subset, str]] = {"real": "data", "synthetic": "data_syn"}
"""Where each subset's frames are."""


def read_classes(root: Path) -> list[str]:
    """Return the object names of ``image_sets/classes.txt``; a class index is the line from 1.

    Raises:
        UserError: The folder is missing, has no ``data/``, or has no class list.
    """
    layout = "a YCB-Video folder with data/, image_sets/classes.txt and models/"
    fix = "set data.root to the unpacked YCB-Video data set"
    if not root.is_dir():
        raise UserError(f"data.root={root}, which is no folder", layout, fix)
    if not (root / "data").is_dir():
        raise UserError(f"data.root={root}, which has no data/", layout, fix)
    path = root / "image_sets" / "classes.txt"
    if not path.is_file():
        raise UserError(f"data.root={root}, which has no image_sets/classes.txt", layout, fix)
    return path.read_text().split()


def read_image_set(root: Path, image_set: str, subset: Subset) -> list[str]:
    """Return a subset's frames in ``image_sets/NAME.txt``, e.g. ``0050/000003`` or ``000000``.

    Raises:
        UserError: There is no such list, or a line is no frame.
    """
    path = root / "image_sets" / f"{image_set}.txt"
    if not path.is_file():
        lists = sorted(p.stem for p in path.parent.glob("*.txt") if p.stem != "classes")
        raise UserError(f"image set {image_set!r}", f"one of {lists}", f"correct it or add {path}")
    frames = []
    for line in path.read_text().split():
        scene, _, number = line.partition("/")
        if not number.isdigit() or not (scene.isdigit() or scene == "data_syn"):
            raise UserError(
                f"{path}: line {line!r}", "SSSS/NNNNNN or data_syn/NNNNNN", "correct it"
            )
        if (scene == "data_syn") == (subset == "synthetic"):
            frames.append(number if subset == "synthetic" else line)
    return frames


_HEADER_BYTES: Final = 128
_FIELDS: Final = ("cls_indexes", "poses", "intrinsic_matrix", "factor_depth")


@dataclass(frozen=True)
class FrameMeta:
    """Ground truth of a frame.

    Attributes:
        poses: T_cam_obj of every object, by class index (from 1), metres.
        K: Camera matrix in pixels, None where the file has none.
        factor_depth: Depth image values per metre.
    """

    poses: Mapping[int, Float[np.ndarray, "4 4"]]
    K: Float[np.ndarray, "3 3"] | None
    factor_depth: float


def read_meta(path: Path) -> FrameMeta:
    """Read a ``meta.mat``.

    Raises:
        UserError: The file is missing, cut short or lacks a field, or a pose is not finite, no
            rotation, or behind the camera.
    """
    fields = _load(path)
    try:
        classes = np.asarray(fields["cls_indexes"], np.int64).ravel()
        poses = np.asarray(fields["poses"], np.float64).reshape(3, 4, -1)
        factor_depth = float(np.asarray(fields["factor_depth"]).item())
    except (KeyError, ValueError) as error:
        raise _bad(path, f"a field it lacks or that has another shape ({error})") from error
    if poses.shape[2] != len(classes) or len(set(classes.tolist())) != len(classes):
        raise _bad(path, f"{poses.shape[2]} poses for the classes {classes.tolist()}")
    if not (np.isfinite(factor_depth) and factor_depth > 0):
        raise _bad(path, f"factor_depth {factor_depth}")
    K = fields.get("intrinsic_matrix")
    return FrameMeta(
        {int(c): _pose(poses[..., i], path, int(c)) for i, c in enumerate(classes)},
        None if K is None else np.asarray(K, np.float64),
        factor_depth,
    )


def _load(path: Path) -> dict[str, NDArray[Any]]:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise _bad(path, str(error.strerror)) from error
    if not _is_complete(content):
        raise _bad(path, f"a file cut short after {len(content)} bytes")
    try:
        # vertmap and the like are megabytes that nobody needs.
        return dict(scipy.io.loadmat(path, variable_names=_FIELDS))
    except Exception as error:  # SciPy lets through whatever a damaged byte happens to cause
        raise _bad(path, f"a damaged file ({error})") from error


def _is_complete(content: bytes) -> bool:
    """Follow the MAT-5 elements (type, length, data): the last one must end where the file ends.

    SciPy reads a file that was cut off between or inside variables it is not asked for.
    """
    start = _HEADER_BYTES
    order = "<" if content[126:128] == b"IM" else ">"
    while start + 8 <= len(content):
        start += 8 + int(np.frombuffer(content, f"{order}u4", 1, start + 4)[0])
    return start == len(content) > _HEADER_BYTES


def _pose(pose: Float[np.ndarray, "3 4"], path: Path, class_index: int) -> Float[np.ndarray, "4 4"]:
    if not np.isfinite(pose).all() or not is_rotation(pose[:, :3]):
        raise _bad(path, f"a pose of class {class_index} that is no rigid transform")
    if pose[2, 3] <= 0:
        raise _bad(
            path, f"a pose of class {class_index} behind the camera (z = {pose[2, 3]:.3g} m)"
        )
    return make_transform(pose[:, :3], pose[:, 3])


def _bad(path: Path, got: str) -> UserError:
    return UserError(
        f"{path}: {got}",
        "a complete MAT-5 file with cls_indexes (N), poses (3, 4, N) before the camera and "
        "factor_depth",
        "copy or download the file again",
    )


_FIRST_SCENE_OF_SECOND_CAMERA: Final = 60
_CAMERAS: Final = (
    camera_matrix(1066.778, 1067.487, 312.9869, 241.3109),
    camera_matrix(1077.836, 1078.189, 323.7872, 279.6921),
)
"""The data set's two colour cameras: scenes 0000–0059 and data_syn, scenes 0060–0091."""


@dataclass(frozen=True)
class YcbFrame:
    """What the files of a frame hold.

    Attributes:
        image: RGB, with alpha on synthetic frames.
        label: Class index of every pixel, 0 where no object is labelled.
        depth: Metres, 0 where unknown; None where it was not asked for.
        K: Camera matrix, pixels.
        poses: T_cam_obj of every object, by class index, metres.
    """

    image: UInt8[np.ndarray, "height width channels"]
    label: Integer[np.ndarray, "height width"]
    depth: Float[np.ndarray, "height width"] | None
    K: Float[np.ndarray, "3 3"]
    poses: Mapping[int, Float[np.ndarray, "4 4"]]


def read_frame(root: Path, subset: Subset, frame: str, with_depth: bool) -> YcbFrame:
    """Read a frame, e.g. ``0050/000003`` of the real subset.

    Raises:
        UserError: A file is missing or damaged, sizes differ, or a pose or K is impossible.
    """
    start = f"{root / FOLDERS[subset] / frame}-"
    image = _read_colour(Path(start + "color.png"), alpha=subset == "synthetic")
    shape: tuple[int, int] = image.shape[:2]
    meta = read_meta(Path(start + "meta.mat"))
    depth = None
    if with_depth:
        depth = _read_map(Path(start + "depth.png"), shape) / np.float32(meta.factor_depth)
    K = _camera(subset, frame) if meta.K is None else meta.K
    return YcbFrame(
        image,
        _read_map(Path(start + "label.png"), shape),
        depth,
        check_camera(K, (shape[1], shape[0]), start + "meta.mat"),
        meta.poses,
    )


def _read_colour(path: Path, alpha: bool) -> UInt8[np.ndarray, "height width channels"]:
    image = read_image(path)
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 + alpha:
        raise UserError(
            f"image {path} of shape {image.shape}, {image.dtype}",
            f"8 bits and {3 + alpha} channels",
            "copy or download the file again",
        )
    return image


def _read_map(path: Path, shape: tuple[int, int]) -> NDArray[Any]:
    """Read an image with one channel and the colour image's (height, width)."""
    image = read_image(path)
    if image.ndim != 2:
        raise UserError(
            f"image {path} of shape {image.shape}", "one channel", "copy or download it again"
        )
    if image.shape != shape:
        raise UserError(
            f"{path} of {image.shape[1]}×{image.shape[0]} for a colour image of "
            f"{shape[1]}×{shape[0]}",
            "images of one frame of the same size",
            "copy or download the frame again",
        )
    return image


def _camera(subset: Subset, frame: str) -> Float[np.ndarray, "3 3"]:
    scene = 0 if subset == "synthetic" else int(frame.partition("/")[0])
    return _CAMERAS[scene >= _FIRST_SCENE_OF_SECOND_CAMERA]
