"""BOP's annotations as checked arrays: camera, poses, visible fractions; millimetres to metres.

The same records stand in ``scene_*.json`` (by image) and in a shard's ``KEY.*.json``. What is wrong
with one goes to the :class:`~dopepp.data.formats.problems.Problems` and leaves NaN in the arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int

from dopepp.data.formats.problems import FARTHEST, STRICT, Problems, mapping, numbers
from dopepp.data.formats.tolerances import rotation_problem
from dopepp.data.sample import Instance, hull_areas
from dopepp.drawing.pictures import Mask, Shape
from dopepp.geometry.camera import CameraMatrix, Transform, project, project_keypoints, transform
from dopepp.parts.part import Part

MM: Final = 1000.0
"""Millimetres per metre."""

ESTIMATED: Final = (
    "estimated: mask pixels, or without a mask those inside the image, over the hull of the points"
)
"""How :func:`make_instance` gets a visible fraction that the annotation does not state."""

Record = Mapping[str, Any]

Place = Callable[[str, int], tuple[Path | str, str]]
"""From ``camera``, ``gt`` or ``gt_info`` and a record's number to (file, start of the field)."""


@dataclass(frozen=True)
class BopPoses:
    """The posed objects of one or more images.

    Attributes:
        obj_ids: BOP's object numbers; −1 where damaged.
        T_cam_obj: Rigid transforms, metres; with NaN where damaged.
        visible_fractions: As stated, NaN where they are not.
    """

    obj_ids: Int[np.ndarray, " objects"]
    T_cam_obj: Float[np.ndarray, "objects 4 4"]
    visible_fractions: Float[np.ndarray, " objects"]


def read_cameras(
    records: Sequence[object], place: Place, problems: Problems = STRICT
) -> tuple[Float[np.ndarray, "images 3 3"], Float[np.ndarray, " images"]]:
    """Return every image's K in pixels and its ``depth_scale`` (mm a unit; NaN where not stated).

    A record that is no camera, and a scale that is not above 0, is a problem.
    """
    K = _column(records, "cam_K", 9, place, "camera", problems).reshape(-1, 3, 3)
    stated = [n for n, record in enumerate(records) if "depth_scale" in mapping(record)]
    scales = np.full(len(records), math.nan)
    scales[stated] = _column(
        [records[n] for n in stated], "depth_scale", 1,
        lambda what, n: place(what, stated[n]), "camera", problems,
    )[:, 0]  # fmt: skip
    for number in np.flatnonzero(scales <= 0):
        path, start = place("camera", int(number))
        problems.report(path, f"{start}.depth_scale", f"{scales[number]:g}", "millimetres above 0")
    return K, scales


def pair_infos(
    truths: Sequence[Record], infos: Sequence[Record], path: Path | str, where: str,
    problems: Problems = STRICT,
) -> list[Record | None]:  # fmt: skip
    """Return one ``gt_info`` record for each of an image's objects, None where there is none."""
    if len(infos) != len(truths):
        allowed = f"{len(truths)}, as many as have a pose"
        problems.report(path, where, f"{len(infos)} objects", allowed)
    return [*infos[: len(truths)], *[None] * (len(truths) - len(infos))]


def read_poses(
    truths: Sequence[Record],
    infos: Sequence[Record | None],
    place: Place,
    problems: Problems = STRICT,
) -> BopPoses:
    """Return the objects of ``gt`` and ``gt_info`` records.

    A field that is missing or of another shape, a matrix that is no rotation, and a fraction that
    is not in [0, 1] is a problem.

    ``truths`` have ``cam_R_m2c`` (row by row), ``cam_t_m2c`` (mm) and ``obj_id``; ``infos``, one
    for each of them or None, have ``visib_fract``.
    """

    def report(number: int, field: str, got: str, allowed: str, what: str = "gt") -> None:
        path, start = place(what, number)
        problems.report(path, f"{start}.{field}", got, allowed)

    rotations = _column(truths, "cam_R_m2c", 9, place, "gt", problems).reshape(-1, 3, 3)
    poses = np.tile(np.eye(4), (len(truths), 1, 1))
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = _column(truths, "cam_t_m2c", 3, place, "gt", problems) / MM
    ids = _column(truths, "obj_id", 1, place, "gt", problems)[:, 0]
    for number in np.flatnonzero(~_are_rotations(rotations)).tolist():
        if problem := rotation_problem(rotations[number]):
            report(number, "cam_R_m2c", problem, "a rotation matrix, row by row")
        poses[number, :3, :3] = math.nan
    for number in np.flatnonzero((ids % 1 != 0) | (ids < 0)).tolist():
        if math.isfinite(ids[number]):
            report(number, "obj_id", f"{ids[number]:g}", "an object's number")
        ids[number] = -1
    stated = [n for n, info in enumerate(infos) if info is not None]
    fractions = np.full(len(truths), math.nan)
    fractions[stated] = _column(
        [infos[n] for n in stated], "visib_fract", 1,
        lambda what, n: place(what, stated[n]), "gt_info", problems,
    )[:, 0]  # fmt: skip
    for number in np.flatnonzero((fractions < 0) | (fractions > 1)).tolist():
        report(number, "visib_fract", f"{fractions[number]:g}", "0 – 1", "gt_info")
        fractions[number] = math.nan
    return BopPoses(ids.astype(np.int64), poses, fractions)


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
    area inside the image, over the area of the convex hull of the projected ADD points. For a
    concave object that comes out too small.
    """
    if math.isnan(visible_fraction):
        inside, whole = hull_areas(project(transform(T_cam_obj, part.points), K), shape)
        visible = inside if mask is None else float(np.count_nonzero(mask))
        visible_fraction = min(1.0, visible / whole) if whole > 0 else 0.0
    keypoints = project_keypoints(part.cuboid, T_cam_obj, K)
    return Instance(part.name, T_cam_obj, keypoints, visible_fraction, mask)


def _column(
    records: Sequence[object], field: str, count: int, place: Place, what: str, problems: Problems
) -> Float[np.ndarray, "records count"]:
    """Return a field of all records; one by one only to find those that are wrong."""
    # Nested lists of the right size, ``[[…], […], […]]`` for a matrix, are taken as other tools do.
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
    rows = []
    for number, record in enumerate(records):
        path, start = place(what, number)
        value = mapping(record).get(field)
        rows.append(numbers(problems, path, f"{start}.{field}", value, count))
    return np.array(rows)


def _are_rotations(matrices: Float[np.ndarray, "n 3 3"]) -> Bool[np.ndarray, " n"]:
    """Tell as :func:`~dopepp.geometry.rotation.is_rotation` does, of all at once."""
    with np.errstate(invalid="ignore"):  # of NaN
        error = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        return np.asarray((error <= 1e-3) & (np.linalg.det(matrices) > 0))
