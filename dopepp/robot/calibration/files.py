"""A calibration's files: robot poses that are read, results that are written.

Poses of a robot's flange come as CSV, JSON or YAML, a record a pose.

A record has x, y, z and a rotation: qw, qx, qy, qz; or rx, ry, rz (rotation vector); or roll,
pitch, yaw (about the fixed x, then y, then z). ``name`` is the picture's. In JSON and YAML a
``matrix`` of 4×4 numbers, row by row, may stand for both.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.core.files import check_target, write_whole
from dopepp.core.json import read_json
from dopepp.core.yaml import read_yaml
from dopepp.geometry.camera import Transform
from dopepp.geometry.rotation import is_rotation, matrix_to_quaternion

UNITS: Final = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "inch": 0.0254}

ROTATIONS: Final = {
    "quaternion": ("qw", "qx", "qy", "qz"),
    "rotation vector": ("rx", "ry", "rz"),
    "roll, pitch, yaw": ("roll", "pitch", "yaw"),
}

NAMES: Final = ("name", "image", "picture", "file", "filename")
MAX_BYTES: Final = 4_000_000

FORMAT: Final = (
    "a record a pose with x, y, z and qw, qx, qy, qz or rx, ry, rz or roll, pitch, yaw "
    "(and name, of the picture)"
)


@dataclass(frozen=True)
class Reading:
    """How a file's numbers are meant."""

    unit: str = "m"  # of positions: m, mm, cm or inch
    degrees: bool = False  # whether angles are degrees, not radians
    # Of a quaternion's numbers: `wxyz` as named, `xyzw` where w stands last.
    order: str = "wxyz"
    inverted: bool = False  # whether the poses map the base into the flange, T_flange_base


@dataclass(frozen=True, eq=False)
class RobotPoses:
    """A file's poses as they stand there."""

    names: tuple[str, ...]  # of their pictures; empty strings where there are none
    positions: Float[np.ndarray, "poses 3"]  # x, y, z
    kind: str  # a key of `ROTATIONS`, or `matrix`
    rotations: Float[np.ndarray, "poses numbers"]  # its numbers
    source: str  # the file

    def transforms(self, reading: Reading) -> Float[np.ndarray, "poses 4 4"]:
        """Return T_base_flange of every pose, metres."""
        T = np.tile(np.eye(4), (len(self.names), 1, 1))
        T[:, :3, :3] = self._rotation(reading).as_matrix()
        T[:, :3, 3] = self.positions * UNITS[reading.unit]
        return np.linalg.inv(T) if reading.inverted else T

    def _rotation(self, reading: Reading) -> Rotation:
        numbers = self.rotations
        if self.kind == "quaternion":
            last = numbers[:, [1, 2, 3, 0]] if reading.order == "wxyz" else numbers
            return Rotation.from_quat(last)
        if self.kind == "rotation vector":
            return Rotation.from_rotvec(numbers, degrees=reading.degrees)
        if self.kind == "matrix":
            return Rotation.from_matrix(numbers.reshape(-1, 3, 3))
        return Rotation.from_euler("xyz", numbers, degrees=reading.degrees)


def read_robot_poses(path: Path) -> RobotPoses:
    """Read a file of robot poses.

    Raises:
        UserError: The file is missing, too large or damaged, has other fields than
            :data:`FORMAT`, or a number that is none.
    """
    suffix = path.suffix.lower()
    if suffix == ".csv":
        records = _csv(path)
    elif suffix in (".json", ".yaml", ".yml"):
        records = _listed(
            read_json(path, MAX_BYTES) if suffix == ".json" else read_yaml(path), path
        )
    else:
        raise UserError(f"robot poses {path}", "a .csv, .json or .yaml file", FORMAT)
    if not records:
        raise UserError(f"{path} without a pose", FORMAT, "write a record a pose")
    names = tuple(
        next((str(record[key]) for key in NAMES if record.get(key)), "") for record in records
    )
    if "matrix" in records[0]:
        whole = np.stack([_matrix(one, number, path) for number, one in enumerate(records)])
        return RobotPoses(
            names, whole[:, :3, 3], "matrix", whole[:, :3, :3].reshape(-1, 9), str(path)
        )
    fields = {str(one).strip().lower() for one in records[0]}
    kind = next((kind for kind, needed in ROTATIONS.items() if set(needed) <= fields), None)
    if kind is None or not {"x", "y", "z"} <= fields:
        raise UserError(
            f"{path} with {', '.join(sorted(fields))[:200]}", FORMAT, "name the columns so"
        )
    numbers = np.array(
        [[_number(one, key, number, path) for key in ("x", "y", "z", *ROTATIONS[kind])]
         for number, one in enumerate(records)]
    )  # fmt: skip
    if kind == "quaternion" and not (np.abs(numbers[:, 3:]).max(axis=1) > 1e-6).all():
        raise UserError(f"{path}: a quaternion of zeros", "unit quaternions", "remove that pose")
    return RobotPoses(names, numbers[:, :3], kind, numbers[:, 3:], str(path))


def read_points(path: Path, unit: str) -> Float[np.ndarray, "points 3"]:
    """Read points that a tool's tip has touched, x, y, z in the base's frame; return metres.

    Raises:
        UserError: As :func:`read_robot_poses`.
    """
    records = _csv(path)
    values = [
        [_number(one, key, number, path) for key in "xyz"] for number, one in enumerate(records)
    ]
    return np.array(values).reshape(-1, 3) * UNITS[unit]


