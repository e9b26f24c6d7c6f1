"""Read what a damaged file still holds: every field by itself, every problem a defect."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dopepp.data.bop_images import FORMATS
from dopepp.data.checking.report import CheckReport
from dopepp.data.json_file import MAX_BYTES, parse_json
from dopepp.drawing.pictures import MAX_PIXELS, read_content, whole_picture
from dopepp.errors import UserError


def load_json(report: CheckReport, path: Path, max_bytes: int = MAX_BYTES) -> Any:
    """Read a JSON file, None where nothing can be read.

    A number that is not finite, or a key twice, is a defect that does not hide the rest.
    """
    if not path.is_file():
        report.add(path, "file", "missing")
        return None
    size = path.stat().st_size
    if size > max_bytes:
        report.add(path, "file", f"{size:,} bytes; allowed: at most {max_bytes:,}")
        return None
    return decode_json(report, path, path.read_bytes())


def decode_json(report: CheckReport, path: Path | str, content: bytes) -> Any:
    """Parse JSON, None where that is impossible."""
    try:
        return parse_json(content, str(path))
    except UserError as error:
        report.add(path, "JSON", error.got.removeprefix(f"{path}: "))
    try:
        return json.loads(content)
    except (ValueError, RecursionError):
        return None


def load_image(
    report: CheckReport, path: Path, size: tuple[int, int] | None
) -> NDArray[Any] | None:
    """Read a map of numbers from an image file as :func:`decode_map` does."""
    content = _content(report, path)
    return None if content is None else decode_map(report, path, content, size)


def load_size(report: CheckReport, path: Path) -> tuple[int, int] | None:
    """Return a picture's (width, height) as :func:`decode_size` does."""
    content = _content(report, path)
    return None if content is None else decode_size(report, path, content)


def is_colour(path: Path) -> bool:
    """Tell whether an image file states several channels; False where it states nothing."""
    try:
        with Image.open(path, formats=FORMATS) as image:
            return len(image.getbands()) > 1
    except (OSError, ValueError):
        return False


def _content(report: CheckReport, path: Path) -> bytes | None:
    try:
        return read_content(path)
    except UserError as error:
        report.add(path, "file", error.got if path.exists() else "missing")
        return None


def decode_size(report: CheckReport, path: Path | str, content: bytes) -> tuple[int, int] | None:
    """Return a picture's (width, height) after reading all of it.

    A truncated file still states its size, so that other images can be held against it; None where
    it does not.
    """
    _decode(report, path, content)
    try:
        width, height = Image.open(io.BytesIO(content), formats=FORMATS).size
    except Exception:  # said above
        return None
    return (width, height) if 0 < width * height <= MAX_PIXELS else None


_ONE_CHANNEL: Final = 2
"""Axes of an image with one channel."""


def decode_map(
    report: CheckReport, path: Path | str, content: bytes, size: tuple[int, int] | None
) -> NDArray[Any] | None:
    """Read a map of numbers (depth, mask, labels), None where that is impossible.

    Args:
        report: Takes the defects.
        path: The file's name.
        content: Its bytes.
        size: The (width, height) it must have; None for any.
    """
    image = _decode(report, path, content)
    if image is None:
        return None
    if image.ndim != _ONE_CHANNEL:
        report.add(path, "channels", f"{image.shape[2]}; allowed: one")
        return None
    if size is not None and (image.shape[1], image.shape[0]) != size:
        got = f"{image.shape[1]}×{image.shape[0]}"
        report.add(path, "size", f"{got}; the colour image has {size[0]}×{size[1]}")
        return None
    return image


def _decode(report: CheckReport, path: Path | str, content: bytes) -> NDArray[Any] | None:
    """Read a whole PNG, JPEG or TIFF within bounds."""
    try:
        return np.asarray(whole_picture(content, FORMATS))
    except ValueError as error:
        report.add(path, "image", f"unreadable or truncated, {len(content):,} bytes ({error})")
        return None


def numbers(
    report: CheckReport, path: Path | str, where: str, value: object, *shape: int
) -> NDArray[np.float64] | None:
    """Return a field's numbers in a shape, None (and a defect) where they are not that."""
    try:
        array = np.array(value)
        if array.dtype.kind not in "iuf":
            raise ValueError
        array = array.astype(np.float64).reshape(shape)
    except (ValueError, OverflowError, TypeError):
        length = int(np.prod(shape))
        got = "missing" if value is None else f"{value!r:.60}"
        report.add(path, where, f"{got}; allowed: {length} numbers")
        return None
    if not np.isfinite(array).all():
        report.add(path, where, f"not finite (NaN or infinite): {value!r:.60}")
        return None
    return array


def entries(report: CheckReport, path: Path | str, where: str, value: object) -> list[Any]:
    """Return a list's entries, none (and a defect) where it is no list of JSON objects."""
    if not isinstance(value, list):
        report.add(path, where, f"{'missing' if value is None else repr(value)[:60]}; a list")
        return []
    for number, entry in enumerate(value):
        if not isinstance(entry, dict):
            report.add(path, f"{where}[{number}]", f"{entry!r:.60}; allowed: a JSON object")
    return [entry if isinstance(entry, dict) else {} for entry in value]


def mapping(value: object) -> Mapping[str, Any]:
    """Return a JSON object, an empty one for anything else."""
    return value if isinstance(value, dict) else {}
