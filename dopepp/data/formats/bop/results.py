"""Poses as a BOP challenge CSV: written for the field's tools, read from any other method.

Lines are ``scene_id,im_id,obj_id,score,R,t,time``: R row by row and t as numbers between spaces, t
in millimetres, time in seconds for the whole image, −1 where unknown. BOP calls such a file
``METHOD_DATASET-SPLIT.csv``.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float, Int

from dopepp.core.errors import UserError
from dopepp.core.files import write_whole
from dopepp.data.formats.bop.records import MM
from dopepp.geometry.camera import Transform
from dopepp.geometry.rotation import is_rotation

FIELDS: Final = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
UNKNOWN_TIME: Final = -1.0

MAX_ROWS: Final = 500_000
"""Several times the largest submission; read, a row takes 0.8 kB."""

_MAX_LINE_BYTES: Final = 4096
"""Fourteen numbers of 25 digits take 400."""

_FARTHEST: Final = 1e9
"""Millimetres; squares of such distances stay finite."""

_PLAUSIBLE_MM: Final = (10.0, 100_000.0)
"""The median distance of objects from the camera: outside, t is hardly in millimetres."""

_LARGEST_ENTRY: Final = 2.0
"""No rotation has a number as large."""

_ID: Final = re.compile(r"\d{1,9}", re.ASCII)
_NUMBER: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True)
class PoseResult:
    """One estimated pose.

    Attributes:
        seconds: What the whole image took; −1 where unknown.
    """

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    T_cam_obj: Transform
    seconds: float = UNKNOWN_TIME


def results_name(method: str, dataset: str, split: str) -> str:
    """Return BOP's name of a results file; characters that separate its parts are replaced."""
    method = re.sub(r"[^A-Za-z0-9.+]+", "-", method).strip("-") or "method"
    dataset = re.sub(r"[^A-Za-z0-9]+", "", dataset) or "data"
    split = re.sub(r"[^A-Za-z0-9]+", "-", split).strip("-") or "test"
    return f"{method}_{dataset}-{split}.csv"


def write_results(path: Path, results: Sequence[PoseResult]) -> None:
    """Write a results file, whole, every number with all of its digits."""
    lines = [",".join(FIELDS)]
    for one in results:
        R = " ".join(repr(float(value)) for value in one.T_cam_obj[:3, :3].ravel())
        t = " ".join(repr(float(value)) for value in one.T_cam_obj[:3, 3] * MM)
        ids = f"{one.scene_id},{one.im_id},{one.obj_id}"
        lines.append(f"{ids},{float(one.score)!r},{R},{t},{float(one.seconds)!r}")
    write_whole(path, ("\n".join(lines) + "\n").encode())


def read_results(path: Path, objects: Collection[int]) -> list[PoseResult]:
    """Read a results file; the header may be missing, and blank lines do not matter.

    ``objects`` are the numbers of the data set's objects.

    Raises:
        UserError: The file is missing, not text, or has more than 500,000 poses; a line has
            another form, a number that is not finite or an unknown object; R is no rotation within
            1e-3; a line comes twice; or t is so small or large that it is not in millimetres.
    """
    ids, values = array("q"), array("d")
    for number, text in _lines(path):
        place = f"{path}: line {number}"
        ids.extend((number, *_row(text, place, objects, values)))
        if len(ids) > 4 * MAX_ROWS:
            raise _bad(f"{place}", f"at most {MAX_ROWS:,} poses", "split the file by scene")
    table = np.array(ids, np.int64).reshape(-1, 4)
    rows = np.array(values, np.float64).reshape(-1, 14)
    _check_repeats(path, table, rows)
    _check_unit(path, table[:, 0], rows[:, 10:13])
    return [_result(key, row) for key, row in zip(table[:, 1:].tolist(), rows, strict=True)]


