"""YCB-Video's folder and the files of one frame: colour, label, depth and ``meta.mat``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import scipy.io
from jaxtyping import Integer, UInt8
from numpy.typing import NDArray

from dopepp.core.errors import UserError
from dopepp.data.formats.problems import STRICT, Problems, numbers, read_map, scalar
from dopepp.data.formats.tolerances import rotation_problem
from dopepp.drawing.pictures import DepthMap, Shape, read_image
from dopepp.geometry.camera import (
    CameraMatrix,
    Transform,
    camera_matrix,
    check_camera,
    make_transform,
)

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
_MAX_META_BYTES: Final = 256_000_000
_FIELDS: Final = ("cls_indexes", "poses", "intrinsic_matrix", "factor_depth")
_ALLOWED: Final = (
    "a complete MAT-5 file with cls_indexes (N), poses (3, 4, N) before the camera and factor_depth"
)


@dataclass(frozen=True)
class FrameMeta:
    """Ground truth of a frame.

    Attributes:
        poses: T_cam_obj of every object, by class index (from 1), metres; with NaN where damaged.
        columns: Where each of them stands in the file's ``poses``.
        K: Camera matrix in pixels, None where the file has none.
    """

    poses: Mapping[int, Transform]
    columns: Mapping[int, int]
    K: CameraMatrix | None
    factor_depth: float


def read_meta(path: Path, problems: Problems = STRICT) -> FrameMeta:
    """Read a ``meta.mat``.

    A file that is missing, cut short or lacks a field, and a pose that is not finite, no rotation,
    or behind the camera, is a problem.
    """
    fields = _load(path, problems)
    if fields is None:
        return FrameMeta({}, {}, None, np.nan)
    for name in ("cls_indexes", "poses", "factor_depth"):
        if name not in fields:
            problems.report(path, name, "missing", _ALLOWED)
    factor_depth = np.nan
    if "factor_depth" in fields:
        factor_depth = scalar(problems, path, "factor_depth", fields["factor_depth"])
    if factor_depth <= 0:
        problems.report(path, "factor_depth", f"{factor_depth:g}", "above 0")
    K = fields.get("intrinsic_matrix")
    poses: dict[int, Transform] = {}
    columns: dict[int, int] = {}
    for column, (index, pose) in enumerate(_columns(path, fields, problems)):
        if index in poses:
            problems.report(path, f"cls_indexes[{column}]", f"class {index} twice", "each once")
            continue
        poses[index] = _pose(pose, path, f"poses[{column}]", problems)
        columns[index] = column
    return FrameMeta(
        poses,
        columns,
        None if K is None else numbers(problems, path, "intrinsic_matrix", K, 3, 3),
        factor_depth,
    )


def _load(path: Path, problems: Problems) -> dict[str, NDArray[Any]] | None:
    try:
        size = path.stat().st_size
        content = path.read_bytes() if size <= _MAX_META_BYTES else None
    except OSError as error:
        problems.report(path, "file", str(error.strerror), _ALLOWED)
        return None
    if content is None:
        allowed = f"at most {_MAX_META_BYTES:,}"
        problems.report(path, "file", f"{size:,} bytes", allowed)
        return None
    if not _is_complete(content):
        problems.report(path, "file", f"cut short after {size} bytes", _ALLOWED)
    try:
        # vertmap and the like are megabytes that nobody needs.
        return dict(scipy.io.loadmat(path, variable_names=_FIELDS))
    except Exception as error:  # SciPy lets through whatever a damaged byte happens to cause
        problems.report(path, "file", f"damaged ({error})", _ALLOWED)
        return None


def _is_complete(content: bytes) -> bool:
    """Follow the MAT-5 elements (type, length, data): the last one must end where the file ends."""
    # SciPy reads a file that was cut off between or inside variables it is not asked for.
    start = _HEADER_BYTES
    order = "<" if content[126:128] == b"IM" else ">"
    while start + 8 <= len(content):
        start += 8 + int(np.frombuffer(content, f"{order}u4", 1, start + 4)[0])
    return start == len(content) > _HEADER_BYTES


def _columns(
    path: Path, fields: Mapping[str, NDArray[Any]], problems: Problems
) -> list[tuple[int, NDArray[Any]]]:
    """Return each object's class index and 3×4 pose, none where the two fields do not match."""
    if "cls_indexes" not in fields or "poses" not in fields:
        return []
    stored = np.asarray(fields["cls_indexes"])
    indices = numbers(problems, path, "cls_indexes", stored, stored.size)
    odd = indices[indices % 1 != 0]
    if np.isfinite(odd).any():
        problems.report(path, "cls_indexes", f"{odd.tolist()!r:.60}", "whole numbers")
    stack = np.asarray(fields["poses"])
    stack = stack[..., None] if stack.shape == (3, 4) else stack  # MATLAB drops a last axis of 1
    if stack.shape != (3, 4, len(indices)):
        got = f"shape {stack.shape} for {len(indices)} classes"
        problems.report(path, "poses", got, "(3, 4, N)")
    elif not len(odd):
        return [(int(index), stack[..., n]) for n, index in enumerate(indices)]
    return []


def _pose(value: NDArray[Any], path: Path, where: str, problems: Problems) -> Transform:
    pose = numbers(problems, path, where, value, 3, 4)
    if problem := rotation_problem(pose[:, :3]):
        problems.report(path, f"{where}.R", problem, "a rigid transform")
        pose[:, :3] = np.nan
    if pose[2, 3] <= 0:
        got = f"behind the camera (z = {pose[2, 3]:.3g} m)"
        problems.report(path, f"{where}.z", got, "above 0")
        pose[:, 3] = np.nan
    return make_transform(pose[:, :3], pose[:, 3])


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
        poses: T_cam_obj of every object, by class index, metres.
    """

    image: UInt8[np.ndarray, "height width channels"]
    label: Integer[np.ndarray, "height width"]
    depth: DepthMap | None
    K: CameraMatrix
    poses: Mapping[int, Transform]


def read_frame(root: Path, subset: Subset, frame: str, with_depth: bool) -> YcbFrame:
    """Read a frame, e.g. ``0050/000003`` of the real subset.

    Raises:
        UserError: A file is missing or damaged, sizes differ, or a pose or K is impossible.
    """
    start = f"{root / FOLDERS[subset] / frame}-"
    image = _read_colour(Path(start + "color.png"), alpha=subset == "synthetic")
    shape: Shape = image.shape[:2]
    meta = read_meta(Path(start + "meta.mat"))
    depth = None
    if with_depth:
        depth = read_map(Path(start + "depth.png"), shape) / np.float32(meta.factor_depth)
    K = _camera(subset, frame) if meta.K is None else meta.K
    return YcbFrame(
        image,
        read_map(Path(start + "label.png"), shape),
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


def _camera(subset: Subset, frame: str) -> CameraMatrix:
    scene = 0 if subset == "synthetic" else int(frame.partition("/")[0])
    return _CAMERAS[scene >= _FIRST_SCENE_OF_SECOND_CAMERA]
