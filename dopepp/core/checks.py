"""Checks of what a preset's fields may hold: every wrong value is refused before a scene is drawn.

A group of ranges calls these in its ``__post_init__``, so that a preset is as safe written in
Python as read from a config.
"""

from __future__ import annotations

import sys

from dopepp.core.errors import UserError


def check_number(group: object, name: str, low: float, high: float, unit: str) -> None:
    """Refuse a field that is no number within bounds.

    Args:
        group: The dataclass.
        name: Its field.
        low: Smallest allowed value.
        high: Largest allowed value.
        unit: What the number counts, for the message.

    Raises:
        UserError: It is a bool, not a number, not finite, or outside of the bounds.
    """
    value = getattr(group, name)
    if not _is_number(value) or not low <= value <= high:
        raise _refused(group, name, f"a number from {low:g} to {high:g} ({unit})")


def check_range(group: object, name: str, low: float, high: float, unit: str) -> None:
    """Refuse a field that is no pair (smallest, largest) within bounds.

    Args:
        group: The dataclass.
        name: Its field.
        low: Smallest allowed value.
        high: Largest allowed value.
        unit: What the numbers count, for the message.

    Raises:
        UserError: It is no pair, an entry is a bool, not a number or not finite, an entry is
            outside of the bounds, or the ends are exchanged.
    """
    value = getattr(group, name)
    pair = isinstance(value, tuple) and len(value) == 2 and all(map(_is_number, value))
    if not pair or not low <= value[0] <= value[1] <= high:
        allowed = f"(smallest, largest) with {low:g} <= smallest <= largest <= {high:g} ({unit})"
        raise _refused(group, name, allowed)


def check_counts(group: object, name: str, low: int, high: int) -> None:
    """Refuse a field that is no pair of whole numbers (smallest, largest) within bounds.

    Raises:
        UserError: As for :func:`check_range`, or an entry is not an integer.
    """
    check_range(group, name, low, high, "a count")
    if not all(isinstance(value, int) for value in getattr(group, name)):
        raise _refused(group, name, "two whole numbers")


def check_flag(group: object, name: str) -> None:
    """Refuse a field that is not a bool.

    Raises:
        UserError: It is anything else.
    """
    if not isinstance(getattr(group, name), bool):
        raise _refused(group, name, "true or false")


def _is_number(value: object) -> bool:
    # A comparison, because an endless integer cannot even be asked whether it is finite.
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) <= sys.float_info.max


def _refused(group: object, name: str, allowed: str) -> UserError:
    owner = getattr(group, "name", None) or type(group).__name__
    return UserError(f"{name}={getattr(group, name)!r} of {owner}", allowed, f"change {name}")
