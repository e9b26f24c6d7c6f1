"""Parsers of camera files: named fields (ROS, OpenCV, BOP, NDDS), COLMAP and plain numbers.

The content determines the format, not the suffix. Every function returns a :data:`Calibration`,
whose lens the caller checks. Files are not trusted, so none is passed to the C++ parser
``cv2.FileStorage``.

To support another format of named fields, add its names to :func:`calibration_of_fields`; for any
other format, add a function and call it in :func:`parse_calibration`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, Final
from xml.etree import ElementTree

from dopepp.core.errors import UserError
from dopepp.core.json import parse_json
from dopepp.core.validation import Range, check, short_repr
from dopepp.core.yaml import parse_yaml
from dopepp.geometry.camera import CameraMatrix, camera_matrix, pinhole_matrix

Size = tuple[int, int]  # (width, height), pixels

FORMATS: Final = (
    "ROS camera_info, OpenCV FileStorage, BOP camera.json, COLMAP cameras.txt, "
    "3×3 numbers, or the four numbers fx fy cx cy"
)
_FORMAT_FIX: Final = "pass a file in one of these formats"
_UNDISTORT: Final = "undistort the images and pass their new K"

_SIDE: Final = Range(1, 65_536, "pixels")  # Side of a calibrated image
_COLMAP_MODELS: Final = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "FULL_OPENCV": 12,
}
"""Number of parameters of COLMAP's models that OpenCV has as well."""


Calibration = tuple[Size | None, CameraMatrix, tuple[float, ...]]
"""Image size (None if unknown), K, and distortion coefficients in OpenCV's order."""

Field = tuple[str, object]  # full name, "file: field", and value


def parse_calibration(text: str, source: str) -> Calibration:
    """Parse the text of a camera file.

    Among plain numbers, ``#`` starts a comment, and brackets and commas are ignored. ``source`` is
    the path of the file, for messages.

    Raises:
        UserError: The format is unknown, or the text does not describe exactly one camera.
    """
    lines = [line.partition("#")[0].split() for line in text.splitlines()]
    lines = [words for words in lines if words]
    if lines and all(re.fullmatch("[A-Z][A-Z_]{2,}", "".join(words[1:2])) for words in lines):
        return _colmap(lines, source)
    numbers = _floats(re.sub(r"[\[\](),;]", " ", " ".join(map(" ".join, lines))).split())
    if numbers:
        return None, _matrix(numbers, source), ()
    if text.startswith("<"):
        content: object = _xml(text, source)
    elif text.startswith("{"):
        content = parse_json(text, source)
    else:
        # OpenCV adds a %YAML line and its own tags; `rostopic echo` ends a message with ---.
        text = re.sub(r"\A%YAML.*\n", "", text).removesuffix("---")
        content = parse_yaml(re.sub(r"!!opencv-(nd-)?matrix\b", "", text), source)
    if not isinstance(content, Mapping):
        raise UserError(f"{source} without any fields", FORMATS, _FORMAT_FIX)
    return calibration_of_fields(content, source)


def _colmap(lines: Sequence[Sequence[str]], source: str) -> Calibration:
    """Parse the line CAMERA_ID MODEL WIDTH HEIGHT PARAMS[] of ``cameras.txt``."""
    if len(lines) > 1:
        numbers = ", ".join(words[0][:20] for words in lines[:10]) + ", …" * (len(lines) > 10)
        fix = "keep the line of the camera that took the image"
        raise UserError(f"{source} with {len(lines)} cameras ({numbers})", "one camera", fix)
    _, model, *rest = lines[0]
    if model not in _COLMAP_MODELS:
        allowed = ", ".join(_COLMAP_MODELS)
        raise UserError(f"{source}: camera model {model:.40}", allowed, _UNDISTORT)
    values = _floats(rest)
    if values is None or len(values) != 2 + _COLMAP_MODELS[model]:
        allowed = f"WIDTH HEIGHT and {_COLMAP_MODELS[model]} numbers after {model}"
        fix = "export the cameras from COLMAP again"
        raise UserError(f"{source}: {' '.join(rest)!r:.100}", allowed, fix)
    width, height, fx, *values = values
    has_one_focal_length = "OPENCV" not in model and model != "PINHOLE"
    fy, cx, cy, *lens = [fx, *values] if has_one_focal_length else values
    if "RADIAL" in model:
        lens += [0.0] * (4 - len(lens))
    size = _side(f"{source}: width", width), _side(f"{source}: height", height)
    # COLMAP's (0.5, 0.5) is the centre of the top-left pixel.
    return size, camera_matrix(fx, fy, cx - 0.5, cy - 0.5), tuple(lens)


