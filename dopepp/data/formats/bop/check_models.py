"""The objects of a BOP data set, as far as ``models_info.json`` tells and with what is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dopepp.data.formats.bop.models import INFO_FILE, MODEL_FOLDERS
from dopepp.data.formats.problems import (
    CheckReport,
    load_json,
    mapping,
    numbers,
)
from dopepp.data.formats.tolerances import DIAMETERS_MM, rotation_problem
from dopepp.geometry.cuboid import cuboid_keypoints

_ROUNDING: float = 1.001


"""Diameters and boxes are rounded to a few digits."""


@dataclass(frozen=True)
class Model:
    """An object's size, millimetres; None where it is not stated or damaged."""

    diameter: float | None
    corners: NDArray[np.float64] | None


Models = dict[int, Model]


def load_models(report: CheckReport, roots: Sequence[Path]) -> Models | None:
    """Check the first ``models*/models_info.json`` below one of the folders; None without one."""
    paths = (root / folder / INFO_FILE for root in roots for folder in MODEL_FOLDERS)
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        report.note(f"no {INFO_FILE}: objects' numbers, sizes and boxes are not checked")
        return None
    records = load_json(report, path)
    if not isinstance(records, dict):
        if records is not None:
            report.add(path, "top level", f"{records!r:.60}; allowed: objects by number")
        return None
    models: Models = {}
    for key, record in records.items():
        if not (key.isascii() and key.isdecimal() and len(key) < 10) or int(key) in models:
            report.add(path, f"{key!r:.40}", "an object's number, each once")
            continue
        models[int(key)] = _model(report, path, key, record)
        mesh = path.parent / f"obj_{int(key):06d}.ply"
        if not mesh.is_file():
            report.add(mesh, "file", "missing")
    return models


def _model(report: CheckReport, path: Path, key: str, record: Any) -> Model:
    if not isinstance(record, dict):
        report.add(path, key, f"{record!r:.60}; allowed: a JSON object")
        return Model(None, None)
    stated = numbers(report, path, f"{key}.diameter", record.get("diameter"), 1)
    diameter = None if stated is None else float(stated[0])
    if diameter is not None and not DIAMETERS_MM[0] <= diameter <= DIAMETERS_MM[1]:
        least, most = DIAMETERS_MM
        message = f"{diameter:.4g} mm; allowed: {least:g} … {most:g} mm: is it in another unit?"
        report.add(path, f"{key}.unit", message)
        diameter = None
    _check_symmetries(report, path, key, record)
    bounds = [record.get(f"{what}_{axis}") for what in ("min", "size") for axis in "xyz"]
    if all(value is None for value in bounds):
        return Model(diameter, None)
    box = numbers(report, path, f"{key}.min_x … size_z", bounds, 2, 3)
    if box is None or (box[1] < 0).any():
        if box is not None:
            report.add(path, f"{key}.size_x … size_z", f"{box[1].tolist()}; allowed: 0 and above")
        return Model(diameter, None)
    length = float(np.linalg.norm(box[1]))
    if diameter is not None and not (
        box[1].max() <= diameter * _ROUNDING and diameter <= length * _ROUNDING
    ):
        message = f"{diameter:.5g} mm for a box of {np.round(box[1], 3).tolist()} mm"
        report.add(path, f"{key}.diameter", message)
    return Model(diameter, cuboid_keypoints(box[0], box[0] + box[1])[:8])


def _check_symmetries(report: CheckReport, path: Path, key: str, record: dict[str, Any]) -> None:
    discrete = record.get("symmetries_discrete")
    for number, row in enumerate(discrete if isinstance(discrete, list) else []):
        where = f"{key}.symmetries_discrete[{number}]"
        matrix = numbers(report, path, where, row, 4, 4)
        problem = None if matrix is None else rotation_problem(matrix[:3, :3])
        if problem is not None:
            report.add(path, where, problem)
    continuous = record.get("symmetries_continuous")
    for number, row in enumerate(continuous if isinstance(continuous, list) else []):
        where = f"{key}.symmetries_continuous[{number}]"
        axis = numbers(report, path, f"{where}.axis", mapping(row).get("axis"), 3)
        numbers(report, path, f"{where}.offset", mapping(row).get("offset"), 3)
        if axis is not None and not axis.any():
            report.add(path, f"{where}.axis", "zero")
