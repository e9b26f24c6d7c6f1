"""Typed objects from untrusted plain values, checked by pydantic in its strict JSON mode.

:func:`parse` turns a plain value, as a YAML or JSON file gives it, into a type: a frozen dataclass
whose numbers have a :class:`Range`. The first mistake raises a
:class:`~dopepp.core.errors.UserError`. :func:`mistakes` returns all of them instead, for readers
that collect problems.

Values are never coerced: ``"1"`` is no number and ``true`` is no integer. As in JSON, a list stands
for a tuple and text for a path. A dataclass that refuses unknown fields has the line
``__pydantic_config__ = STRICT``.
"""

from __future__ import annotations

import dataclasses
import json
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from typing import Any, Final, NamedTuple, TypeVar

from pydantic import ConfigDict, GetCoreSchemaHandler, TypeAdapter, ValidationError
from pydantic_core import CoreSchema, ErrorDetails, PydanticCustomError, core_schema

from dopepp.core.errors import UserError

T = TypeVar("T")

STRICT: Final = ConfigDict(extra="forbid", allow_inf_nan=False, arbitrary_types_allowed=True)
"""``__pydantic_config__`` of a dataclass that refuses unknown fields and infinite numbers."""

_WORDS: Final = {
    "bool": "true or false",
    "int": "an integer",
    "float": "a finite number",
    "finite": "a finite number",
    "string": "text",
    "path": "text",
    "list": "a list",
    "tuple": "a list",
    "dict": "a mapping",
    "dataclass": "a mapping",
    "model": "a mapping",
    "mapping": "a mapping",
    "none": "null",
}
"""Names of the allowed values, by the first part of pydantic's error type."""


@dataclass(frozen=True)
class Range:
    """Closed range of a number, as in ``Annotated[int, Range(1, 10)]``."""

    lowest: float
    highest: float
    unit: str = ""

    def __str__(self) -> str:
        unit = f" ({self.unit})" if self.unit else ""
        return f"from {self.lowest:g} to {self.highest:g}{unit}"

    def __get_pydantic_core_schema__(self, kind: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        noun = "an integer" if kind is int else "a number"

        def check(value: float) -> float:
            if not self.lowest <= value <= self.highest:
                raise PydanticCustomError("range", "{allowed}", {"allowed": f"{noun} {self}"})
            return value

        return core_schema.no_info_after_validator_function(check, handler(kind))


class Mistake(NamedTuple):
    """A value that its type does not allow.

    Attributes:
        location: Keys and indices that lead to the value.
        got: The value, shortened for a message; empty where it is missing.
        allowed: The allowed values in words.
        is_unknown: Whether the location is no field at all.
    """

    location: tuple[str | int, ...]
    got: str
    allowed: str
    is_unknown: bool = False

    def name(self, root: str = "") -> str:
        """Return the location as a dotted name below ``root``, e.g. ``data.parts[0]``."""
        steps = (f"[{step}]" if isinstance(step, int) else f".{step}" for step in self.location)
        return (root + "".join(steps)).removeprefix(".")


def parse(kind: type[T], value: object, name: str = "", fix: str = "") -> T:
    """Validate a plain value.

    Args:
        kind: Type to build.
        value: Null, true or false, numbers, text, and lists and mappings of them.
        name: Dotted name or file of the value, for messages.
        fix: What the user should do (default: correct the field).

    Returns:
        The typed object.

    Raises:
        UserError: A field is missing, unknown, of the wrong type or out of its range.
    """
    try:
        typed: T = _validated(kind, value, name)
    except ValidationError as error:
        raise _user_error(next(_mistakes(kind, value, error)), name, fix) from None
    return typed


def mistakes(kind: type[Any], value: object) -> list[Mistake]:
    """Return everything that ``kind`` refuses about a plain value, in the order of its fields."""
    try:
        _validated(kind, value, "")
    except ValidationError as error:
        return list(_mistakes(kind, value, error))
    return []


def shown(value: object, most: int = 100) -> str:
    """Return a value for a message, shortened; an endless integer is shown as its type."""
    try:
        return f"{value!r:.{most}}"
    except ValueError:
        return type(value).__name__


@cache
def _adapter(kind: type[T]) -> TypeAdapter[T]:
    return TypeAdapter(kind)


def _validated(kind: Any, value: object, name: str) -> Any:
    return _adapter(kind).validate_json(_json(value, name), strict=True)


def _json(value: object, name: str) -> str:
    try:
        return json.dumps(value)
    except (TypeError, ValueError, RecursionError) as error:
        got = f"{name}: {error}" if name else str(error)
        allowed = "null, true/false, numbers, text, and lists and mappings of them"
        raise UserError(got, allowed, "write plain values") from None


def _user_error(mistake: Mistake, root: str, fix: str) -> UserError:
    name = mistake.name(root)
    if mistake.is_unknown:
        return UserError(f"{name}={mistake.got}", mistake.allowed, fix or "check the name")
    if not mistake.got:
        return UserError(f"no {name}", f"{name}=…", fix or "add it")
    return UserError(f"{name}={mistake.got}", mistake.allowed, fix or f"change {name}")


def _mistakes(kind: type[Any], value: object, error: ValidationError) -> Iterator[Mistake]:
    """Translate pydantic's errors; those of a union's alternatives become one mistake."""
    located = [(_location(value, detail["loc"]), detail) for detail in error.errors()]
    for location, group in groupby(located, key=lambda pair: pair[0]):
        details = [detail for _, detail in group]
        first = details[0]
        if first["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
            fields = ", ".join(_fields(kind, location[:-1])) or "no field"
            yield Mistake(location, shown(first["input"]), fields, is_unknown=True)
        elif first["type"] in ("missing", "missing_argument"):
            yield Mistake(location, "", "a value")
        else:
            allowed = " or ".join(dict.fromkeys(map(_allowed, details)))
            yield Mistake(location, shown(first["input"]), allowed)


def _location(value: object, steps: Sequence[str | int]) -> tuple[str | int, ...]:
    """Return the steps that lead into the value; pydantic adds the names of union members."""
    location: list[str | int] = []
    for number, step in enumerate(steps):
        is_last = number == len(steps) - 1
        if isinstance(value, Mapping) and (step in value or is_last):
            location.append(step)
            value = value.get(step)
        elif isinstance(value, (list, tuple)) and isinstance(step, int) and step < len(value):
            location.append(step)
            value = value[step]
    return tuple(location)


def _allowed(detail: ErrorDetails) -> str:
    context = detail.get("ctx", {})
    if "expected" in context:
        return str(context["expected"]).replace("'", "").replace(" or ", ", ")
    return _WORDS.get(detail["type"].partition("_")[0], detail["msg"])


def _fields(kind: Any, location: Sequence[str | int]) -> list[str]:
    """Return the names of the fields of the dataclass at a location below ``kind``."""
    for step in location:
        if isinstance(step, int):
            kind = typing.get_args(kind)[0]
        else:
            kind = typing.get_type_hints(_dataclass(kind)).get(step)
    owner = _dataclass(kind)
    return [field.name for field in dataclasses.fields(owner)] if owner is not None else []


def _dataclass(kind: Any) -> Any:
    """Return a type, or the member of a union, that is a dataclass."""
    members = (kind, *typing.get_args(kind))
    return next((member for member in members if dataclasses.is_dataclass(member)), None)
