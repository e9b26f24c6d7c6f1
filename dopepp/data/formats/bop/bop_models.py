"""Read and write BOP's object models: ``obj_000001.ply`` and ``models_info.json``, millimetres.

In addition to BOP's keys, ``models_info.json`` may have the part's ``name``. Otherwise an object is
named after its file.
"""

from __future__ import annotations

import json
import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from dopepp.core.errors import UserError
from dopepp.core.files import encode_image, write_file
from dopepp.data.formats.bop import EXACT, INEXACT, MM, is_number
from dopepp.data.formats.invariants import rotation_problem
from dopepp.data.formats.problems import STRICT, Node, Problems, mapping
from dopepp.geometry.rotation import is_rotation, nearest_rotation
from dopepp.parts.mesh.read import read_mesh
from dopepp.parts.part import MAX_SYMMETRIES, Mesh, Part, check_name, make_part

_log = logging.getLogger(__name__)

_NUMBERED: Final = re.compile(r"obj_(\d{1,9})")

MODEL_FOLDERS: Final = ("models", "models_cad", "models_reconst", "models_eval")
"""Folders of models in BOP's data sets, the full models first."""

INFO_FILE: Final = "models_info.json"

SYMMETRY_FIELDS: Final = ("symmetries_discrete", "symmetries_continuous")
Symmetries = dict[str, Any]
"""The two :data:`SYMMETRY_FIELDS` as arguments of :class:`~dopepp.parts.part.Part`: rigid
transforms without the identity (None if there are none), and (axis, offset) pairs; metres."""

_ALLOWED: Final = 'objects by number, each once: {"1": {"diameter": …}, …}'

_DIAMETER_TOLERANCE: Final = 0.01  # relative difference of the stated from the mesh's diameter


@dataclass(frozen=True)
class ModelInfo:
    """An entry of ``models_info.json``; the diameter is in metres, NaN if not stated."""

    name: str
    path: Path
    diameter: float
    symmetries: Symmetries


def bop_parts(root: str | Path, objects: Sequence[str] | None = None) -> list[Part]:
    """Make parts, with their symmetries, from the models of a BOP data set.

    ``objects`` are names, or stems of the model files (``obj_000001``), in the requested order
    (default: all objects with a file, by number).

    Raises:
        UserError: The folder has no models, or a name is unknown.
    """
    infos = read_models(Path(root))
    if not infos:
        problem = f"{root}, which has no {INFO_FILE} in {', '.join(MODEL_FOLDERS)}"
        fix = "set data.root to the root folder, or unpack the data set's models into it"
        raise UserError(problem, "the root folder of a BOP data set", fix)
    by_name = {info.name: info for info in infos.values()}
    # A part that was trained from the data set's own mesh file is named after the file.
    by_stem = {info.path.stem: replace(info, name=info.path.stem) for info in infos.values()}
    if objects is None:
        present = objects_with_model(infos)
        absent = [info.name for number, info in infos.items() if number not in present]
        if absent:
            _log.warning("%s: ignoring models without a file: %s", root, ", ".join(absent))
        objects = [info.name for number, info in infos.items() if number in present]
    known = by_stem | by_name
    for name in objects:
        if name not in known:
            problem, allowed = f"data.objects with {name!r}", ", ".join(by_name)
            raise UserError(problem, allowed, "set data.objects to one or more of these names")
    return [read_part(known[name]) for name in objects]


def parts_by_id(root: Path, parts: Sequence[Part]) -> dict[int, Part]:
    """Return the parts by BOP object ID.

    Raises:
        UserError: A part is not in ``models_info.json`` or, without this file, not named like
            ``obj_000001``.
    """
    infos = read_models(root)
    names = {info.name: number for number, info in infos.items()}
    stems = {info.path.stem: number for number, info in infos.items()}
    numbered: dict[int, Part] = {}
    for part in parts:
        stated = names.get(part.name, stems.get(part.name))
        number = stated if infos else number_in_name(part.name)
        if number is None:
            raise UserError(
                f"part {part.name!r}, which is not in the data set {root}",
                ", ".join(names) or f"obj_NNNNNN, as there is no {MODEL_FOLDERS[0]}/{INFO_FILE}",
                f'choose one of these parts, or write "name": "{part.name}" into {INFO_FILE}',
            )
        numbered[number] = part
    return numbered


def number_in_name(name: str) -> int | None:
    """Return the number in a name like BOP's ``obj_000005``; None for any other name."""
    numbered = _NUMBERED.fullmatch(name)
    return int(numbered[1]) if numbered else None


