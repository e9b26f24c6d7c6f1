"""BOP's annotations as checked arrays: camera, poses, visible fractions; millimetres to metres.

The same records stand in ``scene_*.json`` (by image) and in a shard's ``KEY.*.json``. A wrong
record goes to the :class:`~dopepp.data.formats.problems.Problems` and leaves NaN in the arrays.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int

from dopepp.data.formats.invariants import rotation_problem
from dopepp.data.formats.problems import FARTHEST, Place, mapping
from dopepp.data.sample import Instance, hull_areas
from dopepp.drawing.pictures import Mask, Shape
from dopepp.geometry.camera import CameraMatrix, Transform, project, project_keypoints, transform
from dopepp.geometry.rotation import nearest_rotation
from dopepp.parts.part import Part

MM: Final = 1000.0
"""Millimetres per metre."""

EXACT: Final = 1e-3
INEXACT: Final = 1e-2
"""Largest deviation of R·Rᵀ from the identity of a matrix that is kept, and of one that the nearest
rotation replaces. LM-O's published poses are off by up to 2e-3."""

ESTIMATED: Final = (
    "estimated: mask pixels, or without a mask those inside the image, over the hull of the points"
)
"""How :func:`make_instance` gets a visible fraction that the annotation does not state."""

_ROUNDING: Final = 1e-3
"""By which a visible fraction may leave [0, 1]."""

_NUMBERED: Final = re.compile(r"obj_(\d{1,9})")

Record = Mapping[str, Any]

Places = Callable[[str, int], Place]
"""Maps ``camera``, ``gt`` or ``gt_info`` and a record's number to the record's place."""


@dataclass(frozen=True)
class BopPoses:
    """The posed objects of one or more images.

    Attributes:
        obj_ids: BOP's object numbers; −1 where damaged.
        T_cam_obj: Rigid transforms, metres; with NaN where damaged.
        visible_fractions: As stated; NaN where not stated.
        inexact: Whether the stated matrix was replaced by the nearest rotation (``INEXACT``).
    """

    obj_ids: Int[np.ndarray, " objects"]
    T_cam_obj: Float[np.ndarray, "objects 4 4"]
    visible_fractions: Float[np.ndarray, " objects"]
    inexact: Bool[np.ndarray, " objects"]

    def of(self, chosen: Bool[np.ndarray, " objects"]) -> BopPoses:
        """Return some of the objects."""
        fields = (self.obj_ids, self.T_cam_obj, self.visible_fractions, self.inexact)
        return BopPoses(*(values[chosen] for values in fields))

    def without_model(self, modelled: Collection[int]) -> Counter[int]:
        """Count the objects without a model by number; ``modelled`` is empty without any model."""
        ids = self.obj_ids[self.obj_ids >= 0].tolist()
        return Counter(number for number in ids if modelled and number not in modelled)


def read_cameras(
    records: Sequence[object], places: Places
) -> tuple[Float[np.ndarray, "images 3 3"], Float[np.ndarray, " images"]]:
    """Return every image's K in pixels and its ``depth_scale`` (mm a unit; NaN if not stated)."""
    place = partial(places, "camera")
    K = _column(records, "cam_K", 9, place).reshape(-1, 3, 3)
    scales = _stated_column(records, "depth_scale", place)
    for number in np.flatnonzero(scales <= 0).tolist():
        place(number)["depth_scale"].report(f"{scales[number]:g}", "millimetres above 0")
    return K, scales


def pair_infos(truths: Sequence[Record], stated: object, place: Place) -> list[Record | None]:
    """Return one ``gt_info`` record for each of an image's objects, None where there is none.

    ``stated`` is the image's entry; null and an empty list state nothing.
    """
    if stated is None or stated == []:
        return [None] * len(truths)
    if isinstance(stated, list):
        stated = [{} if info is None else info for info in stated]
    infos = place.entries(stated)
    if len(infos) != len(truths):
        place.report(f"{len(infos)} objects", f"{len(truths)}, as many as have a pose")
    return [*infos[: len(truths)], *[None] * (len(truths) - len(infos))]


