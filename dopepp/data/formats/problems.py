"""Read what a damaged file still holds: every field by itself, every problem a defect.

What a check found: defects, each with file and field, and notes that are no defects.
"""

from __future__ import annotations

import io
import json
import logging
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dopepp.core.errors import UserError
from dopepp.core.json import MAX_BYTES, parse_json
from dopepp.data.formats.bop.images import FORMATS
from dopepp.drawing.pictures import MAX_PIXELS, read_content, whole_picture

_log = logging.getLogger(__name__)

MAX_KEPT: Final = 10_000
"""Defects kept in full; the rest is only counted, so that memory stays bounded."""

_LOG_EVERY: Final = 1000
"""Images between two lines of the log."""


@dataclass(frozen=True)
class Defect:
    """One thing that is wrong.

    Attributes:
        path: The file, below the data set's folder; a tar's member as ``TAR/MEMBER``.
        field: What in it, e.g. ``3[0].cam_R_m2c`` or ``size``.
        message: What was found and what is allowed.
    """

    path: str
    field: str
    message: str

    def __str__(self) -> str:
        """Return one line."""
        return " ".join(f"{self.path}: {self.field}: {self.message}".split())


@dataclass
class CheckReport:
    """The result of a check.

    Attributes:
        root: The folder.
        layout: Which layout was found, e.g. ``BOP``.
        num_images: Images that were looked at.
        defects: The first ``MAX_KEPT`` of them, in the order in which they were found.
        num_defects: All of them.
        counts: Defects by kind, which is the field's last part.
        notes: What is worth knowing and no defect.
    """

    root: Path
    layout: str
    num_images: int = 0
    defects: list[Defect] = field(default_factory=list)
    num_defects: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return self.num_defects == 0

    def add(self, path: Path | str, where: str, message: str) -> None:
        """Add a defect."""
        where = where.lstrip(".") or "top level"
        self.num_defects += 1
        self.counts[where.rpartition(".")[2]] += 1
        if len(self.defects) < MAX_KEPT:
            self.defects.append(Defect(self._relative(path), where, message))

    def note(self, text: str) -> None:
        """Add what is worth knowing and no defect, once."""
        if text not in self.notes:
            self.notes.append(text)

    def count_image(self) -> None:
        """Count an image; the log tells how far it is."""
        self.num_images += 1
        if self.num_images % _LOG_EVERY == 0:
            _log.info("%s images checked, %s defects", self.num_images, self.num_defects)

    def _relative(self, path: Path | str) -> str:
        path = Path(path)
        return path.relative_to(self.root).as_posix() if self.root in path.parents else str(path)

    def lines(self, most: int = 100) -> list[str]:
        """Return the notes, at most ``most`` defects, and a summary, a line each."""
        shown = [str(defect) for defect in self.defects[:most]]
        if self.num_defects > len(shown):
            shown.append(f"… and {self.num_defects - len(shown):,} more")
        kinds = ", ".join(f"{kind} {number:,}" for kind, number in self.counts.most_common())
        summary = (
            f"{self.root}: {self.layout}, {self.num_images:,} images, "
            f"{self.num_defects:,} defects{f' ({kinds})' if kinds else ''}"
        )
        return [*(f"note: {note}" for note in self.notes), *shown, summary]


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
