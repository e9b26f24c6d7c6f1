"""Choose the symmetries of the objects to learn: from the mesh, a file, a config, or none.

A file is BOP's ``models_info.json``, or a single entry as printed by ``dopepp symmetries``. A
config has entries of this format by name.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from dopepp.core.errors import UserError
from dopepp.core.json import read_json
from dopepp.data.formats.bop import bop_models
from dopepp.parts.catalogue import load_part
from dopepp.parts.part import Part
from dopepp.parts.symmetry_finder import LARGEST_TOLERANCE, TOLERANCE, cached_symmetries

_log = logging.getLogger(__name__)

AUTO: Final = "auto"
NONE: Final = "none"


def choose_symmetries(
    parts: Sequence[Part], choice: str | Mapping[str, object] | None, resolution: float = 0.0
) -> list[Part]:
    """Return the parts with the symmetries that ``choice`` names.

    Args:
        parts: Objects to learn.
        choice: None keeps the parts' symmetries; ``none`` removes them; ``auto`` finds them on the
            mesh. Another text is the path of a file with an entry for each part, by name. A mapping
            has entries by name for some parts, and keeps the symmetries of the others.
        resolution: Smallest movement of the surface that a camera shows, metres. ``auto`` permits
            this distance from the surface, if it exceeds the default tolerance.
    """
    if choice is None:
        return list(parts)
    if choice == NONE:
        return [replace(part, symmetries_discrete=None, symmetries_continuous=()) for part in parts]
    if choice == AUTO:
        visible = [min(resolution / part.diameter, LARGEST_TOLERANCE) for part in parts]
        return [
            with_symmetries(part, max(TOLERANCE, tolerance))
            for part, tolerance in zip(parts, visible, strict=True)
        ]
    if isinstance(choice, Mapping):
        # Not an error: data.objects may choose some objects of a data set.
        if others := sorted(set(choice) - {part.name for part in parts}):
            _log.warning("data.symmetries of %s: no part has this name", ", ".join(others))
        entries = {name: bop_models.parse_symmetries(name, entry) for name, entry in choice.items()}
    else:
        entries = _read_symmetries(choice)
        for part in parts:
            if part.name not in entries:
                problem = f"data.symmetries={choice}, which has no entry for {part.name}"
                fix = f'add an entry with "name": "{part.name}"'
                raise UserError(problem, ", ".join(entries), fix)
    return [replace(part, **entries.get(part.name, {})) for part in parts]


def with_symmetries(part: Part, tolerance: float = TOLERANCE) -> Part:
    """Return a part with its mesh's symmetries within ``tolerance`` diameters; log their number.

    Raises:
        UserError: The part has no mesh.
    """
    if part.mesh is None:
        problem = f"part {part.name} without a mesh, which the search for symmetries needs"
        fix = "write its symmetries into a file, or set data.symmetries=none"
        raise UserError(problem, "parts with a mesh", fix)
    discrete, continuous = cached_symmetries(part.mesh, tolerance)
    found = f"{len(discrete)} discrete symmetries and {len(continuous)} axes of continuous symmetry"
    _log.info("%s: %s within %.3g mm", part.name, found, 1000 * tolerance * part.diameter)
    is_coloured = part.mesh.texture is not None or part.mesh.colours is not None
    if is_coloured and (len(discrete) or continuous):
        reason = "if they distinguish the sides, set data.symmetries=none"
        _log.warning("%s has colours, which the search ignores: %s", part.name, reason)
    discrete_or_none = discrete if len(discrete) else None
    return replace(part, symmetries_discrete=discrete_or_none, symmetries_continuous=continuous)


def describe_symmetries(path: Path | str, unit: str | None, tolerance: float) -> str:
    """Return the ``models_info.json`` entry of a mesh file or built-in part as JSON.

    The symmetries are those of :func:`with_symmetries`.
    """
    entry = bop_models.model_info(with_symmetries(load_part(path, unit), tolerance))
    entry |= {field: entry.get(field, []) for field in bop_models.SYMMETRY_FIELDS}
    return json.dumps(entry, indent=2, ensure_ascii=False)


def _read_symmetries(choice: str) -> dict[str, bop_models.Symmetries]:
    path = Path(choice)
    if not path.is_file():
        allowed = f"null, {NONE}, {AUTO} or a models_info.json"
        fix = "set data.symmetries to one of these words or to the path of a file"
        raise UserError(f"data.symmetries={choice}, no such file", allowed, fix)
    records = read_json(path)
    if isinstance(records, dict) and "diameter" in records:
        records = {"1": records}  # a file with a single entry
    infos = bop_models.parse_models(path, records).values()
    return {info.name: info.symmetries for info in infos}
