"""Write poses as a BOP challenge CSV, and read the CSV of any method.

Lines are ``scene_id,im_id,obj_id,score,R,t,time``. R (row by row) and t (millimetres) are numbers
between spaces; time is in seconds for the whole image, −1 if unknown.
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
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.core.files import write_file
from dopepp.data.formats.bop import MM
from dopepp.geometry.camera import Transform
from dopepp.geometry.rotation import is_rotation

FIELDS: Final = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
UNKNOWN_TIME: Final = -1.0

MAX_ROWS: Final = 500_000  # several times the largest submission; a row takes 0.8 kB of memory
_MAX_LINE_BYTES: Final = 4096  # fourteen numbers of 25 digits take 400
_FARTHEST: Final = 1e9  # mm; the square is finite
_PLAUSIBLE_MM: Final = (10.0, 100_000.0)
"""Range of the median distance from the camera; a median outside means another unit."""

_COUNTS: Final = {"score": 1, "R": 9, "t": 3, "time": 1}
Table = Float[np.ndarray, "rows 18"]
"""Per pose, the number of its line in the file and the line's 17 numbers."""

_ID: Final = re.compile(r"\d{1,9}", re.ASCII)
_NUMBER: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True)
class BopResult:
    """An estimated pose, metres; ``seconds`` is the time for the whole image, −1 if unknown."""

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    T_cam_obj: Transform
    seconds: float = UNKNOWN_TIME


def results_name(method: str, dataset: str, split: str) -> str:
    """Return BOP's name of a results file, with separators in the three parts replaced."""
    method = re.sub(r"[^A-Za-z0-9.+]+", "-", method).strip("-") or "method"
    dataset = re.sub(r"[^A-Za-z0-9]+", "", dataset) or "data"
    split = re.sub(r"[^A-Za-z0-9]+", "-", split).strip("-") or "test"
    return f"{method}_{dataset}-{split}.csv"


def write_results(path: Path, results: Sequence[BopResult]) -> None:
    """Write a results file atomically, each number with all of its digits."""
    lines = [",".join(FIELDS)]
    for result in results:
        R = " ".join(repr(float(value)) for value in result.T_cam_obj[:3, :3].ravel())
        t = " ".join(repr(float(value)) for value in result.T_cam_obj[:3, 3] * MM)
        ids = f"{result.scene_id},{result.im_id},{result.obj_id}"
        lines.append(f"{ids},{float(result.score)!r},{R},{t},{float(result.seconds)!r}")
    write_file(path, ("\n".join(lines) + "\n").encode())


def read_results(path: Path, objects: Collection[int]) -> list[BopResult]:
    """Read a results file; the header is optional, and blank lines are skipped.

    Raises:
        UserError: The file is missing, not text, or has more than 500,000 poses; a line is damaged
            or repeated, or its object is not in ``objects``; R is not a rotation within 1e-3; or t
            is not in millimetres.
    """
    values = array("d")
    for number, text in _lines(path):
        where = f"{path}: line {number}"
        values.extend((number, *_row(text, where, objects)))
        if len(values) > 18 * MAX_ROWS:
            raise _error(where, f"at most {MAX_ROWS:,} poses", "split the file by scene")
    table = np.array(values, np.float64).reshape(-1, 18)
    _check_repeats(path, table)
    _check_unit(path, table)
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = table[:, 5:14].reshape(-1, 3, 3), table[:, 14:17] / MM
    return [
        BopResult(int(row[1]), int(row[2]), int(row[3]), float(row[4]), T, float(row[17]))
        for row, T in zip(table, poses, strict=True)
    ]


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    allowed = f"a CSV file of {','.join(FIELDS)}"
    if not path.is_file():
        raise _error(f"{path}, no such file", allowed, "pass the path of an existing file")
    number = 0
    with path.open("rb") as file:
        while content := file.readline(_MAX_LINE_BYTES + 1):
            number += 1
            if len(content) > _MAX_LINE_BYTES:
                problem = f"{path}: line {number} of more than {_MAX_LINE_BYTES} bytes"
                raise _error(problem, allowed)
            try:
                text = content.decode("utf-8-sig" if number == 1 else "ascii").strip()
            except UnicodeDecodeError as error:
                raise _error(f"{path}: line {number}, which is not ASCII text", allowed) from error
            is_header = number == 1 and [f.strip() for f in text.split(",")] == list(FIELDS)
            if text and not is_header:
                yield number, text
    if number == 0:
        raise _error(f"{path}, which is empty", allowed)


