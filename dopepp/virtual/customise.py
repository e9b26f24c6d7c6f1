"""A preset with some of its fields changed by plain values, as a config gives them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

from dopepp.errors import UserError
from dopepp.virtual.presets import PRESETS, Preset

T = TypeVar("T")


def customised_preset(name: str, changes: Mapping[str, Any]) -> Preset:
    """Return a preset by name, with nested fields replaced.

    Args:
        name: Key of :data:`~dopepp.virtual.presets.PRESETS`.
        changes: Field to value; for a field that is itself a group of fields, a mapping, e.g.
            ``{"horizontal_fov_deg": 70, "turning": {"tilt_deg": 30}}``.

    Raises:
        UserError: The name or a field is unknown, or a value is of the wrong kind.
    """
    if name not in PRESETS:
        raise UserError(f"preset {name!r}", ", ".join(PRESETS), "choose one of them")
    return _changed(PRESETS[name], changes, f"preset {name}")


def _changed(described: T, changes: Mapping[str, Any], where: str) -> T:
    """Replace fields of a dataclass, going down into those that are dataclasses."""
    known = {entry.name: getattr(described, entry.name) for entry in fields(described)}  # type: ignore[arg-type]
    values = {}
    for key, value in changes.items():
        if key not in known:
            raise UserError(f"{key!r} in {where}", ", ".join(known), "correct the field's name")
        old = known[key]
        if is_dataclass(old):
            if not isinstance(value, Mapping):
                raise UserError(f"{key}={value!r} in {where}", "a mapping of fields", "nest it")
            values[key] = _changed(old, value, f"{where}, {key}")
        else:
            values[key] = _converted(value, old, f"{key} of {where}")
    return replace(described, **values)  # type: ignore[type-var]


def _converted(value: Any, old: Any, where: str) -> Any:
    """Return a plain value as the type of the one that it replaces."""
    if isinstance(old, tuple) and isinstance(value, (list, tuple)) and len(old) == len(value):
        return tuple(_converted(v, o, where) for v, o in zip(value, old, strict=True))
    if isinstance(old, float) and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    if type(value) is type(old):
        return value
    if old is None and isinstance(value, (list, tuple)):
        return tuple(float(item) for item in value)
    raise UserError(f"{value!r} for {where}", f"something like {old!r}", "change the value")
