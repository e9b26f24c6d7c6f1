"""Plain mappings, as Hydra composes them and as files hold them, into frozen dataclasses.

A field's type says what its option may be: numbers have a :class:`Range`, ``Literal`` lists the
choices, ``X | None`` may be null, a dataclass is a node of its own, ``Mapping[str, Any]`` is a node
that something else reads, such as a registry. A field without a default must be there; what is no
field is refused.
"""

from __future__ import annotations

import math
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Final, Literal, TypeVar, Union

from dopepp.core.checks import check_flag, check_integer, check_number
from dopepp.core.errors import UserError

T = TypeVar("T")

Node = Mapping[str, Any]
"""``{"_target_": …, argument: …}`` for a registry; without a target there is no such thing."""

_WORDS: Final = {str: "text", int: "an integer", float: "a number", Path: "a path"}


@dataclass(frozen=True)
class Range:
    """The closed range of a number's field, as in ``Annotated[int, Range(1, 10)]``."""

    lowest: float
    highest: float


Seed = Annotated[int, Range(0, 2**32 - 1)]
Share = Annotated[float, Range(0, 1)]


def parse(kind: type[T], given: object, name: str = "", **known: Any) -> T:
    """Build a dataclass from a plain mapping.

    ``name`` is the node's dotted name, for messages, empty for the whole config; ``known`` are the
    fields whose values the caller has. A :class:`UserError` tells what is no mapping, what is
    unknown or missing, or whose value is not of its field's type or out of its range.
    """
    own = {one.name: one for one in fields(kind) if one.name not in known}  # type: ignore[arg-type]
    prefix, allowed = f"{name}." if name else "", ", ".join(own)
    if not isinstance(given, Mapping):
        raise UserError(f"{name}={given!r:.100}", f"a mapping of {allowed}", f"change {name}")
    for key, value in given.items():
        if key not in own:
            raise UserError(
                f"{prefix}{key}={value!r:.100}",
                allowed if name else "the options of `--cfg job`",
                "check the option's name",
            )
    for key, one in own.items():
        if key not in given and one.default is MISSING and one.default_factory is MISSING:
            raise UserError(f"no {prefix}{key}", f"{prefix}{key}=…", "add it")
    hints = typing.get_type_hints(kind, include_extras=True)
    values = {key: _value(hints[key], value, f"{prefix}{key}") for key, value in given.items()}
    return kind(**values, **known)


def _value(hint: Any, value: Any, name: str) -> Any:
    """Return a field's value as its type says."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        bounds = arguments[1]
        check = check_integer if arguments[0] is int else check_number
        check(name, value, bounds.lowest, bounds.highest)
        return value  # as it was written: 1 stays an integer where any number is allowed
    if origin in (Union, UnionType):  # X | None, or X | tuple[X, ...] or a mapping | None
        grouped = isinstance(value, list | tuple | Mapping) and len(arguments) > 2
        return None if value is None else _value(arguments[grouped], value, name)
    if origin is Literal:
        if value not in arguments:
            raise UserError(f"{name}={value!r:.100}", ", ".join(arguments), "choose one of them")
        return value
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise UserError(f"{name}={value}", "a list, also of a single one", f"{name}=[{value}]")
        return tuple(_value(arguments[0], one, f"{name}[{i}]") for i, one in enumerate(value))
    if origin is not None:  # Mapping
        if not isinstance(value, Mapping):
            raise UserError(f"{name}={value!r:.100}", "a mapping", f"change {name}")
        return {key: _value(arguments[1], one, f"{name}.{key}") for key, one in value.items()}
    if is_dataclass(hint):
        return parse(hint, value, name)  # type: ignore[arg-type]
    return value if hint is Any else _plain(hint, value, name)


def _plain(kind: type[Any], value: Any, name: str) -> Any:
    """Return text, a path, a flag or a number without bounds."""
    if kind is bool:
        return check_flag(name, value)
    if kind is float and type(value) in (int, float) and math.isfinite(value):
        return value
    if kind is Path and type(value) is str:
        return Path(value)
    if type(value) is not kind or kind is float:
        raise UserError(f"{name}={value!r:.100}", _WORDS[kind], f"change {name}")
    return value


def flat(value: object, name: str = "") -> Iterator[tuple[str, object]]:
    """Yield the leaves of nested mappings by their dotted names; lists are leaves."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from flat(item, f"{name}.{key}" if name else str(key))
    else:
        yield name, value


def below(key: str, nodes: Sequence[str]) -> bool:
    """Tell whether an option is one of some nodes or stands below one."""
    return any(key == node or key.startswith(f"{node}.") for node in nodes)
