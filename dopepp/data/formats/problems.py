"""Where the problems of a data set's files go, and what every reader of them reads.

A reader is handed a :class:`Problems`: at each :class:`Place` it reports what is wrong and goes on
with a neutral value (NaN, None, an empty list). A source hands it :data:`STRICT`, which raises the
first problem; a check hands it a :class:`CheckReport`, which keeps them all. So both parse alike,
and what a check passes, a source reads. To add a layout, see :mod:`dopepp.data.check`.
"""

from __future__ import annotations

import io
import json
import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NoReturn, Protocol, TypeVar

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from PIL import Image

from dopepp.core.errors import UserError
from dopepp.core.json import MAX_BYTES, parse_json, read_json
from dopepp.drawing.pictures import MAX_PIXELS, Shape, read_content, read_image, whole_picture

_log = logging.getLogger(__name__)

MAX_KEPT: Final = 10_000
"""Defects kept in full; the rest is only counted, so that memory stays bounded."""

_LOG_EVERY: Final = 1000
"""Images between two lines of the log."""

FORMATS: Final = ("PNG", "JPEG", "TIFF")
"""Of BOP's images."""

COLOUR_MODES: Final = ("RGB", "RGBA", "L", "LA", "P", "CMYK", "YCbCr")
"""Pillow's names of the pixels that BOP's colour and grey images may have."""

FARTHEST: Final = 1e9
"""No number of a label is larger in any unit, and squares of such numbers stay exact enough."""

T = TypeVar("T")


class Problems(Protocol):
    """Takes what a reader finds wrong."""

    def report(self, path: Path | str, where: str, got: str, allowed: str = "") -> None:
        """Take a problem at a :class:`Place`; ``allowed`` is empty where ``got`` says it."""

    def take(self, path: Path | str, where: str, error: UserError) -> None:
        """Take a problem that a reader below has raised."""


class Strict:
    """Raises the first problem: what a source does."""

    def report(self, path: Path | str, where: str, got: str, allowed: str = "") -> NoReturn:
        """Raise a :class:`~dopepp.core.errors.UserError`."""
        fix = "correct the file or get it again; `dopepp check` lists all problems of a data set"
        raise UserError(": ".join(filter(None, (str(path), where.lstrip("."), got))), allowed, fix)

    def take(self, path: Path | str, where: str, error: UserError) -> NoReturn:
        """Raise the error as it is."""
        raise error


STRICT: Final = Strict()


@dataclass(frozen=True)
class Defect:
    """One thing that is wrong.

    ``path`` is below the data set's folder, a tar's member as ``TAR/MEMBER``; ``field`` is what in
    it, e.g. ``3[0].cam_R_m2c`` or ``size``.
    """

    path: str
    field: str
    message: str

    def __str__(self) -> str:
        return " ".join(f"{self.path}: {self.field}: {self.message}".split())


@dataclass
class CheckReport:
    """Keeps all problems, as defects: what a check does.

    Attributes:
        defects: The first ``MAX_KEPT`` of them, in the order in which they were found.
        counts: Defects by kind, which is the field's last part.
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

    def report(self, path: Path | str, where: str, got: str, allowed: str = "") -> None:
        """Keep a defect."""
        where = where.lstrip(".") or "top level"
        self.num_defects += 1
        self.counts[where.rpartition(".")[2]] += 1
        if len(self.defects) < MAX_KEPT:
            message = f"{got}; allowed: {allowed}" if allowed else got
            path = Path(path)
            is_inside = self.root in path.parents
            shown = path.relative_to(self.root).as_posix() if is_inside else str(path)
            self.defects.append(Defect(shown, where, message))

    def take(self, path: Path | str, where: str, error: UserError) -> None:
        """Keep an error as a defect; it need not name the file again."""
        got = error.got.rpartition(str(path))[2].lstrip(" ,:") or error.got
        got = "missing" if where == "file" else got
        self.report(path, where, got, error.allowed)

    def note(self, text: str) -> None:
        """Add what is worth knowing and no defect, once."""
        if text not in self.notes:
            self.notes.append(text)

    def count_image(self) -> None:
        """Count an image; the log tells how far it is."""
        self.num_images += 1
        if self.num_images % _LOG_EVERY == 0:
            _log.info("%s images checked, %s defects", self.num_images, self.num_defects)

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


@dataclass(frozen=True)
class Place:
    """A file or something in it, and who takes what is wrong there.

    Attributes:
        path: The file; a tar's member as ``TAR/MEMBER``.
        where: What in it, e.g. ``3[0].cam_R_m2c`` or ``size``.
    """

    problems: Problems
    path: Path | str
    where: str = ""

    def __getitem__(self, key: str | int) -> Place:
        """Return the place of an object's field, or of a list's entry."""
        step = f"[{key}]" if isinstance(key, int) else f".{key}"
        return Place(self.problems, self.path, self.where + step)

    def report(self, got: str, allowed: str = "") -> None:
        """Report a problem."""
        self.problems.report(self.path, self.where, got, allowed)

    def attempt(self, read: Callable[[], T]) -> T | None:
        """Return what a reader returns; what it raises is a problem, and None the answer."""
        is_missing = isinstance(self.path, Path) and not self.path.is_file()
        try:
            return read()
        except UserError as error:
            self.problems.take(self.path, "file" if is_missing else self.where, error)
            return None

    def load(
        self, allowed: str = "a JSON object { }", max_bytes: int = MAX_BYTES
    ) -> dict[str, Any] | None:
        """Read a JSON file whose top level is an object, None where that is impossible.

        A number that is not finite, or a key twice, is a problem that does not hide the rest.
        """
        path = Path(self.path)
        found = self["JSON"].attempt(lambda: [read_json(path, max_bytes)])
        if found is None:
            readable = path.is_file() and path.stat().st_size <= max_bytes
            content = _leniently(path.read_bytes()) if readable else None
            return content if isinstance(content, dict) else None
        if isinstance(found[0], dict):
            return found[0]
        self["top level"].report(f"{found[0]!r:.60}", allowed)
        return None

    def decode(self, content: bytes) -> Any:
        """Parse JSON as :meth:`load` does, whatever it holds."""
        found = self["JSON"].attempt(lambda: [parse_json(content, str(self.path))])
        return _leniently(content) if found is None else found[0]

    def numbers(self, value: object, *shape: int) -> Float[np.ndarray, "..."]:
        """Return a field's numbers in a shape.

        ``value`` is a number, or (nested) lists of as many as ``shape`` has, None where it is
        missing. Anything else, or what is not finite, becomes NaNs.
        """
        try:
            array = np.array(value)
            fits = array.size == np.prod(shape) and array.dtype.kind in "iuf"
        except (ValueError, OverflowError):
            fits = False
        if fits and (np.abs(array.astype(np.float64)) <= FARTHEST).all():
            return array.astype(np.float64).reshape(shape)
        got = "missing" if value is None else f"{value!r:.60}"
        if fits and not np.isfinite(array).all():
            got = f"not finite (NaN or infinite): {got}"
        noun = "number" if shape == (1,) else "numbers"
        self.report(got, f"{'×'.join(map(str, shape))} finite {noun} up to {FARTHEST:.0e}")
        return np.full(shape, np.nan)

    def scalar(self, value: object) -> float:
        """Return a field's number, NaN where it holds anything else."""
        return float(self.numbers(value, 1)[0])

    def entries(self, value: object) -> list[Any]:
        """Return a list's entries; empty ones in place of those that are no JSON objects."""
        if not isinstance(value, list):
            self.report("missing" if value is None else f"{value!r:.60}", "a list")
            return []
        for number, entry in enumerate(value):
            if not isinstance(entry, dict):
                self[number].report(f"{entry!r:.60}", "a JSON object")
        return [entry if isinstance(entry, dict) else {} for entry in value]


