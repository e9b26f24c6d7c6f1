"""What a render job makes: a factory and a layout, from what a user writes, and their record.

The record holds, as plain values, everything that decides the job's bytes.

To add a layout, write a :class:`~dopepp.data.formats.Writer` and one line in :data:`WRITERS`.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from dopepp.core.errors import UserError
from dopepp.data.formats import Writer
from dopepp.parts.catalogue import load_part
from dopepp.parts.mesh.read import ASSUMED_UNIT
from dopepp.parts.part import Part, check_name
from dopepp.virtual.backgrounds import find_backgrounds
from dopepp.virtual.factory import Factory, code_hash
from dopepp.virtual.presets.preset import customised_preset

WRITERS: Final = {
    "bop": ("dopepp.data.formats.bop.writer", "BopWriter"),
    "ndds": ("dopepp.data.formats.ndds.writer", "NddsWriter"),
    "webdataset": ("dopepp.data.formats.webdataset.writer", "WebdatasetWriter"),
}
"""Module and class of each layout's writer."""

RECORD_VERSION: Final = 1
"""Of the record's layout."""

_HASH_DIGITS: Final = 16
"""Of the hash of the code that renders, enough to tell versions apart."""

_NAMED: Final = re.compile(r"([^=/\\]+)=(.+)")
"""``NAME=FILE``; a name is not a path."""


@dataclass(frozen=True)
class Job:
    """What is rendered, whoever renders how much of it.

    Attributes:
        factory: Renders image (0, index).
        record: The settings as plain values; equal records give equal bytes.
    """

    factory: Factory
    layout: str
    record: Mapping[str, Any]

    def writer(self, root: Path) -> Writer:
        """Return a new writer into a folder."""
        return _find_writer(self.layout)(root, self.factory.parts)


def make_job(
    parts: Sequence[str],
    *,
    unit: str | None = None,
    preset: str = "paper",
    changes: Sequence[str] = (),
    size: str | None = None,
    seed: int = 0,
    backgrounds: str | Path | None = None,
    negatives: Sequence[str] = (),
    renderer: str = "raster",
    layout: str = "bop",
) -> Job:
    """Make a job from what a user writes.

    Args:
        parts: Built-in names, mesh files, or ``NAME=FILE`` where the file's name will not do.
        unit: The mesh files' unit; None for the assumed one.
        preset: Name of a preset.
        changes: ``field.field=value``, the value as YAML.
        size: ``WIDTHxHEIGHT`` or ``WIDTH,HEIGHT`` in pixels; None for the preset's own.
        seed: Of the whole job.
        backgrounds: As :func:`~dopepp.virtual.backgrounds.find_backgrounds` takes it.
        negatives: Parts among the distractors, written as ``parts``.
        renderer: Name of a renderer.
        layout: Key of :data:`WRITERS`.

    Raises:
        UserError: Any of it cannot be used.
    """
    _find_writer(layout)
    scenes = customised_preset(preset, _nested(changes))
    factory = Factory(
        [named_part(text, unit) for text in parts],
        scenes if size is None else scenes.resized(*_sides(size)),
        seed,
        find_backgrounds(backgrounds),
        renderer=renderer,
        negatives=[named_part(text, unit) for text in negatives],
    )
    # What a user chooses comes first: of several differences, the first are shown.
    record = {
        "record_version": RECORD_VERSION,
        "format": layout,
        "seed": factory.seed,
        "renderer": factory.renderer,
        "unit": unit or ASSUMED_UNIT,
        "parts": [_part_record(part) for part in factory.parts],
        "negatives": [_part_record(part) for part in factory.negatives],
        "backgrounds": factory.backgrounds.identity(),
        "preset": _plain(factory.preset),
        "rendering_code": code_hash()[:_HASH_DIGITS],
    }
    return Job(factory, layout, record)


def _find_writer(layout: str) -> Callable[[Path, Sequence[Part]], Writer]:
    """Return the class of a layout's writer; its module is imported only now."""
    if layout not in WRITERS:
        raise UserError(f"format {layout!r}", ", ".join(WRITERS), "choose one of them")
    module, name = WRITERS[layout]
    writer: Callable[[Path, Sequence[Part]], Writer] = getattr(import_module(module), name)
    return writer


def named_part(text: str, unit: str | None) -> Part:
    """Load a part that is written as in :func:`make_job`; a UserError where there is none such."""
    match = None if Path(text).exists() else _NAMED.fullmatch(text)
    if match is None:
        return load_part(text, unit)
    return replace(load_part(match[2], unit), name=check_name(match[1]))


def _sides(size: str) -> tuple[int, int]:
    match = re.fullmatch(r"([0-9]{1,6})[x,]([0-9]{1,6})", size)
    if match is None:
        raise UserError(f"--size {size}", "WIDTHxHEIGHT in pixels, e.g. 640x480", "change --size")
    return int(match[1]), int(match[2])


def _nested(changes: Sequence[str]) -> dict[str, Any]:
    """Turn ``a.b=1`` into ``{"a": {"b": 1}}``."""
    tree: dict[str, Any] = {}
    for change in changes:
        path, sign, text = change.partition("=")
        *groups, field = path.split(".")
        try:
            value = yaml.safe_load(text)
        except (yaml.YAMLError, ValueError, RecursionError) as error:
            sign, value = "", error
        if not sign or not all((*groups, field)):
            raise UserError(
                f"--set {change:.200}", "FIELD.FIELD=VALUE, the value in YAML",
                "write it like lighting.num_lights=[1,3]",
            )  # fmt: skip
        node: Any = tree
        for group in groups:
            node = node.setdefault(group, {}) if isinstance(node, dict) else None
        if not isinstance(node, dict) or field in node:
            raise UserError(f"--set {change} after another --set of {path}", "one each", "drop one")
        node[field] = value
    return tree


def _part_record(part: Part) -> dict[str, Any]:
    """Describe a part by its name, its size and hashes of its shape and its texture."""
    mesh = part.mesh
    appearance = hashlib.sha256()
    for array in () if mesh is None else (mesh.uv, mesh.texture):
        if array is not None:
            appearance.update(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
    return {
        "name": part.name,
        "diameter": float(part.diameter),
        "mesh_hash": part.mesh_hash,
        "texture_hash": appearance.hexdigest(),
    }


def _plain(value: Any) -> Any:
    """Turn a preset into what JSON can write; groups of ranges keep their kind."""
    if is_dataclass(value):
        content = {entry.name: _plain(getattr(value, entry.name)) for entry in fields(value)}
        return {"kind": type(value).__name__} | content
    if isinstance(value, (tuple, list)):
        return [_plain(item) for item in value]
    return value
