"""Read the files of YCB-Video: lists of classes and frames, a frame's images and ``meta.mat``."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import scipy.io
from jaxtyping import UInt8
from numpy.typing import NDArray

from dopepp.core.errors import UserError
from dopepp.core.files import read_limited
from dopepp.data.formats.images import header_shape, read_map
from dopepp.data.formats.invariants import rotation_problem
from dopepp.data.formats.problems import STRICT, Node, Problems
from dopepp.drawing.pictures import Shape, read_image
from dopepp.geometry.camera import CameraMatrix, Transform, make_transform

Subset = Literal["real", "synthetic"]
FOLDERS: Final[dict[Subset, str]] = {"real": "data", "synthetic": "data_syn"}
"""Folder of each subset's frames."""


def read_classes(root: Path) -> list[str]:
    """Return the names in ``image_sets/classes.txt``; a class index is the 1-based line number.

    Raises:
        UserError: The folder is not one of YCB-Video.
    """
    path = root / "image_sets" / "classes.txt"
    if not (path.is_file() and (root / "data").is_dir()):
        lacking = "image_sets/classes.txt" if (root / "data").is_dir() else "data/"
        allowed = "a YCB-Video folder with data/, image_sets/classes.txt and models/"
        fix = "set data.root to the unpacked YCB-Video data set"
        raise UserError(f"data.root={root}, which has no {lacking}", allowed, fix)
    return path.read_text().split()


def read_image_set(root: Path, image_set: str, subset: Subset) -> list[str]:
    """Return a subset's frames in ``image_sets/NAME.txt``, e.g. ``0050/000003`` or ``000000``.

    Raises:
        UserError: There is no such file, or a line does not name a frame.
    """
    path = root / "image_sets" / f"{image_set}.txt"
    if not path.is_file():
        lists = sorted(p.stem for p in path.parent.glob("*.txt") if p.stem != "classes")
        fix = f"set data.image_sets to one of these names, or add {path}"
        raise UserError(f"image set {image_set!r}", f"one of {lists}", fix)
    frames = []
    for line in path.read_text().split():
        scene, _, number = line.partition("/")
        if not number.isdigit() or not (scene.isdigit() or scene == "data_syn"):
            allowed = "SSSS/NNNNNN or data_syn/NNNNNN"
            raise UserError(f"{path}: line {line!r}", allowed, "correct this line")
        if (scene == "data_syn") == (subset == "synthetic"):
            frames.append(number if subset == "synthetic" else line)
    return frames


_HEADER_BYTES: Final = 128
_MAX_META_BYTES: Final = 256_000_000
_COMPRESSED: Final = 15  # type of an element (miCOMPRESSED)
_MAX_NAME_BYTES: Final = 1024  # SciPy permits 32 dimensions before the name
_MAX_FIELD_BYTES: Final = 1_000_000  # a pose takes 96 bytes
_FIELDS: Final = ("cls_indexes", "poses", "intrinsic_matrix", "factor_depth")
_ALLOWED: Final = (
    "a complete MAT-5 file with cls_indexes (N), poses (3, 4, N) before the camera and factor_depth"
)


@dataclass(frozen=True)
class FrameMeta:
    """Ground truth of a frame.

    Attributes:
        poses: T_cam_obj by class index (from 1), metres; NaN in a damaged pose.
        columns: Index of the pose in the file's ``poses``, by class index.
        K: Camera matrix in pixels; None if the file does not state it.
        factor_depth: Units of the depth image per metre; NaN if damaged.
    """

    poses: Mapping[int, Transform]
    columns: Mapping[int, int]
    K: CameraMatrix | None
    factor_depth: float


def read_meta(path: Path, problems: Problems = STRICT) -> FrameMeta:
    """Read a ``meta.mat`` and report its problems.

    Problems are a missing or truncated file, a missing field, and a pose that is not finite, not
    rigid, or behind the camera.
    """
    node = Node(problems, path)
    fields = _load(path, node["file"])
    if fields is None:
        return FrameMeta({}, {}, None, np.nan)
    for name in ("cls_indexes", "poses", "factor_depth"):
        if name not in fields:
            node[name].report("missing", _ALLOWED)
    factor_depth, K = np.nan, None
    if "factor_depth" in fields:
        factor_depth = node["factor_depth"].scalar(fields["factor_depth"])
    if factor_depth <= 0:
        node["factor_depth"].report(f"{factor_depth:g}", "above 0")
    if "intrinsic_matrix" in fields:
        K = node["intrinsic_matrix"].numbers(fields["intrinsic_matrix"], 3, 3)
    poses: dict[int, Transform] = {}
    columns: dict[int, int] = {}
    for column, (index, pose) in enumerate(_columns(node, fields)):
        if index in poses:
            node["cls_indexes"][column].report(f"class {index} twice", "each class once")
            continue
        poses[index] = _pose(pose, node["poses"][column])
        columns[index] = column
    return FrameMeta(poses, columns, K, factor_depth)


