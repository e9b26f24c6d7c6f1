"""Check BOP's records of one image, which are the same in scene files and in tar shards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool
from numpy.typing import NDArray

from dopepp.data.formats.bop.check_models import Model, Models
from dopepp.data.formats.problems import CheckReport, entries, mapping, numbers
from dopepp.data.formats.tolerances import (
    Box,
    box_problem,
    camera_problem,
    rotation_problem,
    translation_problem,
)

FRACTION_TOLERANCE: Final = 0.05
"""Between ``visib_fract`` and the quotient of the pixel counts, which renderers round apart."""

PIXEL_TOLERANCE: Final = 0.01
"""Share of a mask's pixels by which a stated count may differ (plus one row, of a border)."""

BOX_EDGE_PX: Final = 2.0
"""Between ``bbox_visib`` and the box of ``mask_visib``: tools differ on whether ends count."""

Place = Callable[[str], tuple[Path | str, str]]
"""From ``camera``, ``gt`` or ``gt_info`` to (file, start of the field)."""

Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class ImageRecords:
    """The JSON records of an image, as they are; None where there are none."""

    camera: Any
    truths: Any
    infos: Any
    has_depth: bool


@dataclass(frozen=True)
class Silhouettes:
    """An image's masks by an object's number: whole and visible; None where there are none."""

    whole: Callable[[int], Mask | None]
    visible: Callable[[int], Mask | None]


def check_image_records(
    report: CheckReport,
    place: Place,
    records: ImageRecords,
    size: tuple[int, int] | None,
    models: Models | None,
    silhouettes: Silhouettes,
) -> None:
    """Check camera, poses, boxes, counts and masks.

    Args:
        report: Takes the defects.
        place: Says where a record stands.
        records: The records.
        size: (width, height) of the image; None where it cannot be read.
        models: The objects; None where they are not known.
        silhouettes: The masks.
    """
    K = None if records.camera is None else _check_camera(report, place, records, size)
    if records.truths is None:
        return
    truths = entries(report, place("gt")[0], place("gt")[1], records.truths)
    infos: list[Any] = []
    if records.infos is not None:
        path, start = place("gt_info")
        infos = entries(report, path, start, records.infos)
        if len(infos) != len(truths):
            report.add(path, start, f"{len(infos)} objects; {len(truths)} have a pose")
    for number, truth in enumerate(truths):
        item = _Object(report, place, number, truth, models)
        info = infos[number] if number < len(infos) else None
        item.check(info, K, silhouettes)


def _check_camera(
    report: CheckReport, place: Place, records: ImageRecords, size: tuple[int, int] | None
) -> NDArray[np.float64] | None:
    path, start = place("camera")
    camera = mapping(records.camera)
    K = numbers(report, path, f"{start}.cam_K", camera.get("cam_K"), 3, 3)
    if K is not None and size is not None:
        problem = camera_problem(K, size)
        if problem is not None:
            report.add(path, f"{start}.cam_K", problem)
            K = None
    if "depth_scale" in camera or records.has_depth:
        where = f"{start}.depth_scale"
        scale = numbers(report, path, where, camera.get("depth_scale"), 1)
        if scale is not None and scale[0] <= 0:
            report.add(path, where, f"{scale[0]:g}; allowed: above 0")
    return K


