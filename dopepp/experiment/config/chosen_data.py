"""The data that an evaluation is made on: the checkpoint's, with what the user gives instead."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dopepp.core.errors import UserError


def chosen_data(config: Mapping[str, Any], stored: object, checkpoint: str) -> dict[str, Any]:
    """Return the data config to evaluate on: the checkpoint's, with what the user gives instead.

    Args:
        config: May have ``data`` (whole, or the options to change) and ``virtual`` (options to
            change).
        stored: What the checkpoint was trained on.
        checkpoint: Its path, for messages.

    Raises:
        UserError: Neither names the data, or an option does not exist.
    """
    given = config.get("data") or {}
    whole = "name" in given  # a file of conf/data, not single options
    if not whole and not isinstance(stored, dict):
        raise UserError(
            f"{checkpoint}, which names no data", "data=… on the command line", "add it"
        )
    base = stored if isinstance(stored, dict) else {}
    data = dict(given) if whole else _changed(base, given, "data")
    data["test"] = {"renderer": None, "cache": "none", **(data.get("test") or {})}
    how_to_render = config.get("virtual") or {}
    if how_to_render or base.get("virtual") is not None or are_renders(data):
        data["virtual"] = _chosen_virtual(how_to_render, base.get("virtual"), checkpoint)
    return data


def trained_on(description: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the data config that a checkpoint names, None where it names none.

    Args:
        description: What the checkpoint says about its data. Where it is older than
            ``data.eval_seed``, held-out images were rendered with the training's own seed.
    """
    config = description.get("config")
    if not isinstance(config, dict):
        return None
    return {"eval_seed": description.get("seed", 0), **config}


def are_renders(data: Mapping[str, Any]) -> bool:
    """Tell whether the test images are rendered."""
    return data.get("root") is None or data["test"]["renderer"] is not None


def _chosen_virtual(
    given: Mapping[str, Any], stored: Mapping[str, Any] | None, checkpoint: str
) -> dict[str, Any]:
    """Return how to render: a whole node as given, or the stored one with options changed."""
    if "renderer" in given and "preset" in given:  # a file of conf/virtual, not single options
        return dict(given)
    if stored is None:
        raise UserError(
            f"{checkpoint}, which does not say how to render", "virtual=default", "add it"
        )
    return _changed(stored, given, "virtual")


def _changed(base: Mapping[str, Any], changes: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Replace options, one by one also inside groups; ``scene`` takes any key."""
    merged = dict(base)
    for key, value in changes.items():
        if key not in base and not where.startswith("virtual.scene"):
            raise UserError(
                f"{where}.{key}={value}", ", ".join(map(str, base)), "check the option's name"
            )
        nested = isinstance(value, Mapping) and isinstance(base.get(key), Mapping)
        merged[key] = _changed(base[key], value, f"{where}.{key}") if nested else value
    return merged
