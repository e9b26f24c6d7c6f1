"""The files of one YCB-Video frame: colour, label, depth and ``meta.mat``, checked together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Integer, UInt8
from numpy.typing import NDArray

from dopepp.data.ycb_layout import FOLDERS, Subset
from dopepp.data.ycb_meta import read_meta
from dopepp.drawing.pictures import read_image
from dopepp.errors import UserError
from dopepp.geometry.camera import camera_matrix, check_camera

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