def model_numbers(names: Sequence[str]) -> dict[str, int]:
    """Number objects 1, 2, … in the order of names.

    If all names are like BOP's file names (``obj_000005``), use the numbers in the names, so that
    renders of a BOP data set's models keep the data set's numbers.
    """
    stated = {name: number_in_name(name) for name in names}
    numbers = {name: number for name, number in stated.items() if number}
    if len(set(numbers.values())) == len(names):
        return numbers
    return {name: number for number, name in enumerate(names, start=1)}


def read_part(info: ModelInfo) -> Part:
    """Make a part from an object's mesh, which must be in millimetres."""
    mesh = read_mesh(info.path, unit="mm")
    try:
        part = make_part(info.name, mesh, unit="mm", **info.symmetries)
    except UserError as error:  # a wrong size may mean a wrong unit; BOP has only one
        allowed = f"{error.allowed}, from a file in millimetres as BOP requires"
        fix = "download the model again, or convert its file to millimetres"
        raise UserError(f"{info.path}: {error.got}", allowed, fix) from error
    if abs(info.diameter - part.diameter) > _DIAMETER_TOLERANCE * part.diameter:
        stated = f"{INFO_FILE} states a diameter of {info.diameter:.6g} m"
        used = f"its vertices have {part.diameter:.6g} m, which is used"
        _log.warning("%s: %s, %s", info.path, stated, used)
    return part


def read_models(root: Path) -> dict[int, ModelInfo]:
    """Return the objects of ``models_info.json`` by number; empty without the file."""
    path = info_path(root)
    return {} if path is None else parse_models(path, Node(STRICT, path).load(_ALLOWED))


def objects_with_model(infos: Mapping[int, ModelInfo]) -> set[int]:
    """Return the numbers of objects with a model file, or of all objects if none has a file."""
    with_file = {number for number, info in infos.items() if info.path.is_file()}
    return with_file or set(infos)


def info_path(root: Path) -> Path | None:
    """Return the path of a data set's ``models_info.json``, or None if missing."""
    paths = (root / folder / INFO_FILE for folder in MODEL_FOLDERS)
    return next((path for path in paths if path.is_file()), None)


def parse_models(path: Path, records: object, problems: Problems = STRICT) -> dict[int, ModelInfo]:
    """Return the objects in ``records``, the content of the ``models_info.json`` at ``path``."""
    node = Node(problems, path)
    if not isinstance(records, dict):
        node["top level"].report(f"{records!r:.60}", _ALLOWED)
    infos: dict[int, ModelInfo] = {}
    names: set[str] = set()
    for key, record in mapping(records).items():
        if not is_number(key) or int(key) in infos:
            node[f"{key!r:.40}"].report("not an object number, or a repeated number", _ALLOWED)
            continue
        info = _info(node[key], path.parent / f"obj_{int(key):06d}.ply", record)
        if info.name in names:
            node[key]["name"].report(f"{info.name!r:.60} twice", "each name once")
        names.add(info.name)
        infos[int(key)] = info
    return dict(sorted(infos.items()))


def _info(node: Node, model: Path, record: object) -> ModelInfo:
    if not isinstance(record, dict):
        node.report(f"{record!r:.60}", "an object with diameter and symmetries")
    fields, diameter = mapping(record), math.nan
    if "diameter" in fields:
        diameter = node["diameter"].scalar(fields["diameter"]) / MM
        if diameter <= 0:
            node["diameter"].report(f"{fields['diameter']!r:.40}", "millimetres above 0")
            diameter = math.nan
    name = node["name"].attempt(lambda: check_name(fields.get("name", model.stem)))
    return ModelInfo(name or model.stem, model, diameter, _symmetries(node, fields))


def _symmetries(node: Node, fields: Mapping[str, Any]) -> Symmetries:
    readers = zip(SYMMETRY_FIELDS, (_discrete, _continuous), strict=True)
    return {name: read(node[name], fields.get(name)) for name, read in readers}


def parse_symmetries(name: str, fields: object) -> Symmetries:
    """Return the symmetries in a config's entry, in the format of ``models_info.json``."""
    node = Node(STRICT, f"data.symmetries.{name}")
    if not isinstance(fields, Mapping) or not {*fields} <= {*SYMMETRY_FIELDS}:
        node.report(f"{fields!r:.80}", f"{' and '.join(SYMMETRY_FIELDS)} as in BOP")
    return _symmetries(node, mapping(fields))


def _discrete(node: Node, value: object) -> Float[np.ndarray, "symmetries 4 4"] | None:
    """Parse discrete symmetries into metres, without the identity; report invalid transforms."""
    transforms = []
    for number, row in enumerate(_rows(node, value)):
        matrix = node[number].numbers(row, 4, 4)
        problem = rotation_problem(matrix[:3, :3], INEXACT)
        if problem is None and (matrix[3] != [0, 0, 0, 1]).any():
            problem = f"a last row of {matrix[3].tolist()}"
        if problem is not None:
            if np.isfinite(matrix).all():
                node[number].report(problem, "rigid transforms [R t; 0 0 0 1], row by row")
            continue
        if not is_rotation(matrix[:3, :3], EXACT):
            matrix[:3, :3] = nearest_rotation(matrix[:3, :3])
        matrix[:3, 3] /= MM
        if not np.allclose(matrix, np.eye(4), atol=1e-9):
            transforms.append(matrix)
    return np.array(transforms) if transforms else None


