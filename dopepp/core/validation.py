"""Validation of JSON-like values, by pydantic in its strict JSON mode.

:func:`parse` converts a value from a YAML or JSON file to a type, e.g. a frozen dataclass whose
numbers have a :class:`Range`. :func:`check` validates an argument, and :class:`Checked` the fields
of a dataclass. The first mistake raises :class:`~dopepp.core.errors.UserError`.

Values are never coerced: ``"1"`` is not a number and ``true`` is not an integer. As in JSON, a list
represents a tuple, and text represents a path. To refuse unknown fields, a dataclass has the line
``__pydantic_config__ = STRICT``.
"""

from __future__ import annotations

import dataclasses
import json
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from itertools import groupby
from typing import Annotated, Any, Final, NamedTuple, TypeVar

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
"""Allowed values in words, by the first part of pydantic's error type."""


@dataclass(frozen=True)
class Range:
    """Closed range of a number, as in ``Annotated[int, Range(1, 10)]``.

    In a tuple, e.g. ``Annotated[tuple[int, int], Range(1, 10)]``, all numbers have this range.
    """

    lowest: float
    highest: float
    unit: str = ""

    def allowed(self, kind: Any) -> str:
        """Return the allowed values of type ``kind`` in words."""
        length = len(typing.get_args(kind))
        is_integer = int in (kind, *typing.get_args(kind))
        form = ".0f" if is_integer else "g"
        noun = "integer" if is_integer else "number"
        noun = f"a list of {length} {noun}s" if length else f"{'an' if is_integer else 'a'} {noun}"
        return f"{noun} from {self.lowest:{form}} to {self.highest:{form}}{self._unit}"

    def holds(self, value: Any) -> bool:
        """Return whether a number, or every number of a tuple, is within the range."""
        numbers = value if isinstance(value, tuple) else (value,)
        return all(self.lowest <= number <= self.highest for number in numbers)

    @property
    def _unit(self) -> str:
        return f" ({self.unit})" if self.unit else ""

    def __get_pydantic_core_schema__(self, kind: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        refused = PydanticCustomError("range", "{allowed}", {"allowed": self.allowed(kind)})

        def check(value: object, inner: Callable[[object], Any]) -> Any:
            try:
                # A JSON array is a list here, which is not a tuple in strict mode.
                typed = inner(tuple(value) if isinstance(value, list) else value)
            except ValidationError:
                raise refused from None
            if not self.holds(typed):
                raise refused
            return typed

        return core_schema.no_info_wrap_validator_function(check, handler(kind))


class Span(Range):
    """Range of a pair (smallest, largest), as in ``Annotated[tuple[float, float], Span(0, 1)]``."""

    def allowed(self, kind: Any) -> str:
        """Return the allowed pairs in words."""
        bounds = f"{self.lowest:g} <= smallest <= largest <= {self.highest:g}"
        return f"(smallest, largest) with {bounds}{self._unit}"

    def holds(self, value: Any) -> bool:
        """Return whether both numbers are within the range and in ascending order."""
        smallest, largest = value
        return bool(self.lowest <= smallest <= largest <= self.highest)


Pair = tuple[float, float]
"""A pair (smallest, largest) that a :class:`Span` limits."""

Share = Annotated[float, Range(0.0, 1.0, "share")]


class _Mistake(NamedTuple):
    """A rejected value ``got`` (empty if missing) and what is allowed at its location."""

    location: tuple[str | int, ...]
    got: str
    allowed: str
    is_unknown: bool = False

    def name(self, root: str = "") -> str:
        """Return the location as a dotted name below ``root``, e.g. ``data.parts[0]``."""
        steps = (f"[{step}]" if isinstance(step, int) else f".{step}" for step in self.location)
        return (root + "".join(steps)).removeprefix(".")


def parse(kind: type[T], value: object, name: str = "", fix: str = "") -> T:
    """Convert a JSON-like value to a type, without coercion.

    Args:
        kind: Type to build.
        value: Null, true, false, numbers, text, and lists and mappings of them.
        name: Dotted name or file of the value, for messages.
        fix: Advice for the user (default: correct the field).

    Raises:
        UserError: A field is missing, unknown, of the wrong type or out of its range.
    """
    try:
        typed: T = _validate(kind, value, name)
    except ValidationError as error:
        if cause := _cause(error.errors()[0]):  # error of a __post_init__
            raise cause from None
        first, *others = _mistakes(kind, value, error)
        depth = len(first.location)
        deeper = (other for other in others if other.location[:depth] == first.location)
        # The alternative of a union that fails deepest inside is probably the intended alternative.
        mistake = max((first, *deeper), key=lambda candidate: len(candidate.location))
        raise _user_error(mistake, name, fix) from None
    return typed


def check(
    name: str, value: object, kind: type[T], limits: Range | None = None, of: object = None
) -> T:
    """Return an argument as ``kind``: an integer becomes a float, a list a tuple if it says so.

    For example ``check("stages", stages, int, Range(1, 6))`` or ``check("refine", refine, bool)``.
    The message contains the ``name`` or else the class of the object ``of`` that has the argument.

    Raises:
        UserError: The value is of another type or out of range.
    """
    limited: Any = kind if limits is None else Annotated[kind, limits]
    try:
        typed: T = _validate(limited, value, name)
    except ValidationError as error:
        mistake = next(_mistakes(limited, value, error))
        owner = "" if of is None else f" of {getattr(of, 'name', None) or type(of).__name__}"
        got = mistake.got if mistake.location else short_repr(value)
        problem = f"{mistake.name(name)}={got}{owner}"
        raise UserError(problem, mistake.allowed, f"set {name} to an allowed value") from None
    return typed


class Checked:
    """Base of a frozen dataclass that rejects unknown fields and values outside their ranges.

    Ranges are also checked when Python code creates the dataclass.
    """

    __pydantic_config__ = STRICT

    def __post_init__(self) -> None:
        kind: Any = type(self)
        for name, annotated in _ranged_fields(kind).items():
            check(name, getattr(self, name), annotated, of=self)


@cache
def _ranged_fields(kind: Any) -> dict[str, Any]:
    """Return the annotations, by name, of a class's fields that have a :class:`Range`."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return {
        name: hint
        for name, hint in hints.items()
        if any(isinstance(limits, Range) for limits in getattr(hint, "__metadata__", ()))
    }


def short_repr(value: object, max_length: int = 100) -> str:
    """Return a value as text for a message, cut to ``max_length`` characters.

    An integer with too many digits for a conversion to text is represented by its type.
    """
    try:
        return f"{value!r:.{max_length}}"
    except ValueError:
        return type(value).__name__


@cache
def _adapter(kind: type[T]) -> TypeAdapter[T]:
    # A class of an extension may have arguments that JSON cannot represent.
    config = None if dataclasses.is_dataclass(kind) else ConfigDict(arbitrary_types_allowed=True)
    return TypeAdapter(kind, config=config)


def _validate(kind: Any, value: object, name: str) -> Any:
    """Validate a JSON-like value against a type, without coercion; ``name`` is for messages."""
    return _adapter(kind).validate_json(_json(value, name), strict=True)


def _json(value: object, name: str) -> str:
    try:
        return json.dumps(value)
    except (TypeError, ValueError, RecursionError) as error:
        problem = f"{name}: {error}" if name else str(error)
        allowed = "null, true/false, numbers, text, and lists and mappings of them"
        raise UserError(problem, allowed, "write only values of these kinds") from None


def _user_error(mistake: _Mistake, root: str, fix: str) -> UserError:
    """Return the error for a mistake; its advice is the most similar name for an unknown field."""
    name = mistake.name(root)
    if mistake.is_unknown:
        fields = mistake.allowed.split(", ")
        near = get_close_matches(str(mistake.location[-1]), fields, 1)
        advice = f"write {near[0]}" if near else "use one of these names"
        return UserError(f"{name}={mistake.got}", mistake.allowed, fix or advice)
    if not mistake.got:
        return UserError(f"no {name}", f"{name}=…", fix or f"add {name}=…")
    advice = f"set {name} to an allowed value"
    return UserError(f"{name}={mistake.got}", mistake.allowed, fix or advice)


def _mistakes(kind: type[Any], value: object, error: ValidationError) -> Iterator[_Mistake]:
    """Yield pydantic's errors as mistakes, with the alternatives of a union merged."""
    located = [(_location(value, detail), detail) for detail in error.errors()]
    for location, group in groupby(located, key=lambda pair: pair[0]):
        details = [detail for _, detail in group]
        first = details[0]
        if first["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
            fields = ", ".join(_fields(kind, location[:-1], value)) or "no field"
            yield _Mistake(location, short_repr(first["input"]), fields, is_unknown=True)
        elif first["type"] in ("missing", "missing_argument"):
            yield _Mistake(location, "", "a value")
        else:
            allowed = " or ".join(dict.fromkeys(map(_allowed, details)))
            yield _Mistake(location, short_repr(first["input"]), allowed)


def _location(value: object, detail: ErrorDetails) -> tuple[str | int, ...]:
    """Return the location of an error in the value, without pydantic's names of union members."""
    location: list[str | int] = []
    for number, step in enumerate(detail["loc"]):
        is_missing = detail["type"].startswith("missing") and number == len(detail["loc"]) - 1
        if isinstance(value, Mapping) and (step in value or is_missing):
            location.append(step)
            value = value.get(step)
        elif isinstance(value, (list, tuple)) and isinstance(step, int):
            location.append(step)
            value = value[step] if step < len(value) else None
    return tuple(location)


def _cause(detail: ErrorDetails) -> UserError | None:
    cause = detail.get("ctx", {}).get("error")
    return cause if isinstance(cause, UserError) else None


def _allowed(detail: ErrorDetails) -> str:
    """Return the allowed values in words, from pydantic's description of an error."""
    context = detail.get("ctx", {})
    if cause := _cause(detail):
        return cause.allowed
    if "discriminator" in context:
        kinds = str(context.get("expected_tags", "…")).replace("'", "")
        return f"a mapping with {context['discriminator']}: {kinds}".replace("'", "")
    if "expected" in context:
        return str(context["expected"]).replace("'", "").replace(" or ", ", ")
    if "pattern" in context:
        return f"text like {context['pattern']}"
    words = detail["msg"].removeprefix("Input should be ")
    return _WORDS.get(detail["type"].partition("_")[0], words)


def _fields(kind: Any, location: Sequence[str | int], value: Any) -> list[str]:
    """Return the names of the fields of the dataclass at a location below ``kind``."""
    for step in location:
        if isinstance(step, int):
            kind = typing.get_args(kind)[0]
        else:
            kind = typing.get_type_hints(_dataclass(kind, value)).get(step)
        value = value[step]
    owner = _dataclass(kind, value)
    return [field.name for field in dataclasses.fields(owner)] if owner is not None else []


def _dataclass(kind: Any, value: Any) -> Any:
    """Return ``kind`` if it is a dataclass, or the union member whose tag matches the value.

    Members of a tagged union have a field ``kind`` with their tag as default. If no tag matches,
    the first member is returned.
    """
    members = [*filter(dataclasses.is_dataclass, (kind, *typing.get_args(kind)))]
    tag = value.get("kind") if isinstance(value, Mapping) else None
    tagged = (member for member in members if getattr(member, "kind", None) == tag)
    return next(tagged, members[0] if members else None)
