"""BOP's annotations as checked arrays: camera, poses, visible fractions; millimetres to metres.

The same records stand in ``scene_*.json`` (by image) and in a shard's ``KEY.*.json``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int

from dopepp.core.errors import UserError
from dopepp.data.sample import Instance, hull_areas
from dopepp.geometry.camera import project, project_keypoints, transform
from dopepp.parts.part import Part

MM: Final = 1000.0
"""Millimetres per metre."""

ESTIMATED: Final = (
    "estimated: mask pixels, or without a mask those inside the image, over the hull of the points"
)
"""How :func:`make_instance` gets a visible fraction that the annotation does not state."""

_FARTHEST: Final = 1e6
"""Metres; squares of such distances stay finite."""

_ROTATION_TOLERANCE: Final = 1e-3

Place = Callable[[int], str]
"""Says where the record of a number stands: file and image, for the error."""


@dataclass(frozen=True)
class BopPoses:
    """The posed objects of one or more images.

    Attributes:
        obj_ids: BOP's object numbers.
        T_cam_obj: Rigid transforms, metres.
        visible_fractions: As stated, NaN where they are not.
    """

    obj_ids: Int[np.ndarray, " objects"]
    T_cam_obj: Float[np.ndarray, "objects 4 4"]
    visible_fractions: Float[np.ndarray, " objects"]


def read_cameras(
    records: Sequence[object], place: Place
) -> tuple[Float[np.ndarray, "images 3 3"], Float[np.ndarray, " images"]]:
    """Return every image's K in pixels and its ``depth_scale`` (mm a unit; NaN where not stated).

    Raises:
        UserError: A record is no camera, or a scale is not above 0.
    """
    K = _column(records, "cam_K", 9, place).reshape(-1, 3, 3)
    stated = [i for i, r in enumerate(records) if isinstance(r, dict) and "depth_scale" in r]
    scales = np.full(len(records), math.nan)
    scales[stated] = _column(
        [records[i] for i in stated], "depth_scale", 1, lambda i: place(stated[i])
    )[:, 0]
    for number in np.flatnonzero(scales <= 0):
        raise _bad(f"{place(int(number))}: depth_scale {scales[number]}", "millimetres above 0")
    return K, scales


def read_poses(truths: Sequence[object], infos: Sequence[object] | None, place: Place) -> BopPoses:
    """Return the objects of ``gt`` and ``gt_info`` records.

    Args:
        truths: Records with ``cam_R_m2c`` (row by row), ``cam_t_m2c`` (mm) and ``obj_id``.
        infos: As many records with ``visib_fract``; None where there are none.
        place: Says where the record of a number stands.

    Raises:
        UserError: A field is missing or has another type or shape, a rotation is none, or a
            fraction is not in [0, 1].
    """
    rotations = _column(truths, "cam_R_m2c", 9, place).reshape(-1, 3, 3)
    translations = _column(truths, "cam_t_m2c", 3, place) / MM
    ids = _column(truths, "obj_id", 1, place)[:, 0]
    for number in np.flatnonzero(~_are_rotations(rotations)):
        raise _bad(f"{place(int(number))}: cam_R_m2c", "a rotation matrix, row by row")
    for number in np.flatnonzero((np.abs(translations) > _FARTHEST).any(axis=1)):
        raise _bad(f"{place(int(number))}: cam_t_m2c {translations[number]} m", "millimetres")
    for number in np.flatnonzero((ids != np.rint(ids)) | (ids < 0) | (ids > 1e9)):
        raise _bad(f"{place(int(number))}: obj_id {ids[number]}", "an object's number")
    poses = np.tile(np.eye(4), (len(truths), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, translations
    fractions = np.full(len(truths), math.nan)
    if infos is not None:
        fractions = _column(infos, "visib_fract", 1, place)[:, 0]
        for number in np.flatnonzero((fractions < 0) | (fractions > 1)):
            raise _bad(f"{place(int(number))}: visib_fract {fractions[number]}", "0 – 1")
    return BopPoses(ids.astype(np.int64), poses, fractions)


def make_instance(
    part: Part,
    T_cam_obj: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
    visible_fraction: float,
    mask: Bool[np.ndarray, "height width"] | None,
    shape: tuple[int, int],
) -> Instance:
    """Return an annotated object as an instance.

    A fraction that is not stated (NaN) is estimated: mask pixels or, without a mask, the hull's
    area inside the image, over the area of the convex hull of the projected ADD points. For a
    concave object that comes out too small.

    Args:
        part: The object.
        T_cam_obj: Its pose, metres.
        K: Camera matrix, pixels.
        visible_fraction: As stated, or NaN.
        mask: Its visible pixels, or None.
        shape: (height, width) of the image.
    """
    if math.isnan(visible_fraction):
        inside, whole = hull_areas(project(transform(T_cam_obj, part.points), K), shape)
        visible = inside if mask is None else float(np.count_nonzero(mask))
        visible_fraction = min(1.0, visible / whole) if whole > 0 else 0.0
    keypoints = project_keypoints(part.cuboid, T_cam_obj, K)
    return Instance(part.name, T_cam_obj, keypoints, visible_fraction, mask)


def numbers(value: object, count: int, where: str) -> Float[np.ndarray, " count"]:
    """Return a list of ``count`` plain numbers as an array.

    Raises:
        UserError: It is anything else.
    """
    array = np.array([_float(number) for number in value] if isinstance(value, list) else [])
    if array.shape != (count,) or not np.isfinite(array).all():
        raise _bad(f"{where}: {value!r:.60}", f"{count} finite numbers")
    return array


def _float(number: Any) -> float:
    try:
        return float(number) if type(number) in (int, float) else math.nan
    except OverflowError:  # an integer above 1e308
        return math.nan


def _column(
    records: Sequence[object], field: str, count: int, place: Place
) -> Float[np.ndarray, "records count"]:
    """Return a field of all records; one by one only to find the one that is wrong.

    Nested lists of the right size, ``[[…], […], […]]`` for a matrix, are taken as other tools do.
    """
    if not records:
        return np.empty((0, count))
    try:
        values = np.array([record[field] for record in records])  # type: ignore[index]
        table = values.reshape(len(records), -1)
    except (IndexError, KeyError, TypeError, ValueError):
        table = np.empty((0, 0), object)
    if table.shape == (len(records), count) and table.dtype.kind in "iuf":
        return table.astype(np.float64)
    rows = []
    for number, record in enumerate(records):
        value = record.get(field) if isinstance(record, dict) else None
        value = [value] if count == 1 else value
        rows.append(numbers(value, count, f"{place(number)}: {field}"))
    return np.array(rows)


def _are_rotations(matrices: Float[np.ndarray, "n 3 3"]) -> Bool[np.ndarray, " n"]:
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        return np.asarray((error <= _ROTATION_TOLERANCE) & (np.linalg.det(matrices) > 0))


def _bad(got: str, allowed: str) -> UserError:
    return UserError(got, allowed, "correct the annotation or download it again")