def check_unit(unit: str) -> str:
    """Return a unit that there is; another is a :class:`UserError`."""
    if unit not in UNITS:
        raise UserError(f"--unit {unit}", ", ".join(UNITS), "pass one of these")
    return unit


def _csv(path: Path) -> list[Mapping[object, object]]:
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
        text = content.decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(
            f"{path}: {error!s:.200}", "a readable CSV file", "check the path"
        ) from error
    if len(content) > MAX_BYTES:
        raise UserError(f"{path} of over {MAX_BYTES / 1e6:g} MB", FORMAT, "pass the poses' file")
    separator = ";" if text.partition("\n")[0].count(";") >= 3 else ","
    rows = csv.DictReader(io.StringIO(text), delimiter=separator)
    return [{str(key).strip().lower(): value for key, value in row.items()} for row in rows]


def _listed(content: object, path: Path) -> list[Mapping[object, object]]:
    """Return the records of a list, or of a mapping from the pictures' names."""
    if isinstance(content, Mapping):
        content = [
            {"name": name, **one} if isinstance(one, Mapping) else one
            for name, one in content.items()
        ]
    if not isinstance(content, list) or not all(isinstance(one, Mapping) for one in content):
        raise UserError(f"{path}: no list of records", FORMAT, "write a record a pose")
    return content


def _number(record: Mapping[object, object], key: str, number: int, path: Path) -> float:
    try:
        value = float(record[key])  # type: ignore[arg-type]
    except (KeyError, TypeError, ValueError):
        value = np.nan
    if not np.isfinite(value):
        got = f"{path}, pose {number + 1}: {key}={record.get(key)!r:.50}"
        raise UserError(got, "a finite number", "correct or remove that pose")
    return value


def _matrix(record: Mapping[object, object], number: int, path: Path) -> Float[np.ndarray, "4 4"]:
    try:
        values = np.array(record["matrix"], np.float64).reshape(4, 4)
    except (KeyError, TypeError, ValueError):
        values = np.full((4, 4), np.nan)
    R = values[:3, :3]
    rigid = np.isfinite(values).all() and np.abs(R @ R.T - np.eye(3)).max() < 1e-2
    if not rigid or np.linalg.det(R) < 0:
        got = f"{path}, pose {number + 1}: matrix={record.get('matrix')!r:.80}"
        raise UserError(got, "4×4 numbers of a rigid transform, row by row", "correct that pose")
    return values


def matched(poses: RobotPoses, pictures: Sequence[str]) -> list[tuple[int, int]]:
    """Pair poses with pictures, by name where poses have names, else in order.

    Returns (pose, picture) pairs. A :class:`UserError`: a name is none of a picture, or numbers
    differ.
    """
    if any(poses.names):
        places = {name: k for k, name in enumerate(pictures)}
        places |= {name.rpartition(".")[0]: k for k, name in enumerate(pictures)}
        unknown = [one for one in poses.names if one not in places]
        if unknown:
            raise UserError(
                f"{poses.source}: {len(unknown)} poses of pictures that are not there, the first "
                f"{unknown[0]!r:.80}", f"names as {pictures[0] if pictures else '…'!r}",
                "correct the names, or pass the right folder",
            )  # fmt: skip
        return [(k, places[one]) for k, one in enumerate(poses.names)]
    if len(poses.names) != len(pictures):
        raise UserError(
            f"{len(poses.names)} poses and {len(pictures)} pictures", "one pose a picture",
            "add a column `name` with the picture of every pose",
        )  # fmt: skip
    return [(k, k) for k in range(len(pictures))]


def write_calibration(
    path: Path, kind: str, values: Mapping[str, Any], findings: Sequence[str], force: bool
) -> None:
    """Write a calibration if it is to be trusted, or, marked so, by force.

    A :class:`UserError`: it is not to be trusted and ``force`` is false, with the findings.
    """
    check_trust(findings, force)
    check_target(path, (".yaml", ".yml"))
    content = {"calibration": kind, "trusted": not findings, **values}
    if findings:
        content["doubts"] = list(findings)
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, allow_unicode=True)
    write_whole(path, text.encode())


def check_trust(findings: Sequence[str], force: bool) -> None:
    """Refuse a calibration with findings, unless by force."""
    if findings and not force:
        raise UserError(
            "a calibration that is not to be trusted: " + "; ".join(findings),
            "one without doubts", "do that, or write it all the same with --force",
        )  # fmt: skip


def read_transform(path: Path, name: str) -> Transform:
    """Return a transform of a calibration's file, e.g. ``T_flange_cam``.

    A :class:`UserError`: the file is none, has no such transform, or it is not rigid.
    """
    content = read_yaml(path)
    values = content.get(name) if isinstance(content, Mapping) else None
    try:
        T = np.array(values["matrix"] if isinstance(values, Mapping) else None, np.float64)
    except (KeyError, TypeError, ValueError):
        T = np.zeros(0)
    if T.shape != (4, 4) or not is_rotation(T[:3, :3], 1e-6) or not np.isfinite(T).all():
        raise UserError(
            f"{path} without {name}", f"{name}: {{matrix: 4×4 numbers of a rigid transform}}",
            "pass the file that `dopepp calibrate` has written",
        )  # fmt: skip
    return T


def transform_record(T: Transform) -> dict[str, object]:
    """Return a transform as matrix, position (metres) and quaternion (w, x, y, z)."""
    return {
        "matrix": [[float(one) for one in row] for row in T],
        "position": [float(one) for one in T[:3, 3]],
        "quaternion_wxyz": [float(one) for one in matrix_to_quaternion(T[:3, :3])],
    }