def _continuous(
    node: Node, value: object
) -> tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]:
    """Parse continuous symmetries into pairs of axis and offset, metres."""
    pairs = []
    for number, row in enumerate(node.entries(_rows(node, value))):
        entry = node[number]
        axis, offset = (entry[name].numbers(row.get(name), 3) for name in ("axis", "offset"))
        if not axis.any():
            entry["axis"].report("zero", "an axis other than 0")
        pairs.append((tuple(axis.tolist()), tuple((offset / MM).tolist())))
    return tuple(pairs)


def _rows(node: Node, value: object) -> list[Any]:
    """Return a list of symmetries; report any other value or an overlong list and return []."""
    if value is None or (isinstance(value, list) and len(value) <= MAX_SYMMETRIES):
        return value or []
    node.report(f"{value!r:.60}", f"a list of at most {MAX_SYMMETRIES}")
    return []


def write_models(root: Path, parts: Sequence[Part]) -> None:
    """Write the parts' models, numbered by :func:`model_numbers`; ``models_info.json`` comes last.

    Raises:
        UserError: A part has no mesh, or the folder holds models of other parts.
    """
    for part in parts:
        if part.mesh is None:
            allowed = "parts that were read from a mesh file"
            fix = "pass the part's mesh file"
            raise UserError(f"part {part.name} without a mesh", allowed, fix)
    folder, names = root / MODEL_FOLDERS[0], [part.name for part in parts]
    numbers = model_numbers(names)
    entries = {str(numbers[part.name]): model_info(part) for part in parts}
    content = (json.dumps(entries, indent=2, ensure_ascii=False) + "\n").encode()
    path = folder / INFO_FILE
    if path.exists():
        if path.read_bytes() != content:
            problem, allowed = f"{path}, written for other parts", f"a folder for {names}"
            raise UserError(problem, allowed, "pass an empty folder")
        return
    for part in parts:
        model = folder / f"obj_{numbers[part.name]:06d}.ply"
        texture = model.with_suffix(".png")
        assert part.mesh is not None
        write_file(model, ply_bytes(part.mesh, texture.name))
        if part.mesh.texture is not None:
            write_file(texture, encode_image(part.mesh.texture))
    write_file(path, content)


def model_info(part: Part) -> dict[str, object]:
    """Return a part's entry of ``models_info.json``: lengths in mm, transforms row by row."""
    lower = part.cuboid[:8].min(axis=0) * MM
    size = part.cuboid[:8].max(axis=0) * MM - lower
    record: dict[str, object] = {"name": part.name, "diameter": part.diameter * MM}
    for axis, first, extent in zip("xyz", lower.tolist(), size.tolist(), strict=True):
        record |= {f"min_{axis}": first, f"size_{axis}": extent}
    if part.symmetries_discrete is not None and len(part.symmetries_discrete):
        scaled = part.symmetries_discrete.copy()
        scaled[:, :3, 3] *= MM
        record["symmetries_discrete"] = scaled.reshape(-1, 16).tolist()
    if part.symmetries_continuous:
        record["symmetries_continuous"] = [
            {"axis": list(axis), "offset": [value * MM for value in offset]}
            for axis, offset in part.symmetries_continuous
        ]
    return record


def ply_bytes(mesh: Mesh, texture_name: str) -> bytes:
    """Encode a mesh as binary PLY, millimetres, that names its texture's file, if any."""
    import trimesh  # slow to import, and only needed for writing

    # Weighted by the faces' angles at the vertex, like BOP's normals (Thürmer, Wüthrich 1998).
    normals = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).vertex_normals
    columns = {"x y z": mesh.vertices * MM, "nx ny nz": np.asarray(normals)}
    has_texture = mesh.texture is not None and mesh.uv is not None
    if has_texture:
        columns["texture_u texture_v"] = np.asarray(mesh.uv)
    names = " ".join(columns).split()
    channels = () if mesh.colours is None else ("red", "green", "blue")
    vertices = np.empty(
        len(mesh.vertices), [("numbers", "<f4", len(names)), ("colour", "u1", len(channels))]
    )
    vertices["numbers"] = np.hstack(list(columns.values()))
    if mesh.colours is not None:
        vertices["colour"] = mesh.colours
    faces: NDArray[Any] = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *([f"comment TextureFile {texture_name}"] if has_texture else []),
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in names),
        *(f"property uchar {name}" for name in channels),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()
