"""Strict JSON for untrusted files.

``json.loads`` accepts ``NaN``, ``1e999`` and duplicate keys, and crashes on deep nesting. Here,
these raise :class:`~dopepp.core.errors.UserError`.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from dopepp.core.errors import UserError
from dopepp.core.files import cache_folder, read_limited, write_file
from dopepp.core.validation import parse

T = TypeVar("T")

logger = logging.getLogger(__name__)

MAX_BYTES: Final = 64_000_000
"""Default size limit: 10,000 images of a BOP scene with ten objects each. Parsed JSON takes up to
20 times its size in memory."""

MAX_DEPTH: Final = 64  # the formats here need six

_STRING: Final = re.compile(rb'"[^"\\]*+(?:\\.[^"\\]*+)*+(?:"|\\?\Z)', re.DOTALL)
"""A string literal, possibly cut off at the end of the text."""

_EXPONENT: Final = re.compile(rb"[eE]\+?0*[1-9]\d\d")
_LONG_DIGITS: Final = 200
"""A number beyond float64's range (1.8e308) has three digits of exponent, or over 200 digits."""


def read_json(path: str | Path, max_bytes: int = MAX_BYTES) -> object:
    """Read a JSON file.

    Raises:
        UserError: The file is missing, too large, or rejected by :func:`parse_json`.
    """
    path = Path(path)
    allowed = f"a JSON file of at most {max_bytes / 1e6:.3g} MB"
    if not path.is_file():
        fix = "pass the path of an existing file, or restore the file"
        raise UserError(f"{path}, no such file", allowed, fix)
    try:
        content = read_limited(path, max_bytes)
    except (OSError, ValueError) as error:
        problem = f"{path}: {getattr(error, 'strerror', None) or error}"
        raise UserError(problem, allowed, "pass a readable file of this size") from error
    return parse_json(content, str(path))


def parse_json(text: str | bytes, where: str) -> object:
    """Parse JSON text in UTF-8, with or without a byte order mark. The caller limits its size.

    ``where`` is the source of the text, for messages.

    Raises:
        UserError: The text is not UTF-8 or JSON, has a duplicate key, nesting deeper than 64, or a
            number that is not finite.
    """
    content = text.encode("utf-8", "surrogatepass") if isinstance(text, str) else text
    bare = _STRING.sub(b"", content)
    if _depth(bare) > MAX_DEPTH:
        raise _bad(where, f"more than {MAX_DEPTH} levels of nesting")
    # Numbers are only checked if one may overflow, because the check would dominate the time.
    parse_float = _finite if _may_overflow(bare) else None
    try:
        return json.loads(
            content.decode("utf-8-sig"),
            object_pairs_hook=_object,
            parse_float=parse_float,
            parse_constant=_finite,
        )
    except UnicodeDecodeError as error:
        raise _bad(where, f"byte {error.start} is not UTF-8") from error
    except json.JSONDecodeError as error:
        problem = f"line {error.lineno}, column {error.colno}: {error.msg}"
        raise _bad(where, problem) from error
    except ValueError as error:  # of a hook; or an integer of thousands of digits
        raise _bad(where, str(error)) from error


def cached(folder: str, key: tuple[object, ...], kind: Any, make: Callable[[], T]) -> T:
    """Return a JSON value of type ``kind`` from a folder of the user's cache, by a hash of ``key``.

    A missing or damaged file is written again. If that fails, a warning is logged.
    """
    name = f"{hashlib.sha256(repr(key).encode()).hexdigest()[:32]}.json"
    path = cache_folder() / folder / name
    try:
        stored: T = parse(kind, read_json(path))
        return stored
    except (OSError, UserError):
        value = make()
    try:
        write_file(path, json.dumps(value).encode())
    except OSError as error:
        logger.warning("%s: cannot store the value in the cache: %s", path, error)
    return value


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Convert the pairs of a JSON object to a dictionary; raise a ValueError for a repeated key."""
    fields = dict(pairs)
    if len(fields) < len(pairs):
        twice, _ = Counter(key for key, _ in pairs).most_common(1)[0]
        raise ValueError(f"key {twice!r:.80} twice in one object")
    return fields


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text!r:.40}, not a finite number")
    return number


def _depth(bare: bytes) -> int:
    """Return the largest nesting depth of JSON whose strings are removed."""
    code = np.frombuffer(bare, np.uint8)
    opened = (code == ord("[")) | (code == ord("{"))
    closed = (code == ord("]")) | (code == ord("}"))
    steps = (opened.view(np.int8) - closed.view(np.int8))[opened | closed]
    return int(np.cumsum(steps, dtype=np.int64).max(initial=0))


def _may_overflow(bare: bytes) -> bool:
    """Return whether JSON without its strings may contain a number beyond float64's range."""
    code = np.frombuffer(bare, np.uint8)
    others = np.flatnonzero((code < ord("0")) | (code > ord("9")))
    runs = np.diff(others, prepend=-1, append=len(code))
    return bool(runs.max(initial=0) > _LONG_DIGITS) or _EXPONENT.search(bare) is not None


def _bad(where: str, problem: str) -> UserError:
    allowed = "UTF-8 JSON with finite numbers and each key once"
    return UserError(f"{where}: {problem}", allowed, "correct the file, or write it again")
