"""Report problems of a data set's files: raise the first problem, or collect all problems.

A reader reports a problem at a :class:`Node` and continues with a neutral value (NaN, None, an
empty list). :class:`Problems` raises the first problem. ``dopepp check`` runs the same reader with
a :class:`CheckReport`, which collects all problems, so a data set that passes a check is readable.
"""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.core.json import MAX_BYTES, parse_json, read_json

_log = logging.getLogger(__name__)

MAX_KEPT: Final = 10_000  # stored defects, which bounds memory; further defects are only counted
FARTHEST: Final = 1e9  # in any unit; the square of an annotated number is exact enough
_IMAGES_A_LINE: Final = 1000  # images per progress line of the log

T = TypeVar("T")


class Problems:
    """Receiver of problems that raises the first problem as a UserError."""

    def report(self, path: Path | str, where: str, message: str, allowed: str = "") -> None:
        """Report a problem of the field ``where`` (or "") of a file, with the allowed values.

        Raises:
            UserError: Always; a subclass may store the problem instead.
        """
        fix = "correct the file, or copy it again; `dopepp check` lists all problems of a data set"
        parts = str(path), where.lstrip("."), message
        raise UserError(": ".join(filter(None, parts)), allowed, fix)

    def report_error(self, path: Path | str, where: str, error: UserError) -> None:
        """Report an error that a function raised while it read a file: raise or store it."""
        raise error


STRICT: Final = Problems()


@dataclass
class CheckReport(Problems):
    """Receiver of problems that collects all problems of a data set as defects.

    Attributes:
        defects: The first ``MAX_KEPT`` defects as ``FILE: FIELD: MESSAGE``, in order.
        counts: Numbers of defects by the last part of their field, e.g. ``cam_R_m2c``.
        notes: Remarks that are not defects.
    """

    root: Path
    layout: str
    num_images: int = 0
    defects: list[str] = field(default_factory=list)
    num_defects: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether the data set has no defects."""
        return self.num_defects == 0

    def report(self, path: Path | str, where: str, message: str, allowed: str = "") -> None:
        """Store a problem as a defect."""
        where = where.lstrip(".") or "top level"
        self.num_defects += 1
        self.counts[where.rpartition(".")[2]] += 1
        if len(self.defects) < MAX_KEPT:
            full_message = f"{message}; allowed: {allowed}" if allowed else message
            path = Path(path)
            is_inside = self.root in path.parents
            shown = path.relative_to(self.root).as_posix() if is_inside else str(path)
            self.defects.append(" ".join(f"{shown}: {where}: {full_message}".split()))

    def report_error(self, path: Path | str, where: str, error: UserError) -> None:
        """Store an error as a defect, without the file's name in its message."""
        message = error.got.rpartition(str(path))[2].lstrip(" ,:") or error.got
        self.report(path, where, "missing" if where == "file" else message, error.allowed)

    def note(self, text: str) -> None:
        """Add a remark that is not a defect; repeated remarks are ignored."""
        if text not in self.notes:
            self.notes.append(text)

    def count_image(self) -> None:
        """Count a checked image, and log the progress."""
        self.num_images += 1
        if self.num_images % _IMAGES_A_LINE == 0:
            _log.info("%s images checked, %s defects", self.num_images, self.num_defects)

    def lines(self, max_defects: int = 100) -> list[str]:
        """Return lines of the notes, of at most ``max_defects`` defects, and of a summary."""
        shown = self.defects[:max_defects]
        if self.num_defects > len(shown):
            shown.append(f"… and {self.num_defects - len(shown):,} more")
        kinds = ", ".join(f"{kind} {number:,}" for kind, number in self.counts.most_common())
        summary = (
            f"{self.root}: {self.layout}, {self.num_images:,} images, "
            f"{self.num_defects:,} defects{f' ({kinds})' if kinds else ''}"
        )
        return [*(f"note: {note}" for note in self.notes), *shown, summary]