def read_poses(
    truths: Sequence[Record], infos: Sequence[Record | None], places: Places
) -> BopPoses:
    """Return the objects of ``gt`` and ``gt_info`` records.

    Args:
        truths: Records of ``cam_R_m2c`` (row by row), ``cam_t_m2c`` (mm) and ``obj_id``.
        infos: A record for each object or None; it may have ``visib_fract``.
        places: Places of the records, where each wrong field is reported.
    """
    place, info_place = partial(places, "gt"), partial(places, "gt_info")
    rotations = _column(truths, "cam_R_m2c", 9, place).reshape(-1, 3, 3)
    errors = _orthogonality(rotations)
    inexact = (errors > EXACT) & (errors <= INEXACT)
    rotations[inexact] = nearest_rotation(rotations[inexact])
    poses = np.tile(np.eye(4), (len(truths), 1, 1))
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = _column(truths, "cam_t_m2c", 3, place) / MM
    ids = _column(truths, "obj_id", 1, place)[:, 0]
    for number in np.flatnonzero(~(errors <= INEXACT)).tolist():
        if problem := rotation_problem(rotations[number], INEXACT):
            place(number)["cam_R_m2c"].report(problem, "a rotation matrix, row by row")
        poses[number, :3, :3] = math.nan
    for number in np.flatnonzero((ids % 1 != 0) | (ids < 0)).tolist():
        if math.isfinite(ids[number]):
            place(number)["obj_id"].report(f"{ids[number]:g}", "an object's number")
        ids[number] = -1
    fractions = _stated_column(infos, "visib_fract", info_place)
    for number in np.flatnonzero((fractions < -_ROUNDING) | (fractions > 1 + _ROUNDING)).tolist():
        info_place(number)["visib_fract"].report(f"{fractions[number]:.6g}", "0 – 1")
        fractions[number] = math.nan
    return BopPoses(ids.astype(np.int64), poses, np.clip(fractions, 0.0, 1.0), inexact)


def make_instance(
    part: Part,
    T_cam_obj: Transform,
    K: CameraMatrix,
    visible_fraction: float,
    mask: Mask | None,
    shape: Shape,
) -> Instance:
    """Return an annotated object as an instance.

    A fraction that is not stated (NaN) is estimated: mask pixels or, without a mask, the hull's
    area inside the image, over the area of the convex hull of the projected ADD points. The
    estimate is too small for a concave object.
    """
    if math.isnan(visible_fraction):
        inside, whole = hull_areas(project(transform(T_cam_obj, part.points), K), shape)
        visible = inside if mask is None else float(np.count_nonzero(mask))
        visible_fraction = min(1.0, visible / whole) if whole > 0 else 0.0
    keypoints = project_keypoints(part.cuboid, T_cam_obj, K)
    return Instance(part.name, T_cam_obj, keypoints, visible_fraction, mask)


def _stated_column(
    records: Sequence[object], field: str, place: Callable[[int], Place]
) -> Float[np.ndarray, " records"]:
    """Return a number of the records that state it, NaN for the others."""
    stated = [n for n, record in enumerate(records) if field in mapping(record)]
    values = np.full(len(records), math.nan)
    rows = [records[n] for n in stated]
    values[stated] = _column(rows, field, 1, lambda n: place(stated[n]))[:, 0]
    return values


def _column(
    records: Sequence[object], field: str, count: int, place: Callable[[int], Place]
) -> Float[np.ndarray, "records count"]:
    """Return a field of all records at once; record by record only to report the wrong ones.

    Nested lists of the right size, ``[[…], […], […]]`` for a matrix, are accepted as by other
    tools.
    """
    if not records:
        return np.empty((0, count))
    try:
        values = np.array([record[field] for record in records])  # type: ignore[index]
        table = values.reshape(len(records), -1)
    except (IndexError, KeyError, TypeError, ValueError):
        table = np.empty((0, 0), object)
    if table.shape == (len(records), count) and table.dtype.kind in "iuf":
        table = table.astype(np.float64)
        if (np.abs(table) <= FARTHEST).all():
            return table
    rows = [mapping(record).get(field) for record in records]
    return np.array([place(n)[field].numbers(value, count) for n, value in enumerate(rows)])


def _orthogonality(matrices: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    """Return the deviation of R·Rᵀ from the identity; infinite for a mirror image, NaN for NaN."""
    with np.errstate(invalid="ignore", over="ignore"):
        error = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        return np.where(np.linalg.det(matrices) < 0, np.inf, error)


def number_in_name(name: str) -> int | None:
    """Return the number in a name like BOP's ``obj_000005``; None for any other name."""
    numbered = _NUMBERED.fullmatch(name)
    return int(numbered[1]) if numbered else None


def model_numbers(names: Sequence[str]) -> dict[str, int]:
    """Return the number of each object by name: 1, 2, … unless all are named like BOP's files.

    So renders of another data set's models keep that data set's numbers.
    """
    stated = {name: number_in_name(name) for name in names}
    numbers = {name: number for name, number in stated.items() if number}
    if len(set(numbers.values())) == len(names):
        return numbers
    return {name: number for number, name in enumerate(names, start=1)}


def is_number(text: str) -> bool:
    """Tell whether a key or a name is the number of an image, an object or a scene."""
    return text.isascii() and text.isdecimal() and len(text) < 10
