"""Hold BOP's records of one image against each other, its models and its masks.

Scene files and tar shards share this: the records are parsed by
:mod:`~dopepp.data.formats.bop.records`, whose problems are defects; here is what only a look at
several of them, or at pixels, can tell.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from dopepp.data.formats import tolerances
from dopepp.data.formats.bop.models import (
    INFO_FILE,
    info_path,
    modelled,
    parse_models,
    part_of,
)
from dopepp.data.formats.bop.records import (
    INEXACT,
    MM,
    BopPoses,
    Places,
    Record,
    is_number,
    objects_without_model,
    read_cameras,
    read_poses,
)
from dopepp.data.formats.problems import CheckReport, Place, mapping
from dopepp.data.formats.tolerances import DIAMETERS_MM, Box
from dopepp.drawing.pictures import Mask, Shape
from dopepp.geometry.camera import CameraMatrix, transform
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


@dataclass
class Oddities:
    """What is no defect, because every reader copes with it, and worth a line: counts."""

    inexact: int = 0
    without_fraction: int = 0
    without_model: Counter[int] = field(default_factory=Counter)

    def count(self, poses: BopPoses, models: Models | None) -> None:
        """Count what an image's annotation has of it."""
        self.inexact += int(poses.inexact.sum())
        self.without_fraction += int(np.isnan(poses.visible_fractions).sum())
        self.without_model += objects_without_model(poses, models or ())

    def note(self, report: CheckReport, where: Path | str) -> None:
        """Say what there was, and how it is taken."""
        if self.inexact:
            report.note(
                f"{where}: {self.inexact:,} rotations are orthogonal to {INEXACT:g} only; the "
                "nearest rotation is taken"
            )
        if self.without_fraction:
            report.note(
                f"{where}: {self.without_fraction:,} objects without visib_fract; how much of them "
                "is visible is estimated"
            )
        for number, count in sorted(self.without_model.items()):
            report.note(
                f"{where}: object {number} is annotated {count:,} times and has no model; it is "
                "left out"
            )


ReadMask = Callable[[str, int], Mask | None]
"""Reads ``mask`` or ``mask_visib`` of an object by its number; None where there is none."""


def load_models(report: CheckReport, roots: Sequence[Path]) -> Models | None:
    """Check the first ``models*/models_info.json`` below one of the folders, and its meshes.

    Returns the sizes of the objects whose mesh is there, of all where none is; None without such a
    file.
    """
    path = next(filter(None, map(info_path, roots)), None)
    if path is None:
        report.note(f"no {INFO_FILE}: objects' numbers, sizes and boxes are not checked")
        return None
    place = Place(report, path)
    records = place.load()
    if records is None:
        return None
    infos = parse_models(path, records, report)
    there = modelled(infos)
    if absent := infos.keys() - there:
        numbers = ", ".join(map(str, sorted(absent)))
        report.note(f"{path.parent}: no file of object {numbers}, left out where it is annotated")
    for number in sorted(there):
        info = infos[number]
        Place(report, info.path)["mesh"].attempt(partial(part_of, info))
    sizes = {
        int(key): _model(place[key], record, infos[int(key)].diameter)
        for key, record in records.items()
        if is_number(key)
    }
    return {number: size for number, size in sizes.items() if number in there}


def _model(place: Place, record: object, stated: float) -> Model:
    fields, diameter = mapping(record), None if np.isnan(stated) else stated
    if fields and "diameter" not in fields:
        place["diameter"].report("missing")
    if diameter is not None and not DIAMETERS_MM[0] <= diameter * MM <= DIAMETERS_MM[1]:
        least, most = DIAMETERS_MM
        allowed = f"{least:g} … {most:g} mm: is it in another unit?"
        place["unit"].report(f"{diameter * MM:.4g} mm", allowed)
        diameter = None
    bounds = [fields.get(f"{what}_{axis}") for what in ("min", "size") for axis in "xyz"]
    if all(value is None for value in bounds):
        return Model(diameter)
    low, size = place["min_x … size_z"].numbers(bounds, 2, 3) / MM
    if (size < 0).any():
        place["size_x … size_z"].report(f"{(size * MM).tolist()}", "0 and above")
    if not (size >= 0).all():
        return Model(diameter)
    length = float(np.linalg.norm(size))
    if diameter is not None and not size.max() / _ROUNDING <= diameter <= length * _ROUNDING:
        got = f"{diameter * MM:.5g} mm for a box of {np.round(size * MM, 3).tolist()} mm"
        place["diameter"].report(got)
    return Model(diameter, cuboid_keypoints(low, low + size)[:8])


