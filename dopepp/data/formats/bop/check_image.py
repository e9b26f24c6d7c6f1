"""Hold BOP's records of one image against each other, its models and its masks.

Scene files and tar shards share this: the records are parsed by
:mod:`~dopepp.data.formats.bop.records`, whose problems are defects; here is what only a look at
several of them, or at pixels, can tell.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from dopepp.data.formats.bop.models import INFO_FILE, info_path, parse_models
from dopepp.data.formats.bop.records import MM, Place, Record, read_cameras, read_poses
from dopepp.data.formats.bop.scene import is_number
from dopepp.data.formats.problems import CheckReport, load_object, mapping, numbers, scalar
from dopepp.data.formats.tolerances import (
    DIAMETERS_MM,
    Box,
    box_problem,
    camera_problem,
    translation_problem,
)
from dopepp.drawing.pictures import Mask, Shape
from dopepp.geometry.camera import CameraMatrix, Transform, transform
from dopepp.geometry.cuboid import cuboid_keypoints

FRACTION_TOLERANCE: Final = 0.05
"""Between ``visib_fract`` and the quotient of the pixel counts, which renderers round apart."""

PIXEL_TOLERANCE: Final = 0.01
"""Share of a mask's pixels by which a stated count may differ (plus one row, of a border)."""

BOX_EDGE_PX: Final = 2.0
"""Between ``bbox_visib`` and the box of ``mask_visib``: tools differ on whether ends count."""

_ROUNDING: Final = 1.001
"""Diameters and boxes are rounded to a few digits."""


@dataclass(frozen=True)
class Model:
    """An object's size, metres; None where it is not stated or damaged."""

    diameter: float | None = None
    corners: Float[np.ndarray, "8 3"] | None = None


Models = dict[int, Model]


@dataclass(frozen=True)
class Silhouettes:
    """An image's masks by an object's number: whole and visible; None where there are none."""

    whole: Callable[[int], Mask | None]
    visible: Callable[[int], Mask | None]


def load_models(report: CheckReport, roots: Sequence[Path]) -> Models | None:
    """Check the first ``models*/models_info.json`` below one of the folders; None without one."""
    path = next(filter(None, map(info_path, roots)), None)
    if path is None:
        report.note(f"no {INFO_FILE}: objects' numbers, sizes and boxes are not checked")
        return None
    records = load_object(report, path)
    if records is None:
        return None
    infos = parse_models(path, records, report)
    for info in infos.values():
        if not info.path.is_file():
            report.report(info.path, "file", "missing")
    return {
        int(key): _model(report, path, key, record, infos[int(key)].diameter)
        for key, record in records.items()
        if is_number(key)
    }


def _model(report: CheckReport, path: Path, key: str, record: Any, stated: float) -> Model:
    fields, diameter = mapping(record), None if np.isnan(stated) else stated
    if fields and "diameter" not in fields:
        report.report(path, f"{key}.diameter", "missing")
    if diameter is not None and not DIAMETERS_MM[0] <= diameter * MM <= DIAMETERS_MM[1]:
        least, most = DIAMETERS_MM
        allowed = f"{least:g} … {most:g} mm: is it in another unit?"
        report.report(path, f"{key}.unit", f"{diameter * MM:.4g} mm", allowed)
        diameter = None
    bounds = [fields.get(f"{what}_{axis}") for what in ("min", "size") for axis in "xyz"]
    if all(value is None for value in bounds):
        return Model(diameter)
    low, size = numbers(report, path, f"{key}.min_x … size_z", bounds, 2, 3) / MM
    if (size < 0).any():
        report.report(path, f"{key}.size_x … size_z", f"{(size * MM).tolist()}", "0 and above")
    if not (size >= 0).all():
        return Model(diameter)
    length = float(np.linalg.norm(size))
    if diameter is not None and not size.max() / _ROUNDING <= diameter <= length * _ROUNDING:
        got = f"{diameter * MM:.5g} mm for a box of {np.round(size * MM, 3).tolist()} mm"
        report.report(path, f"{key}.diameter", got)
    return Model(diameter, cuboid_keypoints(low, low + size)[:8])


def check_image(
    report: CheckReport,
    place: Place,
    camera: object,
    truths: Sequence[Record],
    infos: Sequence[Record | None],
    shape: Shape | None,
    has_depth: bool,
    models: Models | None,
    silhouettes: Silhouettes,
) -> None:
    """Check camera, poses, boxes, counts and masks.

    ``shape`` is the image's (height, width), None where it cannot be read; ``has_depth`` tells
    whether its depth must have a scale.
    """
    K = None if camera is None else _check_camera(report, place, camera, shape, has_depth)
    poses = read_poses(truths, infos, place, report)
    for n, info in enumerate(infos):
        model = _find_model(report, place("gt", n), int(poses.obj_ids[n]), models)
        item = _Object(report, place, n, model)
        pose, fraction = poses.T_cam_obj[n], float(poses.visible_fractions[n])
        item.check(pose, None if np.isnan(fraction) else fraction, info, K, silhouettes)


