"""BOP's object models, read: ``obj_000001.ply`` and ``models_info.json``, millimetres.

``models_info.json`` carries, beside BOP's own keys, the part's ``name``, which other tools ignore;
an object without one is called after its file, ``obj_000001``.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.data.formats.bop.records import EXACT, INEXACT, MM, is_number, number_in_name
from dopepp.data.formats.problems import STRICT, Place, Problems, mapping
from dopepp.data.formats.tolerances import rotation_problem
from dopepp.geometry.rotation import is_rotation, nearest_rotation
from dopepp.parts.mesh.read import read_mesh
from dopepp.parts.part import MAX_SYMMETRIES, Part, check_name, make_part

_log = logging.getLogger(__name__)

MODEL_FOLDERS: Final = ("models", "models_cad", "models_reconst", "models_eval")
"""Where data sets keep their models, the full ones first."""

INFO_FILE: Final = "models_info.json"

SYMMETRY_FIELDS: Final = ("symmetries_discrete", "symmetries_continuous")

Discrete = Float[np.ndarray, "symmetries 4 4"]
Continuous = tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]
"""Rigid transforms without the identity, and (axis, offset) pairs; metres."""

_ALLOWED: Final = 'objects by number, each once: {"1": {"diameter": …}, …}'

_DIAMETER_TOLERANCE: Final = 0.01
"""Share by which a stated diameter may differ from the mesh's: decimated models differ by less."""


@dataclass(frozen=True)
class ModelInfo:
    """One object of ``models_info.json``.

    Attributes:
        diameter: Metres; NaN where it is not stated.
        symmetries_discrete: Rigid transforms without the identity, (S, 4, 4), metres; or None.
        symmetries_continuous: (axis, offset) pairs, metres.
    """

    name: str
    path: Path
    diameter: float
    symmetries_discrete: Discrete | None
    symmetries_continuous: Continuous


def bop_parts(root: str | Path, objects: Sequence[str] | None = None) -> list[Part]:
    """Make parts from a BOP data set's models, with their symmetries.

    ``objects`` are names in the order wanted; None takes all whose file is there, by number.
    """
    infos = read_models(Path(root))
    if not infos:
        raise UserError(
            f"{root}, which has no {INFO_FILE} in {', '.join(MODEL_FOLDERS)}",
            "the root folder of a BOP data set",
            "check data.root, or unpack the data set's models into it",
        )
    by_name = {info.name: info for info in infos.values()}
    wanted = list(objects or by_name)
    absent = [name for name in wanted if objects is None and not by_name[name].path.is_file()]
    if 0 < len(absent) < len(wanted):
        _log.warning("%s: left out models without a file: %s", root, ", ".join(absent))
        wanted = [name for name in wanted if name not in absent]
    for name in wanted:
        if name not in by_name:
            raise UserError(
                f"data.objects with {name!r}", ", ".join(by_name), "choose from this list"
            )
    return [part_of(by_name[name]) for name in wanted]


def parts_by_id(root: Path, parts: Sequence[Part]) -> dict[int, Part]:
    """Return which part each BOP object number stands for.

    Without models in ``root``, parts must be called ``obj_000001`` as BOP's files are.
    """
    names = {info.name: number for number, info in read_models(root).items()}
    numbered: dict[int, Part] = {}
    for part in parts:
        number = number_in_name(part.name)
        if part.name not in names and (names or number is None):
            raise UserError(
                f"part {part.name!r} for the data set {root}",
                ", ".join(names) or f"obj_NNNNNN, as there is no {MODEL_FOLDERS[0]}/{INFO_FILE}",
                f'choose from these, or write "name": "{part.name}" into {INFO_FILE}',
            )
        numbered[names[part.name] if number is None or names else number] = part
    return numbered


def part_of(info: ModelInfo) -> Part:
    """Read an object's mesh; a :class:`UserError`: it is missing, damaged or not in millimetres."""
    mesh = read_mesh(info.path, unit="mm")
    try:
        part = make_part(
            info.name,
            mesh,
            symmetries_discrete=info.symmetries_discrete,
            symmetries_continuous=info.symmetries_continuous,
            unit="mm",
        )
    except UserError as error:  # of its size or its triangles; BOP's files have one unit
        allowed = f"{error.allowed}, from a file in millimetres as all of BOP's"
        fix = "correct the model, or convert its file to millimetres"
        raise UserError(f"{info.path}: {error.got}", allowed, fix) from error
    if abs(info.diameter - part.diameter) > _DIAMETER_TOLERANCE * part.diameter:
        _log.warning(
            "%s: %s states a diameter of %.6g m, its vertices have %.6g m, which is used",
            info.path, INFO_FILE, info.diameter, part.diameter,
        )  # fmt: skip
    return part


