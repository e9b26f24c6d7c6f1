"""Files of a calibration: robot poses and touched points as input, YAML files as results.

Poses of a robot's flange are read from CSV, JSON or YAML, one record per pose. A record has x, y, z
and a rotation: qw, qx, qy, qz; or rx, ry, rz (rotation vector); or roll, pitch, yaw (about the
fixed x, then y, then z). ``name`` is the name of the image. In JSON and YAML, a ``matrix`` of 4×4
numbers, row by row, may replace position and rotation.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.core.files import check_target, read_limited, write_file
from dopepp.core.json import read_json
from dopepp.core.yaml import read_yaml
from dopepp.geometry.camera import make_transform
from dopepp.geometry.transform_file import parse_transform
from dopepp.parts.part import UNITS

ROTATIONS: Final = {
    "quaternion": ("qw", "qx", "qy", "qz"),
    "rotation vector": ("rx", "ry", "rz"),
    "roll, pitch, yaw": ("roll", "pitch", "yaw"),
}

NAMES: Final = ("name", "image", "picture", "file", "filename")
MAX_BYTES: Final = 4_000_000
ROUNDED: Final = 1e-2  # largest absolute entry of R Rᵀ − I in a file
FORMAT: Final = (
    "one record per pose with x, y, z and qw, qx, qy, qz or rx, ry, rz or roll, pitch, yaw "
    "(and the image's name)"
)

Record = Mapping[str, object]  # by the field's name in lower case


@dataclass(frozen=True)
class PoseFormat:
    """Conventions of a file of robot poses: units, order of quaternions, direction."""

    unit: str = "m"  # length unit of positions: m, mm, cm or inch
    degrees: bool = False  # whether angles are in degrees (default: radians)
    order: str = "wxyz"  # `xyzw` if w is in the last quaternion column, whatever its name
    inverted: bool = False  # whether the poses are T_flange_base


@dataclass(frozen=True, eq=False)
class RobotPoses:
    """Robot poses as written in a file, before conversion of units and conventions."""

    names: tuple[str, ...]  # file name of each image, empty if the record has none
    positions: Float[np.ndarray, "poses 3"]  # in the file's length unit
    kind: str  # representation of the rotations: a key of `ROTATIONS`, or `matrix`
    rotations: Float[np.ndarray, "poses numbers"]  # 4, 3 or (matrix, row by row) 9 numbers each
    source: str  # path of the file, for messages

    def transforms(self, pose_format: PoseFormat) -> Float[np.ndarray, "poses 4 4"]:
        """Return T_base_flange of each pose in metres; ``pose_format`` describes the file."""
        numbers, degrees = self.rotations, pose_format.degrees
        if self.kind == "quaternion":
            is_w_first = pose_format.order == "wxyz"
            rotations = Rotation.from_quat(numbers[:, [1, 2, 3, 0]] if is_w_first else numbers)
        elif self.kind == "rotation vector":
            rotations = Rotation.from_rotvec(numbers, degrees=degrees)
        elif self.kind == "matrix":
            rotations = Rotation.from_matrix(numbers.reshape(-1, 3, 3))
        else:
            rotations = Rotation.from_euler("xyz", numbers, degrees=degrees)
        T = make_transform(rotations.as_matrix(), self.positions * UNITS[pose_format.unit])
        return np.linalg.inv(T) if pose_format.inverted else T


def read_robot_poses(path: Path) -> RobotPoses:
    """Read a CSV, JSON or YAML file of robot poses.

    Raises:
        UserError: The file is missing, too large or damaged, does not have the fields of
            :data:`FORMAT`, or has an invalid number.
    """
    suffix = path.suffix.lower()
    if suffix == ".csv":
        records = _read_csv(path)
    elif suffix in (".json", ".yaml", ".yml"):
        is_json = suffix == ".json"
        records = _records(read_json(path, MAX_BYTES) if is_json else read_yaml(path), path)
    else:
        fix = f"write a file with {FORMAT}"
        raise UserError(f"robot poses {path}", "a .csv, .json or .yaml file", fix)
    if not records:
        raise UserError(f"{path} without a pose", FORMAT, "write one record per pose")
    names = tuple(
        next((str(record[key]).strip() for key in NAMES if record.get(key) not in (None, "")), "")
        for record in records
    )
    if "matrix" in records[0]:
        matrices = ({"matrix": record.get("matrix")} for record in records)
        T = np.stack(
            [
                parse_transform(matrix, f"{path}, pose {row}", ROUNDED)
                for row, matrix in enumerate(matrices, 1)
            ]
        )
        rotations = T[:, :3, :3].reshape(-1, 9)
        return RobotPoses(names, T[:, :3, 3], "matrix", rotations, str(path))
    fields = records[0].keys()
    kind = next((kind for kind, needed in ROTATIONS.items() if {*needed} <= fields), None)
    if kind is None or not {"x", "y", "z"} <= fields:
        problem = f"{path} with the columns {', '.join(sorted(fields))[:200]}"
        raise UserError(problem, FORMAT, "rename the columns to these names")
    numbers = _numbers(records, ("x", "y", "z", *ROTATIONS[kind]), path)
    zeros = np.flatnonzero(np.abs(numbers[:, 3:]).max(axis=1) <= 1e-6)
    if kind == "quaternion" and len(zeros):
        problem, fix = f"{path}, pose {zeros[0] + 1}: quaternion 0, 0, 0, 0", "delete this pose"
        raise UserError(problem, "unit quaternions", fix)
    return RobotPoses(names, numbers[:, :3], kind, numbers[:, 3:], str(path))


def read_points(path: Path, unit: str) -> Float[np.ndarray, "points 3"]:
    """Read a CSV file of points x, y, z in a length unit (:data:`UNITS`); return metres.

    Raises:
        UserError: As for :func:`read_robot_poses`.
    """
    records, axes = _read_csv(path), ("x", "y", "z")
    if records and not records[0].keys() >= {*axes}:
        problem = f"{path} with the columns {', '.join(map(str, records[0]))[:200]}"
        raise UserError(problem, "columns x, y and z", "name the columns in the first line")
    return _numbers(records, axes, path).reshape(-1, 3) * UNITS[unit]


def _read_csv(path: Path) -> list[Record]:
    """Read the rows of a CSV file as mappings from lower-case column names to texts."""
    try:
        lines = read_limited(path, MAX_BYTES).decode("utf-8-sig").splitlines()
        separator = ";" if lines and ";" in lines[0] else ","
        rows = list(csv.DictReader(lines, delimiter=separator))
    except (OSError, ValueError, csv.Error) as error:
        allowed = f"a readable CSV file of at most {MAX_BYTES / 1e6:g} MB"
        fix = "pass the path of a CSV file in UTF-8"
        raise UserError(f"{path}: {error!s:.200}", allowed, fix) from error
    return [_with_lower_keys(row) for row in rows]


def _with_lower_keys(record: Mapping[Any, object]) -> Record:
    """Convert the names of a record's fields to lower case."""
    return {str(key).strip().lower(): value for key, value in record.items()}