def _check_camera(
    report: CheckReport, place: Place, camera: object, shape: Shape | None, has_depth: bool
) -> CameraMatrix | None:
    path, start = place("camera", 0)
    K: CameraMatrix = read_cameras([camera], place, report)[0][0]
    if has_depth and "depth_scale" not in mapping(camera):
        report.report(path, f"{start}.depth_scale", "missing", "millimetres a unit of the depth")
    if not np.isfinite(K).all():
        return None
    problem = None if shape is None else camera_problem(K, shape)
    if problem is None:
        return K
    report.report(path, f"{start}.cam_K", problem)
    return None


def _find_model(
    report: CheckReport, place: tuple[Path | str, str], obj_id: int, models: Models | None
) -> Model:
    if models is None or obj_id < 0:  # which the reader has reported
        return Model()
    if obj_id in models:
        return models[obj_id]
    listed = sorted(models)
    few = ", ".join(map(str, listed[:10])) + (", …" if len(listed) > 10 else "")
    got = f"unknown object {obj_id}; {INFO_FILE} has {few}"
    report.report(place[0], f"{place[1]}.obj_id", got)
    return Model()


class _Object:
    """One object of an image, and where its records stand."""

    def __init__(self, report: CheckReport, place: Place, n: int, model: Model) -> None:
        self._report, self._number, self._model = report, n, model
        self._path, self._start = place("gt", n)
        self._info_path, self._info_start = place("gt_info", n)

    def _add(self, field: str, got: str) -> None:
        self._report.report(self._path, f"{self._start}.{field}", got)

    def _add_info(self, field: str, got: str) -> None:
        self._report.report(self._info_path, f"{self._info_start}.{field}", got)

    def check(
        self,
        T_cam_obj: Transform,
        fraction: float | None,
        info: Record | None,
        K: CameraMatrix | None,
        silhouettes: Silhouettes,
    ) -> None:
        place = translation_problem(T_cam_obj[:3, 3], self._model.diameter)
        if place is not None:
            self._add(f"cam_t_m2c.{place[0]}", place[1])
        whole, visible = silhouettes.whole(self._number), silhouettes.visible(self._number)
        if whole is not None and visible is not None and whole.shape == visible.shape:
            outside = int(np.count_nonzero(visible & ~whole))
            if outside > PIXEL_TOLERANCE * visible.sum():
                self._add("mask_visib", f"{outside} visible pixels outside the whole mask")
        seen = None if visible is None else Box.of_mask(visible)
        if info is not None:
            self._check_counts(info, visible, fraction)
            seen = self._check_boxes(info, seen)
        is_posed = place is None and bool(np.isfinite(T_cam_obj).all())
        if is_posed and K is not None and self._model.corners is not None:
            points = transform(T_cam_obj, self._model.corners)
            problem = box_problem(points, K, seen, fraction)
            if problem is not None:
                self._add("box", problem)

    def _check_counts(
        self, info: Mapping[str, Any], visible: Mask | None, fraction: float | None
    ) -> None:
        """Hold pixel counts against each other, the visible fraction and the mask."""
        total, count = (
            scalar(self._report, self._info_path, f"{self._info_start}.{field}", info[field])
            if field in info
            else np.nan
            for field in ("px_count_all", "px_count_visib")
        )
        if count < 0 or count > total:
            self._add_info("px_count_visib", f"{count:g} of {total:g} pixels")
        elif fraction is not None and total > 0:
            slack = FRACTION_TOLERANCE + 1 / np.sqrt(total)
            if abs(count / total - fraction) > slack:
                got = f"{fraction:.3g}, the pixel counts say {count / total:.3g}"
                self._add_info("visib_fract", got)
        if visible is not None:
            pixels = int(np.count_nonzero(visible))
            if abs(pixels - count) > PIXEL_TOLERANCE * max(pixels, count) + np.sqrt(pixels):
                self._add_info("px_count_visib", f"{count:g}, mask_visib has {pixels} pixels")

    def _check_boxes(self, info: Mapping[str, Any], seen: Box | None) -> Box | None:
        """Hold ``bbox_visib`` against the mask's box; return the latter, or else the former."""
        stated: dict[str, Box | None] = {}
        for field in ("bbox_visib", "bbox_obj"):
            if field in info:
                where = f"{self._info_start}.{field}"
                values = numbers(self._report, self._info_path, where, info[field], 4)
                stated[field] = Box.of_bop(values)
        box = stated.get("bbox_visib")
        if seen is not None and box is not None and seen.distance(box) > BOX_EDGE_PX:
            self._add_info("bbox_visib", f"{box}, mask_visib has {seen}")
        return seen or box