@dataclass(frozen=True)
class Node:
    """A file or a field of a file, with the receiver of its problems.

    Attributes:
        path: The file; a member of a tar file as ``TAR/MEMBER``.
        where: The field, e.g. ``3[0].cam_R_m2c`` or ``size``; empty for the whole file.
    """

    problems: Problems
    path: Path | str
    where: str = ""

    def __getitem__(self, key: str | int) -> Node:
        """Return the node of a mapping's field, or of a list's entry."""
        step = f"[{key}]" if isinstance(key, int) else f".{key}"
        return Node(self.problems, self.path, self.where + step)

    def report(self, message: str, allowed: str = "") -> None:
        """Report a problem of this file or field."""
        self.problems.report(self.path, self.where, message, allowed)

    def attempt(self, read: Callable[[], T]) -> T | None:
        """Return the result of ``read``; report its UserError and return None."""
        is_missing = isinstance(self.path, Path) and not self.path.is_file()
        try:
            return read()
        except UserError as error:
            self.problems.report_error(self.path, "file" if is_missing else self.where, error)
            return None

    def load(
        self, allowed: str = "a JSON object { }", max_bytes: int = MAX_BYTES
    ) -> dict[str, Any] | None:
        """Read a JSON file whose top level is an object; report any other file and return None.

        Numbers that are not finite and repeated keys are reported, and the rest is read.
        """
        path = Path(self.path)
        strict = self["JSON"].attempt(lambda: [read_json(path, max_bytes)])
        if strict is not None:
            content = strict[0]
        elif path.is_file() and path.stat().st_size <= max_bytes:
            content = _parse_leniently(path.read_bytes())
        else:
            return None
        if isinstance(content, dict):
            return content
        if strict is not None:
            self["top level"].report(f"{content!r:.60}", allowed)
        return None

    def decode(self, content: bytes) -> Any:
        """Parse JSON like :meth:`load`, with any top level."""
        strict = self["JSON"].attempt(lambda: [parse_json(content, str(self.path))])
        return _parse_leniently(content) if strict is None else strict[0]

    def numbers(self, value: object, *shape: int) -> Float[np.ndarray, "..."]:
        """Return a number, or (nested) lists of numbers, as an array of ``shape``.

        Another value is reported and gives NaN. Lists of another shape with as many numbers are
        accepted; None is a missing field.
        """
        try:
            array = np.array(value)
            fits = array.size == np.prod(shape) and array.dtype.kind in "iuf"
        except (ValueError, OverflowError):
            fits = False
        if fits and (np.abs(array.astype(np.float64)) <= FARTHEST).all():
            return array.astype(np.float64).reshape(shape)
        message = "missing" if value is None else f"{value!r:.60}"
        if fits and not np.isfinite(array).all():
            message = f"not finite (NaN or infinite): {message}"
        noun = "number" if shape == (1,) else "numbers"
        self.report(message, f"{'×'.join(map(str, shape))} finite {noun} up to {FARTHEST:.0e}")
        return np.full(shape, np.nan)

    def scalar(self, value: object) -> float:
        """Return a field's number; report any other value and return NaN."""
        return float(self.numbers(value, 1)[0])

    def entries(self, value: object) -> list[Any]:
        """Return a list's JSON objects; report other entries and replace them by empty objects."""
        if not isinstance(value, list):
            self.report("missing" if value is None else f"{value!r:.60}", "a list")
            return []
        for number, entry in enumerate(value):
            if not isinstance(entry, dict):
                self[number].report(f"{entry!r:.60}", "a JSON object")
        return [mapping(entry) for entry in value]


def _parse_leniently(content: bytes) -> Any:
    """Parse JSON, also with repeated keys and NaN; return None for other invalid JSON."""
    try:
        return json.loads(content)
    except (ValueError, RecursionError):
        return None


def mapping(value: object) -> Mapping[str, Any]:
    """Return a JSON object, or an empty object for any other value."""
    return value if isinstance(value, dict) else {}
