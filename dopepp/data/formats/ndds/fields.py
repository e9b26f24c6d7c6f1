"""The fields of an NDDS annotation: what is there has its shape and its range.

What is wrong with one goes to the :class:`~dopepp.data.formats.problems.Problems`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from dopepp.data.formats.problems import STRICT, Problems, entries, load_object, mapping, numbers
from dopepp.geometry.camera import CameraMatrix, camera_matrix
from dopepp.geometry.rotation import Vector

MAX_ITEM_BYTES: Final = 16_000_000
"""Of one image's annotation; a hundred objects take 0.5 MB."""

_NORM_TOLERANCE: Final = 0.1
"""Of a quaternion's norm from 1."""

Objects = list[tuple[str, Mapping[str, Any], str]]
"""(field, object, class) of every object of an annotation."""


@dataclass(frozen=True)
class NddsObject:
    """One object as an annotation states it, units and orders still unknown; NaN where damaged.

    Attributes:
        field: Where it stands, e.g. ``objects[2]``.
        quaternion: The four numbers under ``quaternion_xyzw``, in whatever order.
        corners_px: ``projected_cuboid`` without its centroid; None where it is not given.
        cuboid: The same corners in space; None where they are not given.
        centroid: ``cuboid_centroid`` or, without one, the mean of ``cuboid``; None without both.
        visibility: In [0, 1], or −1 for unknown; None where it is not given.
        segmentation_id: Value of its pixels in ``STEM.seg.png``; None where it is not given.
    """

    field: str
    label: str
    location: Vector
    quaternion: Float[np.ndarray, "4"]
    corners_px: Float[np.ndarray, "8 2"] | None
    cuboid: Float[np.ndarray, "8 3"] | None
    centroid: Vector | None
    visibility: float | None
    segmentation_id: int | None


def read_record(path: Path, problems: Problems = STRICT) -> Mapping[str, Any] | None:
    """Read an annotation or a settings file, None where that is impossible."""
    return load_object(problems, path, max_bytes=MAX_ITEM_BYTES)


def objects_of(record: Mapping[str, Any], path: Path, problems: Problems = STRICT) -> Objects:
    """Return the objects of an annotation; each needs a class."""
    found: Objects = []
    for number, item in enumerate(entries(problems, path, "objects", record.get("objects"))):
        field, label = f"objects[{number}]", item.get("class")
        if not isinstance(label, str):
            problems.report(path, f"{field}.class", f"{label!r:.60}", "a name")
        found.append((field, item, label if isinstance(label, str) else ""))
    return found


def parse_object(
    item: Mapping[str, Any], field: str, path: Path, problems: Problems = STRICT
) -> NddsObject:
    """Read the fields of one object; it needs a location and a quaternion."""

    def take(name: str, *shape: int) -> NDArray[np.float64]:
        return numbers(problems, path, f"{field}.{name}", item.get(name), *shape)

    quaternion = take("quaternion_xyzw", 4)
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > _NORM_TOLERANCE:
        got = f"no rotation: norm {norm:.4g}"
        problems.report(path, f"{field}.quaternion_xyzw", got, "a quaternion of norm 1")
        quaternion = np.full(4, np.nan)
    corners_px, cuboid = (
        # A writer may have appended the centroid as the ninth point.
        take(name, 9 if isinstance(item[name], list) and len(item[name]) == 9 else 8, axes)[:8]
        if item.get(name) not in (None, [])
        else None
        for name, axes in (("projected_cuboid", 2), ("cuboid", 3))
    )
    centroid = None if cuboid is None else cuboid.mean(axis=0)
    if item.get("cuboid_centroid") is not None:
        centroid = take("cuboid_centroid", 3)
    visibility = None if item.get("visibility") is None else float(take("visibility", 1)[0])
    if visibility is not None and (visibility > 1 or (visibility < 0 and visibility != -1)):
        got = f"{visibility:g}"
        problems.report(path, f"{field}.visibility", got, "0 … 1, or −1 for unknown")
        visibility = None
    number = item.get("segmentation_id")
    return NddsObject(
        field,
        str(item.get("class", "")),
        take("location", 3),
        quaternion,
        corners_px,
        cuboid,
        centroid,
        visibility,
        number if isinstance(number, int) and number > 0 else None,
    )


def intrinsics(
    values: Mapping[str, Any], path: Path, field: str, problems: Problems = STRICT
) -> CameraMatrix:
    """Return K of ``fx``, ``fy``, ``cx`` and ``cy``, pixels; NaN where one is missing."""
    listed = [values.get(name) for name in ("fx", "fy", "cx", "cy")]
    return camera_matrix(*numbers(problems, path, field, listed, 4))


def stated(record: Mapping[str, Any], name: str) -> object:
    """Return what an annotation states about itself (our writer's ``conventions``), else None."""
    return mapping(record.get("conventions")).get(name)


def has_own_ids(record: Mapping[str, Any]) -> bool:
    """Tell whether an annotation states that labels in ``.seg.png`` are objects', not classes'."""
    return stated(record, "segmentation") == "segmentation_id"