def _xml(text: str, source: str) -> dict[object, object]:
    """Return the fields of OpenCV's XML; DOCTYPE is refused, because entities could expand."""
    allowed = "OpenCV's XML (opencv_storage), without DOCTYPE"
    fix = "write the file with cv2.FileStorage"
    if "<!DOCTYPE" in text:
        raise UserError(f"{source} with DOCTYPE", allowed, fix)
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        problem = f"{source}, which cannot be parsed: {error!s:.200}"
        raise UserError(problem, allowed, fix) from error
    if root.tag != "opencv_storage":
        raise UserError(f"{source}: <{root.tag:.50}>", allowed, fix)
    return {node.tag: {part.tag: _words(part) for part in node} or _words(node) for node in root}


def _words(element: ElementTree.Element) -> object:
    """Return an XML element's text as one word or a list of words."""
    words = (element.text or "").split()
    return words[0] if len(words) == 1 else words


def calibration_of_fields(content: Mapping[Any, object], source: str) -> Calibration:
    """Return the calibration in the named fields of a file or a ROS message.

    Capitals and underscores of the names do not matter.

    Raises:
        UserError: The camera matrix is missing, the lens is not OpenCV's pinhole model, or a field
            does not hold numbers.
    """
    fields = _named_fields(content, source)
    array = _find(fields, "camera_matrix", "K", "intrinsic_matrix", "cam_K")
    four = [_find(fields, name) for name in ("fx", "fy", "cx", "cy")]
    if array is not None:
        K = _matrix(_numbers(*array), array[0])
    elif all(four):
        K = camera_matrix(*(_number(*field) for field in four if field))
    else:
        names = [name.removeprefix(f"{source}: ") for name, _ in fields.values()]
        problem = f"{source} without camera_matrix (it has {', '.join(names[:10]) or 'no field'})"
        raise UserError(problem, FORMATS, f"{_FORMAT_FIX}, with one camera")
    lens = _find(
        fields, "distortion_coefficients", "distortion_coeffs", "dist_coeffs", "distortion", "D"
    )
    distortion = () if lens is None else tuple(_numbers(*lens))
    fisheye, model = _find(fields, "fisheye_model"), _find(fields, "distortion_model")
    if fisheye is not None and fisheye[1] not in (0, "0"):
        raise UserError(f"{source}: fisheye_model=1", "a camera without a fisheye lens", _UNDISTORT)
    models: tuple[object, ...] = ("plumb_bob", "rational_polynomial")
    models += () if any(distortion) else ("", None)
    if model is not None and model[1] not in models:
        allowed = "plumb_bob, rational_polynomial"
        raise UserError(f"{model[0]}={short_repr(model[1], 80)}", allowed, _UNDISTORT)
    return _size(fields, source), K, distortion