def _leniently(content: bytes) -> Any:
    try:
        return json.loads(content)
    except (ValueError, RecursionError):
        return None


def mapping(value: object) -> Mapping[str, Any]:
    """Return a JSON object, an empty one for anything else."""
    return value if isinstance(value, dict) else {}


def picture(
    place: Place, content: bytes | None = None, modes: Sequence[str] = ()
) -> Image.Image | None:
    """Decode a BOP image, None where it is missing, damaged, too large or of another format.

    ``content`` are its bytes, where they do not lie on the disk by themselves; ``modes`` Pillow's
    names of the pixels it may have, none for any.
    """
    if content is None:
        content = place["image"].attempt(lambda: read_content(Path(place.path)))
    if content is None:
        return None
    try:
        image = whole_picture(content, FORMATS)
    except ValueError as error:
        got = f"unreadable or truncated, {len(content):,} bytes ({error})"
        allowed = f"a whole {', '.join(FORMATS)} image of at most {MAX_PIXELS / 1e6:.0f} megapixels"
        place["image"].report(got, allowed)
        return None
    if modes and image.mode not in modes:
        place["image"].report(f"pixels of type {image.mode}", "colour or grey of 8 bits")
        return None
    return image


def picture_shape(
    place: Place, content: bytes | None = None, modes: Sequence[str] = ()
) -> tuple[int, int] | None:
    """Return a picture's (height, width) after reading all of it, as :func:`picture` does.

    A truncated file still states its size, so that other images can be held against it; None where
    it does not.
    """
    picture(place, content, modes)
    file = Path(place.path) if content is None else io.BytesIO(content)
    try:
        with Image.open(file, formats=FORMATS) as stated:
            width, height = stated.size
    except Exception:  # said above
        return None
    return (height, width) if 0 < width * height <= MAX_PIXELS else None


def read_map(path: Path, shape: Shape) -> NDArray[Any]:
    """Read a frame's map of numbers (depth, labels), of the colour image's (height, width).

    A UserError: it is missing, damaged, has several channels or another size.
    """
    image = check_map(Place(STRICT, path), shape)
    assert image is not None
    return image


def check_map(place: Place, shape: Shape | None, colour: bool = False) -> NDArray[Any] | None:
    """Read a map of YCB-Video, NDDS or FAT, None where that is impossible.

    ``shape`` is the colour image's (height, width), None for any. Where ``colour`` is allowed, a
    map of several channels, whose meaning no file states, gives None.
    """
    image = place["image"].attempt(lambda: read_image(Path(place.path)))
    if image is not None and image.ndim > 2 and colour:
        one_channel(place, image[..., 0], shape)
        return None
    return one_channel(place, image, shape)


def one_channel(
    place: Place, image: NDArray[Any] | None, shape: tuple[int, ...] | None
) -> NDArray[Any] | None:
    """Return a map of numbers (depth, mask, labels), None where it cannot be the image's.

    ``shape`` is the colour image's (height, width); None for any.
    """
    if image is None:
        return None
    if image.ndim != 2:
        place["channels"].report(f"an image of {image.shape[2]}", "one channel")
        return None
    if shape is not None and image.shape != tuple(shape[:2]):
        got = f"{image.shape[1]}×{image.shape[0]} pixels"
        place["size"].report(got, f"{shape[1]}×{shape[0]}, the colour image's size")
        return None
    return image
