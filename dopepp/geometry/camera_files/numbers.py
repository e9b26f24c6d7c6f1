"""Camera files of numbers in lines: COLMAP's ``cameras.txt``, and K alone."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from dopepp.core.errors import UserError
from dopepp.geometry.camera import camera_matrix
from dopepp.geometry.camera_files.values import UNDISTORT, Calibration, is_number, matrix, side_px

MODELS: Final = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "FULL_OPENCV": 12,
}
"""COLMAP's models that are OpenCV's, with their numbers of parameters."""

_MODEL: Final = re.compile(r"[A-Z][A-Z_]{2,}")


def read_lines(text: str, path: Path) -> Calibration | None:
    """Read a text of nothing but numbers, or of COLMAP's lines; None where it is neither.

    ``#`` begins a comment; brackets and commas between numbers do not matter.
    """
    lines = [line.partition("#")[0].split() for line in text.splitlines()]
    lines = [words for words in lines if words]
    if lines and all(len(words) > 1 and _MODEL.fullmatch(words[1]) for words in lines):
        return _colmap(lines, path)
    words = re.sub(r"[\[\](),;]", " ", " ".join(map(" ".join, lines))).split()
    if not words or not all(map(is_number, words)):
        return None
    return Calibration(None, matrix([float(word) for word in words], path))


def _colmap(lines: Sequence[Sequence[str]], path: Path) -> Calibration:
    """Read ``cameras.txt``: CAMERA_ID MODEL WIDTH HEIGHT PARAMS[], of one camera."""
    if len(lines) > 1:
        numbers = ", ".join(words[0][:20] for words in lines[:10]) + ", …" * (len(lines) > 10)
        raise UserError(
            f"{path} of {len(lines)} cameras ({numbers})", "one camera",
            "keep the line of the camera that took the picture",
        )  # fmt: skip
    _, model, *rest = lines[0]
    if model not in MODELS:
        raise UserError(f"{path}: camera model {model:.40}", ", ".join(MODELS), UNDISTORT)
    if len(rest) != 2 + MODELS[model] or not all(map(is_number, rest)):
        allowed = f"WIDTH HEIGHT and {MODELS[model]} numbers behind {model}"
        raise UserError(f"{path}: {' '.join(rest)!r:.100}", allowed, "export it again")
    size = tuple(
        side_px(one, f"{path}: {name}")
        for one, name in zip(rest, ("width", "height"), strict=False)
    )
    values = [float(word) for word in rest[2:]]
    if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        values.insert(0, values[0])
    fx, fy, cx, cy, *lens = values
    if model in ("SIMPLE_RADIAL", "RADIAL"):
        lens += [0.0] * (4 - len(lens))
    # There, (0.5, 0.5) is the centre of the top-left pixel.
    K = camera_matrix(fx, fy, cx - 0.5, cy - 0.5)
    return Calibration((size[0], size[1]), K, tuple(lens))