def check_image(
    places: Places,
    camera: object,
    truths: Sequence[Record],
    infos: Sequence[Record | None],
    shape: Shape | None,
    has_depth: bool,
    models: Models | None,
    read_mask: ReadMask,
) -> BopPoses:
    """Check camera, poses, boxes, counts and masks; return the poses.

    ``shape`` is the image's (height, width), None where it cannot be read; ``has_depth`` tells
    whether its depth must have a scale.
    """
    K = None if camera is None else _check_camera(places, camera, shape, has_depth)
    poses = read_poses(truths, infos, places)
    for n, info in enumerate(infos):
        place, T_cam_obj, stated = places("gt", n), poses.T_cam_obj[n], poses.visible_fractions[n]
        fraction = None if np.isnan(stated) else float(stated)
        model = (models or {}).get(int(poses.obj_ids[n]), Model())
        problem = tolerances.translation_problem(T_cam_obj[:3, 3], model.diameter)
        if problem is not None:
            place["cam_t_m2c"][problem[0]].report(problem[1])
        whole, visible = read_mask("mask", n), read_mask("mask_visib", n)
        if whole is not None and visible is not None and whole.shape == visible.shape:
            outside = int(np.count_nonzero(visible & ~whole))
            if outside > PIXEL_TOLERANCE * visible.sum():
                place["mask_visib"].report(f"{outside} visible pixels outside the whole mask")
        seen = None if visible is None else Box.of_mask(visible)
        if info is not None:
            _check_counts(places("gt_info", n), info, visible, fraction)
            seen = _check_boxes(places("gt_info", n), info, seen)
        is_posed = problem is None and bool(np.isfinite(T_cam_obj).all())
        if is_posed and K is not None and model.corners is not None:
            apart = tolerances.box_problem(transform(T_cam_obj, model.corners), K, seen, fraction)
            if apart is not None:
                place["box"].report(apart)
    return poses


def _check_camera(
    places: Places, camera: object, shape: Shape | None, has_depth: bool
) -> CameraMatrix | None:
    place = places("camera", 0)
    K: CameraMatrix = read_cameras([camera], places)[0][0]
    if has_depth and "depth_scale" not in mapping(camera):
        place["depth_scale"].report("missing", "millimetres a unit of the depth")
    if not np.isfinite(K).all():
        return None
    problem = None if shape is None else tolerances.camera_problem(K, shape)
    if problem is None:
        return K
    place["cam_K"].report(problem)
    return None


def _check_counts(
    place: Place, info: Mapping[str, Any], visible: Mask | None, fraction: float | None
) -> None:
    """Hold pixel counts against each other, the visible fraction and the mask."""
    total, count = (
        place[field].scalar(info[field]) if field in info else np.nan
        for field in ("px_count_all", "px_count_visib")
    )
    if count < 0 or count > total:
        place["px_count_visib"].report(f"{count:g} of {total:g} pixels")
    elif fraction is not None and total > 0:
        slack = FRACTION_TOLERANCE + 1 / np.sqrt(total)
        if abs(count / total - fraction) > slack:
            got = f"{fraction:.3g}, the pixel counts say {count / total:.3g}"
            place["visib_fract"].report(got)
    if visible is not None:
        pixels = int(np.count_nonzero(visible))
        if abs(pixels - count) > PIXEL_TOLERANCE * max(pixels, count) + np.sqrt(pixels):
            place["px_count_visib"].report(f"{count:g}, mask_visib has {pixels} pixels")


def _check_boxes(place: Place, info: Mapping[str, Any], seen: Box | None) -> Box | None:
    """Hold ``bbox_visib`` against the mask's box; return the latter, or else the former."""
    stated = {
        field: Box.of_bop(place[field].numbers(info[field], 4))
        for field in ("bbox_visib", "bbox_obj")
        if field in info
    }
    box = stated.get("bbox_visib")
    if seen is not None and box is not None and seen.distance(box) > BOX_EDGE_PX:
        place["bbox_visib"].report(f"{box}, mask_visib has {seen}")
    return seen or box
