"""A preset with some of its fields changed by plain values, as a config gives them."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from types import NoneType, UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from dopepp.errors import UserError
from dopepp.virtual.presets import PRESETS, Preset

T = TypeVar("T")


def customised_preset(name: str, changes: Mapping[str, Any]) -> Preset:
    """Return a preset by name, with nested fields replaced.

    Args:
        name: Key of :data:`~dopepp.virtual.presets.PRESETS`.
        changes: Field to value; for a field that is itself a group of fields, a mapping, e.g.
            ``{"horizontal_fov_deg": 70, "materials": {"metal_share": 0.2}}``. A group that the
            preset lacks (``table`` of ``paper``) starts from its defaults; None takes it away.

    Raises:
        UserError: The name or a field is unknown, or a value is of the wrong kind or outside of
            what the field allows.
    """
    if name not in PRESETS:
        raise UserError(f"preset {name!r}", ", ".join(PRESETS), "choose one of them")
    return _changed(PRESETS[name], changes, f"preset {name}")


def _changed(described: T, changes: Any, where: str) -> T:
    """Replace fields of a dataclass, going down into those that are dataclasses."""
    if not isinstance(changes, Mapping):
        raise UserError(f"{changes!r} for {where}", "a mapping of fields to values", "nest it")
    known = {entry.name: getattr(described, entry.name) for entry in fields(described)}  # type: ignore[arg-type]
    hints = get_type_hints(type(described))
    values = {}
    for key, value in changes.items():
        if key not in known:
            raise UserError(f"{key!r} in {where}", ", ".join(known), "correct the field's name")
        place = f"{key} of {where}"
        values[key] = _converted(value, hints[key], known[key], place)
    return replace(described, **values)  # type: ignore[type-var]


def _converted(value: Any, hint: Any, old: Any, where: str) -> Any:
    """Return a plain value as what a field's annotation asks for.

    Args:
        value: The plain value.
        hint: The annotation: a number, a text, a tuple of them, a group, or one of these or None.
        old: The value to be replaced; a group's other fields stay as they are there.
        where: The field, for messages.
    """
    if get_origin(hint) is UnionType:
        if value is None:
            return None
        (hint,) = (choice for choice in get_args(hint) if choice is not NoneType)
        if old is None and isinstance(hint, type) and is_dataclass(hint):
            old = hint()
    if is_dataclass(old):
        return _changed(old, value, where)
    if get_origin(hint) is tuple:
        kinds = get_args(hint)
        if isinstance(value, (list, tuple)) and len(value) == len(kinds):
            return tuple(_scalar(v, kind, where) for v, kind in zip(value, kinds, strict=True))
        raise UserError(
            f"{value!r} for {where}", f"a list of {len(kinds)} numbers", "change the value"
        )
    return _scalar(value, hint, where)


def _scalar(value: Any, kind: type, where: str) -> Any:
    """Return a number or text of a kind; a whole number will do for any number."""
    if kind is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        if abs(value) <= sys.float_info.max:  # neither NaN nor infinite nor an endless integer
            return float(value)
    elif type(value) is kind:
        return value
    names = {float: "a finite number", int: "a whole number", bool: "true or false", str: "a text"}
    raise UserError(f"{value!r} for {where}", names[kind], "change the value")
