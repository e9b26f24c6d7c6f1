"""The fields of an NDDS annotation, read strictly: what is there has its shape and its range."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from dopepp.core.errors import UserError
from dopepp.core.json import read_json
from dopepp.geometry.camera import camera_matrix

MAX_ITEM_BYTES: Final = 16_000_000
"""Of one image's annotation; a hundred objects take 0.5 MB."""

FARTHEST: Final = 1e9
"""No coordinate is larger in any unit, and squares of such numbers stay exact enough."""


@dataclass(frozen=True)
class NddsObject:
    """One object as an annotation states it, units and orders still unknown.

    Attributes:
        field: Where it stands, e.g. ``objects[2]``.
        label: Its ``class``.
        location: Three numbers.
        quaternion: The four numbers under ``quaternion_xyzw``, in whatever order.
        corners_px: ``projected_cuboid`` without its centroid; None where it is not given.
        centroid: ``cuboid_centroid`` or, without one, the mean of ``cuboid``; None without both.
        visibility: As given; None where it is not.
        segmentation_id: Value of its pixels in ``STEM.seg.png``; None where it is not given.
    """

    field: str
    label: str
    location: Float[np.ndarray, "3"]
    quaternion: Float[np.ndarray, "4"]
    corners_px: Float[np.ndarray, "8 2"] | None
    centroid: Float[np.ndarray, "3"] | None
    visibility: float | None
    segmentation_id: int | None


def read_record(path: Path) -> Mapping[str, Any]:
    """Read a JSON file whose top level is an object.

    Raises:
        UserError: As :func:`~dopepp.core.json.read_json`, or it is something else.
    """
    record = read_json(path, MAX_ITEM_BYTES)
    if not isinstance(record, dict):
        raise bad(path, "top level", type(record).__name__, "a JSON object { }")
    return record


def objects_of(record: Mapping[str, Any], path: Path) -> list[tuple[str, Mapping[str, Any], str]]:
    """Return (field, object, class) of every object of an annotation.

    Raises:
        UserError: ``objects`` is missing or no list, or an object has no class.
    """
    objects = record.get("objects")
    if not isinstance(objects, list):
        raise bad(path, "objects", type(objects).__name__, "a list of objects")
    found: list[tuple[str, Mapping[str, Any], str]] = []
    for number, item in enumerate(objects):
        field = f"objects[{number}]"
        if not isinstance(item, dict) or not isinstance(item.get("class"), str):
            raise bad(path, f"{field}.class", repr(item)[:80], "an object with a class name")
        found.append((field, item, item["class"]))
    return found


def parse_object(item: Mapping[str, Any], field: str, path: Path) -> NddsObject:
    """Read the fields of one object.

    Raises:
        UserError: Location or quaternion are missing, or a field has the wrong shape.
    """

    def numbers(name: str, *shape: int) -> NDArray[np.float64] | None:
        value = item.get(name)
        return None if value is None else array(value, shape, path, f"{field}.{name}")

    location, quaternion = numbers("location", 3), numbers("quaternion_xyzw", 4)
    if location is None or quaternion is None:
        missing = "location" if location is None else "quaternion_xyzw"
        raise bad(path, f"{field}.{missing}", "nothing", "the object's pose")
    if not 0.9 < np.linalg.norm(quaternion) < 1.1:
        got = quaternion.tolist()
        raise bad(path, f"{field}.quaternion_xyzw", repr(got), "a quaternion of norm 1")
    centroid, cuboid = numbers("cuboid_centroid", 3), numbers("cuboid", -1, 3)
    if centroid is None and cuboid is not None and len(cuboid) in (8, 9):
        centroid = cuboid[:8].mean(axis=0)
    visibility, segmentation = item.get("visibility"), item.get("segmentation_id")
    return NddsObject(
        field,
        item["class"],
        location,
        quaternion,
        _corners(numbers("projected_cuboid", -1, 2), path, field),
        centroid,
        None if visibility is None else _number(visibility, path, f"{field}.visibility"),
        segmentation if isinstance(segmentation, int) and segmentation > 0 else None,
    )


def _corners(
    points: NDArray[np.float64] | None, path: Path, field: str
) -> NDArray[np.float64] | None:
    """Drop the centroid that some writers append as the ninth point."""
    if points is None or not len(points):
        return None
    if len(points) not in (8, 9):
        raise bad(path, f"{field}.projected_cuboid", f"{len(points)} points", "8 or 9 points")
    return points[:8]


def array(value: object, shape: tuple[int, ...], path: Path, field: str) -> NDArray[np.float64]:
    """Return nested lists of numbers as an array; −1 in ``shape`` stands for any length.

    Raises:
        UserError: It is something else, or a number is beyond all reason.
    """
    try:
        numbers = np.array(value)
    except ValueError:
        numbers = np.empty(0, object)
    fits = numbers.ndim == len(shape) and all(
        wanted in (-1, length) for wanted, length in zip(shape, numbers.shape, strict=True)
    )
    # A file's [] has one axis only, whatever it would have held.
    empty = numbers.size == 0 and numbers.dtype.kind == "f" and shape[0] == -1
    if empty:
        return np.empty((0, *shape[1:]))
    if not fits or numbers.dtype.kind not in "iuf" or np.abs(numbers).max() > FARTHEST:
        text = "×".join("N" if length < 0 else str(length) for length in shape)
        raise bad(path, field, f"{value!r:.80}", f"{text} numbers up to {FARTHEST:.0e}")
    return numbers.astype(np.float64)


def _number(value: object, path: Path, field: str) -> float:
    return float(array([value], (1,), path, field)[0])


def intrinsics(values: Mapping[str, Any], path: Path, field: str) -> Float[np.ndarray, "3 3"]:
    """Return K of ``fx``, ``fy``, ``cx`` and ``cy``, pixels.

    Raises:
        UserError: One is missing or no number.
    """
    listed = [values.get(name) for name in ("fx", "fy", "cx", "cy")]
    return camera_matrix(*array(listed, (4,), path, field))


def stated(record: Mapping[str, Any], name: str) -> object:
    """Return what an annotation states about itself (our writer's ``conventions``), else None."""
    conventions = record.get("conventions")
    return conventions.get(name) if isinstance(conventions, dict) else None


def bad(path: Path, field: str, got: str, allowed: str) -> UserError:
    """Return the error of one field of a file."""
    fix = "correct the file, or run `dopepp check` on the folder"
    return UserError(f"{path}: {field}: {got}", allowed, fix)