def _result(key: list[int], row: Float[np.ndarray, "14"]) -> PoseResult:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = row[1:10].reshape(3, 3), row[10:13] / MM
    scene_id, im_id, obj_id = key
    return PoseResult(scene_id, im_id, obj_id, float(row[0]), T, float(row[13]))


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the numbered lines with poses."""
    allowed = f"a CSV file of {','.join(FIELDS)}"
    if not path.is_file():
        raise _bad(f"{path}, no such file", allowed, "check the path")
    number = 0
    with path.open("rb") as file:
        while content := file.readline(_MAX_LINE_BYTES + 1):
            number += 1
            if len(content) > _MAX_LINE_BYTES:
                got = f"{path}: line {number} of more than {_MAX_LINE_BYTES} bytes"
                raise _bad(got, allowed)
            try:
                text = content.decode("utf-8-sig" if number == 1 else "ascii").strip()
            except UnicodeDecodeError as error:
                raise _bad(f"{path}: line {number}, which is no ASCII text", allowed) from error
            is_header = number == 1 and [f.strip() for f in text.split(",")] == list(FIELDS)
            if text and not is_header:
                yield number, text
    if number == 0:
        raise _bad(f"{path}, which is empty", allowed)


def _row(text: str, place: str, objects: Collection[int], values: array[float]) -> tuple[int, ...]:
    """Append score, R, t and time to the values and return the three numbers before them."""
    fields = [field.strip() for field in text.split(",")]
    if len(fields) != len(FIELDS):
        raise _bad(f"{place} with {len(fields)} fields", f"7: {','.join(FIELDS)}")
    ids = []
    for name, field in zip(FIELDS, fields[:3], strict=False):
        if not _ID.fullmatch(field):
            raise _bad(f"{place}: {name} {field!r:.40}", "a whole number 0 – 999999999")
        ids.append(int(field))
    if ids[2] not in objects:
        known = ", ".join(map(str, sorted(objects)))
        raise _bad(f"{place}: obj_id {ids[2]}", f"the data set's objects: {known:.400}")
    for name, field, count in zip(FIELDS[3:], fields[3:], (1, 9, 3, 1), strict=True):
        numbers = _numbers(field, count, f"{place}: {name}")
        _check(name, numbers, place, field)
        values.extend(numbers)
    return tuple(ids)


def _numbers(field: str, count: int, where: str) -> list[float]:
    words = field.split()
    if len(words) != count:
        noun = "number" if count == 1 else "numbers between spaces"
        raise _bad(f"{where} with {len(words)}: {field!r:.60}", f"{count} {noun}")
    for word in words:
        if not _NUMBER.fullmatch(word) or not math.isfinite(float(word)):
            raise _bad(f"{where}: {word!r:.40}", "finite numbers")
    return [float(word) for word in words]


def _check(name: str, numbers: list[float], place: str, field: str) -> None:
    where = f"{place}: {name} {field!r:.90}"
    # Bounded before it is squared: numbers like 1e200 overflow.
    if name == "R" and not (
        max(map(abs, numbers)) < _LARGEST_ENTRY and is_rotation(np.array(numbers).reshape(3, 3))
    ):
        raise _bad(where, "a rotation matrix within 1e-3, row by row")
    if name == "t" and max(map(abs, numbers)) > _FARTHEST:
        raise _bad(where, "millimetres")
    if name == "time" and numbers[0] < 0 and numbers[0] != UNKNOWN_TIME:
        raise _bad(where, "seconds, or -1 where unknown")


def _check_repeats(
    path: Path, table: Int[np.ndarray, "rows 4"], rows: Float[np.ndarray, "rows 14"]
) -> None:
    """Refuse the same pose of the same object twice; time may differ."""
    keys = np.column_stack([table[:, 1:], rows[:, :13]])
    order = np.lexsort(keys.T[::-1])  # stable: of equal rows the earlier line stands first
    same = (keys[order[1:]] == keys[order[:-1]]).all(axis=1)
    if same.any():
        first, second = table[order[:-1][same][0], 0], table[order[1:][same][0], 0]
        raise _bad(
            f"{path}: line {second}, which repeats line {first}", "each pose once",
            "remove one: the second would count as a false positive",
        )  # fmt: skip


def _check_unit(
    path: Path, numbers: Int[np.ndarray, "rows"], t: Float[np.ndarray, "rows 3"]
) -> None:
    if not len(t):
        return
    distances = np.linalg.norm(t, axis=1)
    middle = int(np.argsort(distances, kind="stable")[len(distances) // 2])
    low, high = _PLAUSIBLE_MM
    if not low <= distances[middle] <= high:
        raise _bad(
            f"{path}: line {numbers[middle]}: t of length {distances[middle]:.4g}, half of all "
            f"lines have {'less' if distances[middle] < low else 'more'}",
            f"millimetres: a median of {low:g} – {high:g}",
            "multiply t by 1000 if it is in metres; otherwise correct its unit",
        )


def _bad(
    got: str, allowed: str, fix: str = "correct the line or write the file again"
) -> UserError:
    return UserError(got, allowed, fix)
