"""Camera files of named fields: ROS, OpenCV, BOP and NDDS, in YAML, XML or JSON.

To read a further one, add its names to the tables of :class:`_Fields`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

from dopepp.core.errors import UserError
from dopepp.core.json import parse_json
from dopepp.core.yaml import parse_yaml
from dopepp.geometry.camera import camera_matrix
from dopepp.geometry.camera_files.values import (
    FORMATS,
    UNDISTORT,
    Calibration,
    Size,
    is_number,
    matrix,
    shown,
    side_px,
)


def read_fields(text: str, path: Path) -> Calibration:
    """Read a text of named fields; the caller checks the lens."""
    if text.startswith("<"):
        content: object = _xml(text, path)
    elif text.startswith("{"):
        content = parse_json(text, str(path))
    else:
        # OpenCV begins with a line of its own, and its matrices have a tag; behind a message that
        # was echoed stands a line.
        text = re.sub(r"\A%YAML.*\n", "", text).removesuffix("---")
        content = parse_yaml(re.sub(r"!!opencv-(nd-)?matrix\b", "", text), path)
    if not isinstance(content, Mapping):
        raise UserError(f"{path} without any fields", FORMATS, "pass the camera's file")
    return find_camera(content, path)


def find_camera(content: Mapping[Any, object], source: Path | str) -> Calibration:
    """Return the camera that named fields speak of; the caller checks the lens.

    ``source`` is where they come from, for messages.
    """
    return _Fields(content, source).camera()


class _Fields:
    """Named fields, as YAML, XML and JSON have them; capitals and underscores do not matter."""

    MATRIX: Final = ("camera_matrix", "K", "intrinsic_matrix", "cam_K")
    LENS: Final = ("distortion_coefficients", "distortion_coeffs", "dist_coeffs", "distortion", "D")
    SIZE: Final = ("image_size", "resolution")
    MODELS: Final = ("plumb_bob", "rational_polynomial")

    def __init__(self, content: Mapping[Any, object], path: Path | str) -> None:
        self._path = path
        listed = content.get("camera_settings")
        if isinstance(listed, list):
            content = self._ndds(listed)
        named = ((name, value) for name, value in content.items() if isinstance(name, str))
        self._values = {_key(name): (name[:40], value) for name, value in named}

    def camera(self) -> Calibration:
        """Return the camera, its numbers unchecked but for being numbers."""
        array = self._find(*self.MATRIX)
        four = [self._find(name) for name in ("fx", "fy", "cx", "cy")]
        if array is not None:
            K = matrix(self._numbers(*array), self._where(array[0]))
        elif all(four):
            K = camera_matrix(*(self._number(*one) for one in four if one))
        else:
            has = ", ".join(name for name, _ in list(self._values.values())[:10]) or "no field"
            fix = "pass the camera's file, of one camera"
            raise UserError(f"{self._path} without camera_matrix (it has {has})", FORMATS, fix)
        lens = self._find(*self.LENS)
        distortion = () if lens is None else tuple(self._numbers(*lens))
        self._check_model(distortion)
        return Calibration(self._size(), K, distortion)

    def _ndds(self, cameras: Sequence[object]) -> Mapping[object, object]:
        """Return the one camera of ``_camera_settings.json``, flat."""
        one = cameras[0] if len(cameras) == 1 else None
        inner = one.get("intrinsic_settings") if isinstance(one, Mapping) else None
        if not isinstance(one, Mapping) or not isinstance(inner, Mapping):
            got = f"{self._path}: camera_settings of {len(cameras)} cameras"
            raise UserError(got, "one camera with intrinsic_settings", "keep one of them")
        size = one.get("captured_image_size")
        return {**inner, **(size if isinstance(size, Mapping) else {})}

    def _find(self, *names: str) -> tuple[str, object] | None:
        """Return the first field of these names that is there: how the file calls it, and it."""
        return next((self._values[_key(one)] for one in names if _key(one) in self._values), None)

    def _size(self) -> Size | None:
        both = self._find(*self.SIZE)
        if both is not None:
            sides = self._numbers(*both)
            if len(sides) != 2:
                raise UserError(f"{self._path}: {both[0]} of {len(sides)} numbers",
                                "width and height", "correct it")  # fmt: skip
            return side_px(sides[0], self._where(both[0])), side_px(sides[1], self._where(both[0]))
        width, height = (self._find(f"image_{side}", side) for side in ("width", "height"))
        if width is None and height is None:
            return None
        if width is None or height is None:
            missing = "height" if width else "width"
            raise UserError(
                f"{self._path} without image_{missing}", "both or none", f"add {missing}"
            )
        return side_px(width[1], self._where(width[0])), side_px(height[1], self._where(height[0]))

    def _check_model(self, distortion: Sequence[float]) -> None:
        """Refuse a lens that OpenCV's pinhole model does not describe."""
        fisheye, model = self._find("fisheye_model"), self._find("distortion_model")
        if fisheye is not None and fisheye[1] not in (0, "0"):
            raise UserError(self._where("fisheye_model=1"), "no fisheye lens", UNDISTORT)
        if model is None or (model[1] in (None, "") and not any(distortion)):
            return
        if model[1] not in self.MODELS:
            got = self._where(f"{model[0]}={shown(model[1])}")
            raise UserError(got, ", ".join(self.MODELS), UNDISTORT)

    def _numbers(self, name: str, value: object) -> list[float]:
        """Return an array's numbers: a list, a list of rows, or a mapping with ``data``."""
        if isinstance(value, Mapping):
            numbers = self._numbers(f"{name}.data", value.get("data"))
            rows, columns = value.get("rows"), value.get("cols")
            stated = None not in (rows, columns)
            if stated and len(numbers) != self._number(name, rows) * self._number(name, columns):
                raise UserError(
                    f"{self._where(name)} of {rows}×{columns} with {len(numbers)} numbers",
                    "as many numbers as rows × cols", "write the file again",
                )  # fmt: skip
            return numbers
        rows = value if isinstance(value, list) else [value]
        flat = [one for row in rows for one in (row if isinstance(row, list) else [row])]
        return [self._number(name, one) for one in flat]

    def _number(self, name: str, value: object) -> float:
        if not is_number(value):
            got = f"{self._where(name)}={shown(value)}"
            raise UserError(got, "finite numbers", "write it as plain numbers, without base64")
        return float(value)  # type: ignore[arg-type]

    def _where(self, name: str) -> str:
        return f"{self._path}: {name}"


def _key(name: str) -> str:
    return name.lower().replace("_", "")


def _xml(text: str, path: Path) -> dict[object, object]:
    """Return the fields of OpenCV's XML; without a document type it cannot expand anything."""
    allowed = "OpenCV's XML (opencv_storage), without DOCTYPE"
    if "<!DOCTYPE" in text:
        raise UserError(f"{path} with DOCTYPE", allowed, "write the file again")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        got = f"{path}, unreadable: {error!s:.200}"
        raise UserError(got, allowed, "write the file again") from error
    if root.tag != "opencv_storage":
        raise UserError(f"{path}: <{root.tag:.50}>", allowed, "write it with cv2.FileStorage")
    return {one.tag: {part.tag: _words(part) for part in one} or _words(one) for one in root}


def _words(element: ElementTree.Element) -> object:
    words = (element.text or "").split()
    return words[0] if len(words) == 1 else words
