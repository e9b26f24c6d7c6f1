"""BOP's object models: ``models/obj_000001.ply`` and ``models_info.json``, millimetres.

``models_info.json`` carries, beside BOP's own keys, the part's ``name``, which other tools ignore;
an object without one is called after its file, ``obj_000001``.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.core.json import read_json
from dopepp.data.formats.bop.records import MM, numbers
from dopepp.geometry.rotation import is_rotation
from dopepp.parts.mesh.read import read_mesh
from dopepp.parts.part import MAX_SYMMETRIES, Part, check_name, make_part

_log = logging.getLogger(__name__)

MODEL_FOLDERS: Final = ("models", "models_cad", "models_reconst", "models_eval")
"""Where data sets keep their models, the full ones first."""

INFO_FILE: Final = "models_info.json"

_DIAMETER_TOLERANCE: Final = 0.01
"""Share by which a stated diameter may differ from the mesh's: decimated models differ by less."""


@dataclass(frozen=True)
class ModelInfo:
    """One object of ``models_info.json``.

    Attributes:
        name: The part's name.
        path: Its PLY file.
        diameter: Metres; NaN where it is not stated.
        symmetries_discrete: Rigid transforms without the identity, (S, 4, 4), metres; or None.
        symmetries_continuous: (axis, offset) pairs, metres.
    """

    name: str
    path: Path
    diameter: float
    symmetries_discrete: Float[np.ndarray, "symmetries 4 4"] | None
    symmetries_continuous: tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]


def bop_parts(root: str | Path, objects: Sequence[str] | None = None) -> list[Part]:
    """Make parts from a BOP data set's models, with their symmetries.

    Args:
        root: The data set's folder.
        objects: Names of the objects, in the order wanted; None takes all, by number.

    Raises:
        UserError: There are no models, an object is unknown, or a file is damaged.
    """
    infos = read_models(Path(root))
    if not infos:
        raise UserError(
            f"{root}, which has no {INFO_FILE} in {', '.join(MODEL_FOLDERS)}",
            "the root folder of a BOP data set",
            "check data.root, or unpack the data set's models into it",
        )
    by_name = {info.name: info for info in infos.values()}
    wanted = list(by_name) if objects is None else objects
    for name in wanted:
        if name not in by_name:
            raise UserError(
                f"data.objects with {name!r}", ", ".join(by_name), "choose from this list"
            )
    return [_part(by_name[name]) for name in wanted]


def parts_by_id(root: Path, parts: Sequence[Part]) -> dict[int, Part]:
    """Return which part each BOP object number stands for.

    Without models in ``root``, parts must be called ``obj_000001`` as BOP's files are.

    Raises:
        UserError: A part is none of the data set's objects.
    """
    names = {info.name: number for number, info in read_models(root).items()}
    numbered: dict[int, Part] = {}
    for part in parts:
        number = re.fullmatch(r"obj_(\d{1,9})", part.name)
        if part.name not in names and (names or number is None):
            raise UserError(
                f"part {part.name!r} for the data set {root}",
                ", ".join(names) or f"obj_NNNNNN, as there is no {MODEL_FOLDERS[0]}/{INFO_FILE}",
                f'choose from these, or write "name": "{part.name}" into {INFO_FILE}',
            )
        numbered[names[part.name] if number is None or names else int(number[1])] = part
    return numbered


def read_models(root: Path) -> dict[int, ModelInfo]:
    """Return the objects of ``models_info.json`` by number; none where there is no such file.

    Raises:
        UserError: The file is damaged, or two objects share a name.
    """
    paths = [root / folder / INFO_FILE for folder in MODEL_FOLDERS]
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        return {}
    return parse_models(path, read_json(path))


def parse_models(path: Path, records: object) -> dict[int, ModelInfo]:
    """Return the objects of what a ``models_info.json`` holds, by number.

    Raises:
        UserError: It holds something else, or two objects share a name.
    """
    if not isinstance(records, dict) or not all(re.fullmatch(r"[0-9]{1,9}", k) for k in records):
        raise _bad(f"{path}", 'objects by number: {"1": {"diameter": …}, …}')
    infos = {int(key): _info(path, key, record) for key, record in records.items()}
    names = [info.name for info in infos.values()]
    if len(infos) < len(records) or len(set(names)) < len(names):
        raise _bad(f"{path} with two objects of one number or name", "each once")
    return dict(sorted(infos.items()))


def _part(info: ModelInfo) -> Part:
    part = make_part(
        info.name,
        read_mesh(info.path, unit="mm"),
        symmetries_discrete=info.symmetries_discrete,
        symmetries_continuous=info.symmetries_continuous,
        unit="mm",
    )
    if abs(info.diameter - part.diameter) > _DIAMETER_TOLERANCE * part.diameter:
        _log.warning(
            "%s: %s states a diameter of %.6g m, its vertices have %.6g m, which is used",
            info.path, INFO_FILE, info.diameter, part.diameter,
        )  # fmt: skip
    return part


def _info(path: Path, key: str, record: object) -> ModelInfo:
    where = f"{path}: object {key}"
    if not isinstance(record, dict):
        raise _bad(where, "an object with diameter and symmetries")
    model = f"obj_{int(key):06d}"
    diameter = math.nan
    if "diameter" in record:
        diameter = float(numbers([record["diameter"]], 1, f"{where}: diameter")[0]) / MM
        if diameter <= 0:
            raise _bad(f"{where}: diameter of {diameter} m", "millimetres above 0")
    return ModelInfo(
        check_name(record.get("name", model)),
        path.parent / f"{model}.ply",
        diameter,
        _discrete(record.get("symmetries_discrete"), where),
        _continuous(record.get("symmetries_continuous"), where),
    )


def _discrete(value: object, where: str) -> Float[np.ndarray, "symmetries 4 4"] | None:
    where = f"{where}: symmetries_discrete"
    transforms = []
    for row in _rows(value, where):
        matrix = numbers(row, 16, where).reshape(4, 4)
        if not is_rotation(matrix[:3, :3]) or (matrix[3] != [0, 0, 0, 1]).any():
            raise _bad(where, "rigid transforms [R t; 0 0 0 1], row by row")
        matrix[:3, 3] /= MM
        if not np.allclose(matrix, np.eye(4), atol=1e-9):
            transforms.append(matrix)
    return np.array(transforms) if transforms else None


def _continuous(
    value: object, where: str
) -> tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]:
    where = f"{where}: symmetries_continuous"
    pairs = []
    for row in _rows(value, where):
        fields: Mapping[str, object] = row if isinstance(row, dict) else {}
        axis, offset = (
            numbers(fields.get("axis"), 3, where),
            numbers(fields.get("offset"), 3, where),
        )
        if not axis.any():
            raise _bad(where, "an axis other than 0")
        pairs.append((tuple(axis.tolist()), tuple((offset / MM).tolist())))
    return tuple(pairs)


def _rows(value: object, where: str) -> list[Any]:
    if value is None:
        return []
    if not isinstance(value, list) or len(value) > MAX_SYMMETRIES:
        raise _bad(where, f"a list of at most {MAX_SYMMETRIES}")
    return value


def _bad(got: str, allowed: str) -> UserError:
    return UserError(got, allowed, "correct the file or download it again")
