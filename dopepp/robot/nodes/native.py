"""ROS's own messages out of plain values, those of ROS 1 and of ROS 2."""

from __future__ import annotations

import array
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from typing import Any

from dopepp.robot.nodes.messages import Fields, Triangles


def native(kind: str, fields: Fields) -> Any:
    """Return a message of plain values; what they leave out is 0 or empty."""
    return _fill(type_of(kind)(), fields)


@cache
def type_of(kind: str) -> Any:
    """Return the class of a message, by its package and name; an ImportError without it."""
    package, _, name = kind.partition("/")
    return getattr(import_module(f"{package}.msg"), name)


def _fill(message: Any, fields: Fields) -> Any:
    kinds = _kinds(message)
    for name, value in fields.items():
        setattr(message, name, _value(getattr(message, name), kinds[name], value))
    return message


def _kinds(message: Any) -> Mapping[str, str]:
    """Return how ROS writes the types of a message's fields."""
    if hasattr(message, "_slot_types"):  # of ROS 1
        return dict(zip(message.__slots__, message._slot_types, strict=True))
    kinds: Mapping[str, str] = message.get_fields_and_field_types()
    return kinds


def _value(default: Any, kind: str, value: Any) -> Any:
    """Return a field's value; ``kind`` is how ROS writes its type."""
    if kind == "time":  # ROS 1's; ROS 2's is a message
        return type(default)(value["sec"], value["nanosec"])
    if isinstance(value, dict):
        return _fill(default, value)
    if isinstance(value, Triangles):
        return _points(value)
    if isinstance(value, bytes) and isinstance(default, array.array):
        return array.array("B", value)  # anything else is checked byte by byte
    if kind == "octet":
        return bytes([value])
    if isinstance(value, list) and value and isinstance(value[0], dict):
        inner = kind.removeprefix("sequence<").removesuffix(">").removesuffix("[]")
        return [native(inner, one) for one in value]
    return value


@cache
def _points(triangles: Triangles) -> list[Any]:
    return [native("geometry_msgs/Point", one) for one in triangles.points]
