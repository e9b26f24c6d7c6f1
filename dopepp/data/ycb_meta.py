"""YCB-Video's ``meta.mat``: the objects of a frame with their poses, K and depth unit, checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import scipy.io
from jaxtyping import Float
from numpy.typing import NDArray

from dopepp.errors import UserError
from dopepp.geometry.camera import make_transform
from dopepp.geometry.rotation import is_rotation

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
