"""What decides a render job's bytes, as plain values: kept in the folder and compared later."""

from __future__ import annotations

import hashlib
from dataclasses import fields, is_dataclass
from typing import Any, Final

import numpy as np

from dopepp.parts.mesh import ASSUMED_UNIT
from dopepp.parts.part import Part
from dopepp.virtual.factory import Factory
from dopepp.virtual.version import code_hash

RECORD_VERSION: Final = 1
"""Of the record's layout."""

_HASH_DIGITS: Final = 16
"""Of the hash of the code that renders, enough to tell versions apart."""


def record_of(factory: Factory, layout: str, unit: str | None) -> dict[str, Any]:
    """Describe a job by plain values, those that a user chooses first.

    Args:
        factory: Renders the images.
        layout: Name of the data set's layout.
        unit: Of the mesh files, as the user states it; None for the assumed one.

    Returns:
        What JSON can write; equal records give equal bytes.
    """
    return {
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