def _row(text: str, where: str, objects: Collection[int]) -> list[float]:
    fields = [field.strip() for field in text.split(",")]
    if len(fields) != len(FIELDS):
        raise _error(f"{where} with {len(fields)} fields", f"7: {','.join(FIELDS)}")
    numbers: list[float] = []
    for name, field in zip(FIELDS, fields, strict=True):
        if not name.endswith("_id"):
            numbers += _numbers(name, field, where)
        elif _ID.fullmatch(field):
            numbers.append(int(field))
        else:
            raise _error(f"{where}: {name} {field!r:.40}", "a whole number 0 – 999999999")
        if name == "obj_id" and numbers[-1] not in objects:
            listed = ", ".join(map(str, sorted(objects)))
            raise _error(f"{where}: obj_id {field}", f"the data set's objects: {listed:.400}")
    return numbers


def _numbers(name: str, field: str, where: str) -> list[float]:
    words, count = field.split(), _COUNTS[name]
    if len(words) != count:
        noun = "number" if count == 1 else "numbers between spaces"
        raise _error(f"{where}: {name} with {len(words)}: {field!r:.60}", f"{count} {noun}")
    for word in words:
        if not _NUMBER.fullmatch(word) or not math.isfinite(float(word)):
            raise _error(f"{where}: {name}: {word!r:.40}", "finite numbers")
    numbers = [float(word) for word in words]
    largest, allowed = max(map(abs, numbers)), ""
    # Numbers are bounded before squaring, because squares of numbers like 1e200 overflow.
    if name == "R" and not (largest < 2 and is_rotation(np.array(numbers).reshape(3, 3))):
        allowed = "a rotation matrix within 1e-3, row by row"
    elif name == "t" and largest > _FARTHEST:
        allowed = "millimetres"
    elif name == "time" and numbers[0] < 0 and numbers[0] != UNKNOWN_TIME:
        allowed = "seconds, or -1 if unknown"
    if allowed:
        raise _error(f"{where}: {name} {field!r:.90}", allowed)
    return numbers


def _check_repeats(path: Path, table: Table) -> None:
    keys = table[:, 1:17]
    order = np.lexsort(keys.T[::-1])  # stable: equal rows keep the order of lines
    same = (keys[order[1:]] == keys[order[:-1]]).all(axis=1)
    if same.any():
        first, second = table[order[:-1][same][0], 0], table[order[1:][same][0], 0]
        problem = f"{path}: line {second:.0f}, which repeats line {first:.0f}"
        fix = "remove one line, because a repeated pose counts as a false positive"
        raise _error(problem, "each pose once", fix)


def _check_unit(path: Path, table: Table) -> None:
    if not len(table):
        return
    distances = np.linalg.norm(table[:, 14:17], axis=1)
    middle = int(np.argsort(distances, kind="stable")[len(distances) // 2])
    low, high = _PLAUSIBLE_MM
    if not low <= distances[middle] <= high:
        raise _error(
            f"{path}: translations t with a median length of {distances[middle]:.4g}, e.g. in "
            f"line {table[middle, 0]:.0f}",
            f"millimetres: a median of {low:g} – {high:g}",
            "write t in millimetres: multiply it by 1000 if it is in metres",
        )


def _error(
    problem: str, allowed: str, fix: str = "correct the line, or write the file again"
) -> UserError:
    return UserError(problem, allowed, fix)
