"""Rigid transforms in YAML and JSON files, e.g. in the files of ``dopepp calibrate``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.core.validation import short_repr
from dopepp.core.yaml import read_yaml
from dopepp.geometry.camera import Transform, make_transform
from dopepp.geometry.rotation import (
    is_rigid,
    matrix_to_quaternion,
    nearest_rotation,
    quaternion_to_matrix,
)

_FORMS: Final = (
    "matrix: 4×4 numbers; ROS's translation and rotation; or position (metres) with "
    "quaternion_wxyz or quaternion_xyzw"
)
ROUNDED: Final = 1e-3
"""Largest deviation from orthogonality of matrices that were written with a few digits."""

EXACT: Final = 1e-6
"""Largest deviation from orthogonality of matrices that ``dopepp calibrate`` has written."""

_FIX: Final = "write the transform in metres, or pass a file from `dopepp calibrate`"


def transform_record(T: Transform) -> dict[str, object]:
    """Return a transform as a dictionary: matrix, position (metres) and quaternion (w, x, y, z)."""
    return {
        "matrix": T.tolist(),
        "position": T[:3, 3].tolist(),
        "quaternion_wxyz": matrix_to_quaternion(T[:3, :3]).tolist(),
    }


def read_transform(path: Path, name: str, tolerance: float = EXACT) -> Transform:
    """Read a transform by its name from a YAML file, e.g. ``T_flange_cam`` of a hand-eye file.

    ``tolerance`` is the largest absolute entry of R Rᵀ − I for the rotation R.

    Raises:
        UserError: The file cannot be read, or has no rigid transform of this name.
    """
    content = read_yaml(path)
    fields = content if isinstance(content, Mapping) else {}
    if name not in fields:
        problem = f"{path} with the fields {', '.join(map(str, fields)) or 'none'!s:.200}"
        mount = "hand" if name == "T_flange_cam" else "bench"
        fix = f"pass a file from `dopepp calibrate handeye --mount {mount}`"
        raise UserError(problem, f"a file with {name}", fix)
    return parse_transform(fields[name], f"{path}: {name}", tolerance)


def parse_transform(value: object, where: str, tolerance: float = ROUNDED) -> Transform:
    """Parse a rigid transform.

    Args:
        value: Mapping with ``matrix`` (4×4 numbers); with ROS's ``translation`` {x, y, z} and
            ``rotation`` {x, y, z, w}; or with ``position`` and either ``quaternion_wxyz`` or
            ``quaternion_xyzw``. Lengths are metres.
        where: File and field, for error messages.
        tolerance: Largest absolute entry of R Rᵀ − I for the rotation R.

    Raises:
        UserError: The value has none of these forms, or is not a rigid transform.
    """
    fields = value if isinstance(value, Mapping) else {}
    problem = f"{where}={short_repr(value)}"
    try:
        if "matrix" in fields:
            T = np.array(fields["matrix"], np.float64).reshape(4, 4)
        else:
            if "rotation" in fields:
                shift, orientation = fields["translation"], fields["rotation"]
                position = [shift[axis] for axis in "xyz"]
                quaternion = [orientation[axis] for axis in "wxyz"]
            else:
                position = fields["position"]
                x_first = fields.get("quaternion_xyzw")
                quaternion = (
                    fields["quaternion_wxyz"] if x_first is None else [*x_first[3:], *x_first[:3]]
                )
            R = quaternion_to_matrix(np.array(quaternion, np.float64).reshape(4))
            T = make_transform(R, np.array(position, np.float64).reshape(3))
    except (LookupError, OverflowError, TypeError, ValueError):
        raise UserError(problem, _FORMS, _FIX) from None
    if not is_rigid(T, tolerance):
        raise UserError(problem, "a rigid transform", _FIX)
    return make_transform(nearest_rotation(T[:3, :3]), T[:3, 3])