def _named_fields(content: Mapping[Any, object], source: str) -> dict[str, Field]:
    """Return the fields of a camera file by their keys (:func:`_key`)."""
    cameras = content.get("camera_settings")
    if isinstance(cameras, list):  # NDDS's ``_camera_settings.json``
        camera = cameras[0] if len(cameras) == 1 else None
        inner = camera.get("intrinsic_settings") if isinstance(camera, Mapping) else None
        if not isinstance(camera, Mapping) or not isinstance(inner, Mapping):
            problem = f"{source}: camera_settings with {len(cameras)} cameras"
            fix = "delete the other cameras from a copy of the file"
            raise UserError(problem, "one camera with intrinsic_settings", fix)
        size = camera.get("captured_image_size")
        content = {**inner, **(size if isinstance(size, Mapping) else {})}
    named = {name[:40]: value for name, value in content.items() if isinstance(name, str)}
    return {_key(name): (f"{source}: {name}", value) for name, value in named.items()}


def _find(fields: Mapping[str, Field], *names: str) -> Field | None:
    """Return the first of ``names`` that a file has, or None."""
    return next((fields[_key(name)] for name in names if _key(name) in fields), None)


def _key(name: str) -> str:
    """Return a field's name in lower case, without underscores."""
    return name.lower().replace("_", "")


def _size(fields: Mapping[str, Field], source: str) -> Size | None:
    """Return the image's size in the fields of a file; None if the file has no size."""
    both = _find(fields, "image_size", "resolution")
    if both is not None:
        name, sides = both[0], _numbers(*both)
        if len(sides) != 2:
            fix = "write the image's width and height, e.g. [640, 480]"
            raise UserError(f"{name} with {len(sides)} numbers", "two numbers", fix)
        return _side(name, sides[0]), _side(name, sides[1])
    width, height = (_find(fields, f"image_{side}", side) for side in ("width", "height"))
    if width is None and height is None:
        return None
    if width is None or height is None:
        missing = "image_height" if width else "image_width"
        allowed = "image_width and image_height, or neither"
        raise UserError(f"{source} without {missing}", allowed, f"add {missing}")
    return _side(*width), _side(*height)


def _numbers(name: str, value: object) -> list[float]:
    """Return the numbers of a list, a list of rows, or a mapping with ``data``."""
    if isinstance(value, Mapping):
        numbers = _numbers(f"{name}.data", value.get("data"))
        rows, columns = value.get("rows"), value.get("cols")
        stated = None not in (rows, columns)
        if stated and len(numbers) != _number(name, rows) * _number(name, columns):
            problem = f"{name} of {rows}×{columns} with {len(numbers)} numbers"
            raise UserError(problem, "as many numbers as rows × cols", "write the file again")
        return numbers
    rows = value if isinstance(value, list) else [value]
    flat = [entry for row in rows for entry in (row if isinstance(row, list) else [row])]
    return [_number(name, entry) for entry in flat]


def _number(name: str, value: Any) -> float:
    """Convert a number or string to a finite float."""
    numbers = None if isinstance(value, bool) else _floats([value])
    if numbers is None:
        problem = f"{name}={short_repr(value, 80)}"
        raise UserError(problem, "finite numbers", "write it as plain numbers, without base64")
    return numbers[0]


def _floats(values: Sequence[Any]) -> list[float] | None:
    """Convert numbers or strings to finite floats; return None if that is impossible."""
    try:
        numbers = [float(value) for value in values]
    except (TypeError, ValueError, OverflowError):
        return None
    return numbers if all(map(math.isfinite, numbers)) else None


def _side(name: str, value: object) -> int:
    """Return a side of the image size, a whole number of pixels."""
    number = _number(name, value)
    return check(name, int(number) if number.is_integer() else number, int, _SIDE)


def _matrix(values: Sequence[float], name: str) -> CameraMatrix:
    """Return the camera matrix of nine numbers, row by row, or of fx, fy, cx, cy."""
    if len(values) == 9:
        return pinhole_matrix([values[:3], values[3:6], values[6:]], name)  # type: ignore[arg-type]
    if len(values) != 4:
        allowed = "nine (K, row by row) or four (fx fy cx cy)"
        raise UserError(f"{name}: {len(values)} numbers", allowed, "write K as 3×3 numbers")
    return camera_matrix(*values)
