"""A calibration's file: YAML that says what it is, from which data, and whether to trust it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dopepp.core.errors import UserError
from dopepp.core.files import check_target, write_whole
from dopepp.core.yaml import read_yaml
from dopepp.geometry.camera import Transform
from dopepp.geometry.rotation import is_rotation, matrix_to_quaternion


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