def _load(path: Path, node: Node) -> dict[str, NDArray[Any]] | None:
    """Read the ``_FIELDS`` of a ``meta.mat``; report an unreadable file and return None."""
    try:
        content = read_limited(path, _MAX_META_BYTES)
    except (OSError, ValueError) as error:
        node.report(str(getattr(error, "strerror", None) or error), _ALLOWED)
        return None
    if not _is_complete(content):
        node.report(f"cut short after {len(content)} bytes", _ALLOWED)
    try:
        if all(map(_is_small, _elements(content))):
            # The other fields, e.g. vertmap, are large and not needed.
            return dict(scipy.io.loadmat(path, variable_names=_FIELDS))
    except Exception as error:  # damage makes SciPy raise any type
        node.report(f"damaged ({error})", _ALLOWED)
        return None
    node.report(f"a field of over {_MAX_FIELD_BYTES / 1e6:.0f} MB", _ALLOWED)
    return None


def _is_complete(content: bytes) -> bool:
    """Return whether the last MAT-5 element (type, length, data) ends where the file ends."""
    # SciPy accepts a file that is truncated between or inside other variables.
    return (
        _HEADER_BYTES + sum(8 + size for _, _, size in _elements(content))
        == len(content)
        > _HEADER_BYTES
    )


def _elements(content: bytes) -> Iterator[tuple[int, memoryview, int]]:
    """Yield the type, the data and the stated number of bytes of each MAT-5 element."""
    start, order = _HEADER_BYTES, "<" if content[126:128] == b"IM" else ">"
    while start + 8 <= len(content):
        kind, size = map(int, np.frombuffer(content, f"{order}u4", 2, start))
        start += 8
        yield kind, memoryview(content)[start : start + size], size
        start += size


def _is_small(element: tuple[int, memoryview, int]) -> bool:
    """Return whether SciPy can unpack an element with one of ``_FIELDS`` in little memory."""
    kind, data, _ = element
    if kind != _COMPRESSED:
        return True
    unpacker = zlib.decompressobj()
    start = unpacker.decompress(data, _MAX_NAME_BYTES)
    if any(name.encode() in start for name in _FIELDS):
        unpacker.decompress(unpacker.unconsumed_tail, _MAX_FIELD_BYTES)
        return not unpacker.unconsumed_tail
    return True


def _columns(node: Node, fields: Mapping[str, NDArray[Any]]) -> list[tuple[int, NDArray[Any]]]:
    """Return each object's class index and 3×4 pose, or [] if the two fields do not match."""
    if "cls_indexes" not in fields or "poses" not in fields:
        return []
    values = np.asarray(fields["cls_indexes"])
    indices = node["cls_indexes"].numbers(values, values.size)
    fractional = indices[indices % 1 != 0]
    if np.isfinite(fractional).any():
        node["cls_indexes"].report(f"{fractional.tolist()!r:.60}", "whole numbers")
    stack = np.asarray(fields["poses"])
    stack = stack[..., None] if stack.shape == (3, 4) else stack  # MATLAB drops a last axis of 1
    if stack.shape != (3, 4, len(indices)):
        node["poses"].report(f"shape {stack.shape} for {len(indices)} classes", "(3, 4, N)")
    elif not len(fractional):
        return [(int(index), stack[..., n]) for n, index in enumerate(indices)]
    return []


def _pose(value: NDArray[Any], node: Node) -> Transform:
    """Return a 3×4 pose as a rigid transform; report an invalid pose and fill it with NaN."""
    pose = node.numbers(value, 3, 4)
    if problem := rotation_problem(pose[:, :3]):
        node["R"].report(problem, "a rigid transform")
        pose[:, :3] = np.nan
    if pose[2, 3] <= 0:
        node["z"].report(f"behind the camera (z = {pose[2, 3]:.3g} m)", "above 0")
        pose[:, 3] = np.nan
    return make_transform(pose[:, :3], pose[:, 3])


@dataclass(frozen=True)
class YcbFrame:
    """The files of a frame; None for an unreadable file.

    Attributes:
        image: RGB, with alpha in a synthetic frame.
        shape: (height, width), from the header if the image is damaged.
        depth: Units of ``1 / factor_depth`` metres.
        labels: Class index of each pixel; 0 is the background.
    """

    image: UInt8[np.ndarray, "height width channels"] | None
    shape: Shape | None
    meta: FrameMeta
    depth: NDArray[Any] | None
    labels: NDArray[Any] | None


def read_frame(
    start: str, subset: Subset, problems: Problems = STRICT, read_depth: bool = True
) -> YcbFrame:
    """Read the frame whose paths start with ``start``, e.g. ``data/0000/000001``."""
    colour, depth, label = (
        Node(problems, Path(f"{start}-{name}.png")) for name in ("color", "depth", "label")
    )
    path = Path(colour.path)
    image = colour["image"].attempt(lambda: _read_colour(path, alpha=subset == "synthetic"))
    shape: Shape | None = header_shape(path) if image is None else image.shape[:2]
    meta = read_meta(Path(f"{start}-meta.mat"), problems)
    units = read_map(depth, shape) if read_depth else None
    return YcbFrame(image, shape, meta, units, read_map(label, shape))


def _read_colour(path: Path, alpha: bool) -> UInt8[np.ndarray, "height width channels"]:
    image = read_image(path)
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 + alpha:
        problem, allowed = f"shape {image.shape}, {image.dtype}", f"8 bits and {3 + alpha} channels"
        raise UserError(f"image {path} of {problem}", allowed, "copy or download the file again")
    return image