def _records(content: object, path: Path) -> list[Record]:
    """Return the records in parsed JSON or YAML: a list, or a mapping from image names.

    Names of fields are converted to lower case.
    """
    if isinstance(content, Mapping):
        content = [
            {"name": name, **record} if isinstance(record, Mapping) else record
            for name, record in content.items()
        ]
    if not isinstance(content, list) or not all(isinstance(item, Mapping) for item in content):
        raise UserError(f"{path}: not a list of records", FORMAT, "write one record per pose")
    return [_with_lower_keys(item) for item in content]


def _numbers(
    records: Sequence[Record], keys: Sequence[str], path: Path
) -> Float[np.ndarray, "records keys"]:
    """Return the fields ``keys`` of all records; raise a ``UserError`` unless all are finite."""

    def number(record: Record, key: str, row: int) -> float:
        try:
            value = float(record[key])  # type: ignore[arg-type]
        except (KeyError, TypeError, ValueError):
            value = np.nan
        if not np.isfinite(value):
            problem = f"{path}, pose {row}: {key}={record.get(key)!r:.50}"
            raise UserError(problem, "a finite number", "write the number, or delete that pose")
        return value

    return np.array(
        [[number(record, key, row) for key in keys] for row, record in enumerate(records, 1)]
    )


def match_images(poses: RobotPoses, images: Sequence[str]) -> dict[str, int]:
    """Return the pose's index by name of the image.

    Names match with or without suffix; poses without names match by order.

    Raises:
        UserError: A pose names an image that does not exist, two poses name one image, or there
            are no names and the numbers of poses and images differ.
    """
    if any(poses.names):
        full_names = {name: name for name in images}
        full_names |= {name.rpartition(".")[0]: name for name in images}
        missing = [name for name in poses.names if name not in full_names]
        if missing:
            raise UserError(
                f"{poses.source}: {len(missing)} poses without an image, the first "
                f"{missing[0]!r:.80}",
                f"names such as {images[0] if images else '…'!r}",
                "set the name of each pose to the file name of its image, or pass the folder with "
                "these images",
            )
        rows = {full_names[name]: row for row, name in enumerate(poses.names)}
        if len(rows) < len(poses.names):
            used = [full_names[name] for name in poses.names]
            repeated = next(name for name in used if used.count(name) > 1)
            problem = f"{poses.source}: {used.count(repeated)} poses of the image {repeated}"
            raise UserError(problem, "one pose for every image", "delete the wrong poses")
        return rows
    if len(poses.names) != len(images):
        problem = f"{len(poses.names)} poses and {len(images)} images"
        fix = "add a column `name` with the image of every pose"
        raise UserError(problem, "one pose for every image", fix)
    return {name: row for row, name in enumerate(images)}


def write_calibration(
    path: Path, kind: str, values: Mapping[str, Any], findings: Sequence[str], force: bool
) -> None:
    """Write the result ``values`` of a calibration, e.g. ``hand-eye``, to a YAML file.

    With findings, i.e. reasons not to trust the calibration, the file is marked as not trusted.

    Raises:
        UserError: There are findings and ``force`` is false, or the file cannot be written.
    """
    check_trust(findings, force)
    check_target(path, (".yaml", ".yml"))
    content = {"calibration": kind, "trusted": not findings, **values}
    if findings:
        content["doubts"] = list(findings)
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, allow_unicode=True)
    write_file(path, text.encode())


def check_trust(findings: Sequence[str], force: bool) -> None:
    """Reject a calibration that has findings, i.e. reasons not to trust it.

    Raises:
        UserError: There are findings, and ``force`` is false.
    """
    if findings and not force:
        problem = f"a calibration that is not trustworthy: {'; '.join(findings)}"
        fix = "measure again as advised, or add --force to write it anyway"
        raise UserError(problem, "a calibration without findings", fix)