class _Object:
    """One object of an image."""

    def __init__(
        self, report: CheckReport, place: Place, number: int, truth: Any, models: Models | None
    ) -> None:
        self._report, self._number, self._truth = report, number, mapping(truth)
        self._path, start = place("gt")
        self._start = f"{start}[{number}]"
        self._info_path, start = place("gt_info")
        self._info_start = f"{start}[{number}]"
        self._model = self._find_model(models)

    def _add(self, field: str, message: str) -> None:
        self._report.add(self._path, f"{self._start}.{field}", message)

    def _add_info(self, field: str, message: str) -> None:
        self._report.add(self._info_path, f"{self._info_start}.{field}", message)

    def _find_model(self, models: Models | None) -> Model:
        number = self._truth.get("obj_id")
        if type(number) is not int or number < 0:
            self._add("obj_id", f"{number!r:.40}; allowed: an object's number")
        elif models is not None and number not in models:
            self._add("obj_id", f"unknown object {number}; models_info.json has {_few(models)}")
        elif models is not None:
            return models[number]
        return Model(None, None)

    def check(
        self,
        info: Any,
        K: NDArray[np.float64] | None,
        silhouettes: Silhouettes,
    ) -> None:
        T = self._pose()
        whole, visible = silhouettes.whole(self._number), silhouettes.visible(self._number)
        if whole is not None and visible is not None and whole.shape == visible.shape:
            outside = int(np.count_nonzero(visible & ~whole))
            if outside > PIXEL_TOLERANCE * visible.sum():
                self._add("mask_visib", f"{outside} visible pixels outside the whole mask")
        fraction, seen = None, None if visible is None else Box.of_mask(visible)
        if info is not None:
            fraction, seen = self._info(info, visible, seen)
        if T is None or K is None or self._model.corners is None:
            return
        points = self._model.corners @ T[:, :3].T + T[:, 3]
        problem = box_problem(points, K, seen, fraction)
        if problem is not None:
            self._add("box", problem)

    def _pose(self) -> NDArray[np.float64] | None:
        """Return [R t], None where the object has no usable pose."""
        read = self._report, self._path
        R = numbers(*read, f"{self._start}.cam_R_m2c", self._truth.get("cam_R_m2c"), 3, 3)
        t = numbers(*read, f"{self._start}.cam_t_m2c", self._truth.get("cam_t_m2c"), 3)
        problem = None if R is None else rotation_problem(R)
        if problem is not None:
            self._add("cam_R_m2c", problem)
        place = None if t is None else translation_problem(t, self._model.diameter)
        if place is not None:
            self._add(f"cam_t_m2c.{place[0]}", place[1])
        if R is None or t is None or problem or place:
            return None
        return np.column_stack([R, t])

    def _info(
        self, info: Any, visible: Mask | None, seen: Box | None
    ) -> tuple[float | None, Box | None]:
        """Check ``scene_gt_info``'s record; return the visible fraction and the visible box."""
        info = mapping(info)
        fraction = self._number_of(info, "visib_fract")
        if fraction is not None and not 0 <= fraction <= 1:
            self._add_info("visib_fract", f"{fraction:g}; allowed: 0 … 1")
            fraction = None
        total, count = (self._number_of(info, f"px_count_{what}") for what in ("all", "visib"))
        if total is not None and count is not None:
            if not 0 <= count <= total:
                self._add_info("px_count_visib", f"{count:g} of {total:g} pixels")
            elif fraction is not None and total > 0:
                quotient = count / total
                slack = FRACTION_TOLERANCE + 1 / np.sqrt(total)
                if abs(quotient - fraction) > slack:
                    message = f"{fraction:.3g}, the pixel counts say {quotient:.3g}"
                    self._add_info("visib_fract", message)
        if visible is not None and count is not None:
            pixels = int(np.count_nonzero(visible))
            if abs(pixels - count) > PIXEL_TOLERANCE * max(pixels, count) + np.sqrt(pixels):
                self._add_info("px_count_visib", f"{count:g}, mask_visib has {pixels} pixels")
        stated = self._box_of(info, "bbox_visib")
        self._box_of(info, "bbox_obj")
        if seen is not None and stated is not None and seen.distance(stated) > BOX_EDGE_PX:
            self._add_info("bbox_visib", f"{stated}, mask_visib has {seen}")
        return fraction, seen or stated

    def _number_of(self, info: Any, field: str) -> float | None:
        if field not in info:
            return None
        where = f"{self._info_start}.{field}"
        value = numbers(self._report, self._info_path, where, info[field], 1)
        return None if value is None else float(value[0])

    def _box_of(self, info: Any, field: str) -> Box | None:
        if field not in info:
            return None
        where = f"{self._info_start}.{field}"
        value = numbers(self._report, self._info_path, where, info[field], 4)
        return None if value is None else Box.of_bop(value)


def _few(models: Models) -> str:
    listed = sorted(models)
    return ", ".join(map(str, listed[:10])) + (", …" if len(listed) > 10 else "")