def read_models(root: Path) -> dict[int, ModelInfo]:
    """Return the objects of ``models_info.json`` by number; none where there is no such file."""
    path = info_path(root)
    return {} if path is None else parse_models(path, Place(STRICT, path).load(_ALLOWED))


def modelled(infos: Mapping[int, ModelInfo]) -> set[int]:
    """Return which objects have their model's file, all of them where none has."""
    there = {number for number, info in infos.items() if info.path.is_file()}
    return there or set(infos)


def info_path(root: Path) -> Path | None:
    """Return where a data set's ``models_info.json`` is, None where there is none."""
    paths = (root / folder / INFO_FILE for folder in MODEL_FOLDERS)
    return next((path for path in paths if path.is_file()), None)


def parse_models(path: Path, records: object, problems: Problems = STRICT) -> dict[int, ModelInfo]:
    """Return the objects of what a ``models_info.json`` holds, by number."""
    place = Place(problems, path)
    if not isinstance(records, dict):
        place["top level"].report(f"{records!r:.60}", _ALLOWED)
    infos: dict[int, ModelInfo] = {}
    names: set[str] = set()
    for key, record in mapping(records).items():
        if not is_number(key) or int(key) in infos:
            place[f"{key!r:.40}"].report("no object's number, or one twice", _ALLOWED)
            continue
        info = _info(place[key], path.parent / f"obj_{int(key):06d}.ply", record)
        if info.name in names:
            place[key]["name"].report(f"{info.name!r:.60} twice", "each name once")
        names.add(info.name)
        infos[int(key)] = info
    return dict(sorted(infos.items()))


def _info(place: Place, model: Path, record: object) -> ModelInfo:
    if not isinstance(record, dict):
        place.report(f"{record!r:.60}", "an object with diameter and symmetries")
    fields = mapping(record)
    diameter = math.nan
    if "diameter" in fields:
        diameter = place["diameter"].scalar(fields["diameter"]) / MM
        if diameter <= 0:
            place["diameter"].report(f"{fields['diameter']!r:.40}", "millimetres above 0")
            diameter = math.nan
    name = place["name"].attempt(lambda: check_name(fields.get("name", model.stem)))
    return ModelInfo(
        name or model.stem,
        model,
        diameter,
        _discrete(place["symmetries_discrete"], fields.get("symmetries_discrete")),
        _continuous(place["symmetries_continuous"], fields.get("symmetries_continuous")),
    )


def parse_symmetries(name: str, fields: object) -> tuple[Discrete | None, Continuous]:
    """Return the symmetries of an entry like ``models_info.json``'s, given for a part by name.

    A UserError: there is no such entry, or one is no rigid transform or no axis.
    """
    place = Place(STRICT, f"data.symmetries.{name}")
    if not isinstance(fields, Mapping) or not {*fields} <= {*SYMMETRY_FIELDS}:
        place.report(f"{fields!r:.80}", f"{' and '.join(SYMMETRY_FIELDS)} as BOP has them")
    entry = mapping(fields)
    return (
        _discrete(place[SYMMETRY_FIELDS[0]], entry.get(SYMMETRY_FIELDS[0])),
        _continuous(place[SYMMETRY_FIELDS[1]], entry.get(SYMMETRY_FIELDS[1])),
    )


def _discrete(place: Place, value: object) -> Discrete | None:
    transforms = []
    for number, row in enumerate(_rows(place, value)):
        matrix = place[number].numbers(row, 4, 4)
        problem = rotation_problem(matrix[:3, :3], INEXACT)
        if problem is not None or (matrix[3] != [0, 0, 0, 1]).any():
            got = problem or f"a last row of {matrix[3].tolist()}"
            if np.isfinite(matrix).all():
                place[number].report(got, "rigid transforms [R t; 0 0 0 1], row by row")
            continue
        if not is_rotation(matrix[:3, :3], EXACT):
            matrix[:3, :3] = nearest_rotation(matrix[:3, :3])
        matrix[:3, 3] /= MM
        if not np.allclose(matrix, np.eye(4), atol=1e-9):
            transforms.append(matrix)
    return np.array(transforms) if transforms else None


def _continuous(place: Place, value: object) -> Continuous:
    pairs = []
    for number, row in enumerate(place.entries(_rows(place, value))):
        axis, offset = (
            place[number][name].numbers(row.get(name), 3) for name in ("axis", "offset")
        )
        if not axis.any():
            place[number]["axis"].report("zero", "an axis other than 0")
        pairs.append((tuple(axis.tolist()), tuple((offset / MM).tolist())))
    return tuple(pairs)


def _rows(place: Place, value: object) -> list[Any]:
    if value is None:
        return []
    if isinstance(value, list) and len(value) <= MAX_SYMMETRIES:
        return value
    place.report(f"{value!r:.60}", f"a list of at most {MAX_SYMMETRIES}")
    return []
