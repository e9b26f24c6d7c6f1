"""Checks of what an option may hold: a wrong value is refused in one line, before it is used.

Configs, specs and presets come from users and from files, so nothing about their types is known.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from dopepp.core.errors import UserError


def check_number(
    name: str, value: object, lowest: float, highest: float, unit: str = "", of: object = None
) -> float:
    """Return a finite real number of a closed range; anything else is a :class:`UserError`.

    ``name``, ``unit`` (what it counts) and ``of`` (the group of options) are for the message.
    """
    if not _is_number(value) or not lowest <= value <= highest:  # type: ignore[operator]
        allowed = f"a number from {lowest:g} to {highest:g}"
        raise _refused(name, value, f"{allowed} ({unit})" if unit else allowed, of)
    return float(value)  # type: ignore[arg-type]


def check_integer(name: str, value: object, lowest: int, highest: int) -> int:
    """Return an integer of a closed range; anything else is a :class:`UserError`."""
    if not isinstance(value, int) or isinstance(value, bool) or not lowest <= value <= highest:
        raise _refused(name, value, f"an integer from {lowest} to {highest}")
    return value


def check_integers(
    name: str, values: object, length: int, lowest: int, highest: int
) -> Sequence[int]:
    """Return a list of so many integers of a closed range; else a :class:`UserError`."""
    if not isinstance(values, (list, tuple)) or len(values) != length:
        raise _refused(name, values, f"a list of {length} integers")
    for position, value in enumerate(values):
        check_integer(f"{name}[{position}]", value, lowest, highest)
    return values


def check_flag(name: str, value: object, of: object = None) -> bool:
    """Return a truth value; anything else is a :class:`UserError`."""
    if not isinstance(value, bool):
        raise _refused(name, value, "true or false", of)
    return value


def check_range(
    name: str, value: object, low: float, high: float, unit: str, of: object = None
) -> None:
    """Refuse what is no pair (smallest, largest) of numbers within bounds, in this order."""
    pair = isinstance(value, tuple) and len(value) == 2 and all(map(_is_number, value))
    if not pair or not low <= value[0] <= value[1] <= high:  # type: ignore[index]
        allowed = f"(smallest, largest) with {low:g} <= smallest <= largest <= {high:g} ({unit})"
        raise _refused(name, value, allowed, of)


def _is_number(value: object) -> bool:
    # A comparison, because an endless integer cannot even be asked whether it is finite.
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) <= sys.float_info.max


def _refused(name: str, value: object, allowed: str, of: object = None) -> UserError:
    owner = "" if of is None else f" of {getattr(of, 'name', None) or type(of).__name__}"
    return UserError(f"{name}={value!r:.100}{owner}", allowed, f"change {name}")
