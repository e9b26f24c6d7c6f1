"""Read what a YCB-Video ``meta.mat`` still holds, every pose by itself."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import scipy.io
from numpy.typing import NDArray

from dopepp.data.checking.report import CheckReport
from dopepp.data.checking.values import numbers
from dopepp.data.ycb_meta import read_meta
from dopepp.errors import UserError

_FIELDS: Final = ("cls_indexes", "poses", "intrinsic_matrix", "factor_depth")
_MAX_META_BYTES: Final = 256_000_000


def load_meta(report: CheckReport, path: Path) -> Mapping[str, Any] | None:
    """Return the fields of a ``meta.mat``, None where there are none to look at."""
    if not path.is_file():
        report.add(path, "file", "missing")
        return None
    if path.stat().st_size > _MAX_META_BYTES:
        report.add(path, "file", f"{path.stat().st_size:,} bytes; at most {_MAX_META_BYTES:,}")
        return None
    try:
        fields = scipy.io.loadmat(path, variable_names=_FIELDS)
    except Exception as error:  # SciPy lets through whatever a damaged byte happens to cause
        report.add(path, "file", f"damaged ({error})")
        return None
    for name in ("cls_indexes", "poses", "factor_depth"):
        if name not in fields:
            report.add(path, name, "missing")
    try:
        read_meta(path)
    except UserError as error:
        if "cut short" in error.got:  # all else is a defect of its own below
            report.add(path, "file", error.got.removeprefix(f"{path}: "))
    return fields


def read_poses(
    report: CheckReport, path: Path, fields: Mapping[str, Any], classes: list[str]
) -> dict[int, tuple[str, NDArray[np.float64]]]:
    """Return (field, 3×4 pose) by class index."""
    if "cls_indexes" not in fields or "poses" not in fields:
        return {}
    indices = np.asarray(fields["cls_indexes"]).ravel()
    stack = np.asarray(fields["poses"])
    stack = stack[..., None] if stack.shape == (3, 4) else stack  # MATLAB drops a last axis of 1
    if stack.shape != (3, 4, len(indices)) or stack.dtype.kind not in "fiu":
        message = f"shape {stack.shape} for {len(indices)} classes; allowed: (3, 4, N)"
        report.add(path, "poses", message)
        return {}
    found: dict[int, tuple[str, NDArray[np.float64]]] = {}
    for number, index in enumerate(indices.tolist()):
        where = f"poses[{number}]"
        if index in found:
            report.add(path, f"cls_indexes[{number}]", f"class {index:g} twice")
            continue
        if not 1 <= index <= len(classes) or index != int(index):
            allowed = f"1 … {len(classes)}, the lines of classes.txt"
            report.add(path, f"cls_indexes[{number}]", f"unknown class {index:g}; {allowed}")
            continue
        pose = numbers(report, path, where, stack[..., number], 3, 4)
        found[int(index)] = (where, np.full((3, 4), np.nan) if pose is None else pose)
    return {index: entry for index, entry in found.items() if np.isfinite(entry[1]).all()}
