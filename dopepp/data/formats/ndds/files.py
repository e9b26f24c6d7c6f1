"""The files of an NDDS or FAT data set: which belong together, and what they hold.

An item is ``STEM.json`` with its image ``STEM.png`` or ``STEM.jpg`` beside it; ``STEM`` is
``000000`` (NDDS) or ``000000.left`` (FAT), in the folder or anywhere below it. Each folder may hold
``_object_settings.json`` and ``_camera_settings.json``; if not, those of the data set's folder
count. Formats: the readme of the Falling Things data set (Tremblay et al., 2018).
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dopepp.data.formats.ndds.fields import Objects, intrinsics, read_record, stated
from dopepp.data.formats.problems import STRICT, Problems, one_channel, read_map
from dopepp.drawing.pictures import DepthMap, Mask, Shape, read_image
from dopepp.geometry.camera import CameraMatrix

OBJECT_SETTINGS: Final = "_object_settings.json"
CAMERA_SETTINGS: Final = "_camera_settings.json"
IMAGE_SUFFIXES: Final = (".png", ".jpg", ".jpeg")


def find_items(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the annotations that have an image and those that have none, sorted.

    Settings (``_*.json``) and hidden files are none.
    """
    with_image: list[Path] = []
    without: list[Path] = []
    for parent, folders, names in os.walk(folder):
        folders.sort()
        present = set(names)
        for name in sorted(present):
            if name.endswith(".json") and not name.startswith(("_", ".")):
                stem = name.removesuffix(".json")
                found = any(stem + suffix in present for suffix in IMAGE_SUFFIXES)
                (with_image if found else without).append(Path(parent, name))
    return with_image, without


def companion(annotation: Path, suffix: str) -> Path:
    """Return a file beside an annotation: its stem with a suffix such as ``.seg.png``."""
    return annotation.with_name(annotation.name.removesuffix(".json") + suffix)


def image_of(annotation: Path) -> Path | None:
    """Return an annotation's image, None where there is none."""
    paths = [companion(annotation, suffix) for suffix in IMAGE_SUFFIXES]
    return next((path for path in paths if path.is_file()), None)


class Settings:
    """The settings files of a data set, each read once and only when it is needed."""

    def __init__(self, root: Path, problems: Problems = STRICT) -> None:
        self._root, self._problems = root, problems
        self._files: dict[Path, Mapping[str, Any] | None] = {}

    def read(self, path: Path) -> Mapping[str, Any] | None:
        """Return what a settings file holds, None where there is none or it is damaged."""
        if path not in self._files:
            is_there = path.is_file()
            self._files[path] = read_record(path, self._problems) if is_there else None
        return self._files[path]

    def _of(self, annotation: Path, name: str) -> tuple[Path, Mapping[str, Any]]:
        """Return the settings of the annotation's folder or else of the data set's, or nothing."""
        for path in self._places(annotation, name):
            content = self.read(path)
            if content is not None:
                return path, content
        return annotation.with_name(name), {}

    def _places(self, annotation: Path, name: str) -> tuple[Path, Path]:
        return annotation.with_name(name), self._root / name

    def camera(
        self, record: Mapping[str, Any], annotation: Path, problems: Problems = STRICT
    ) -> CameraMatrix:
        """Return K: the annotation's own ``camera_data.intrinsics`` or the camera settings'.

        Of several cameras in the settings, the one counts whose name ends the stem (FAT's ``left``
        and ``right``). It is a problem (and NaN) if neither file has them, or if it is unclear
        which camera's they are.
        """
        data = record.get("camera_data")
        own = data.get("intrinsics") if isinstance(data, dict) else None
        if isinstance(own, dict):
            return intrinsics(own, annotation, "camera_data.intrinsics", problems)
        path, settings = self._of(annotation, CAMERA_SETTINGS)
        side = annotation.name.removesuffix(".json").rpartition(".")[2]
        cameras = list(_entries(settings, "camera_settings"))
        cameras = [camera for camera in cameras if camera.get("name") == side] or cameras
        if len(cameras) == 1 and isinstance(cameras[0].get("intrinsic_settings"), dict):
            where = "camera_settings[].intrinsic_settings"
            return intrinsics(cameras[0]["intrinsic_settings"], path, where, problems)
        # A settings file that cannot be read is one problem, not one for every image.
        places = self._places(annotation, CAMERA_SETTINGS)
        if not any(place.is_file() and self.read(place) is None for place in places):
            got = f"{len(cameras)} cameras' to take"
            allowed = (
                f"fx, fy, cx, cy there or, of one camera or one named {side!r}, in {path.name}"
            )
            problems.report(annotation, "camera_data.intrinsics", got, allowed)
        return np.full((3, 3), np.nan)

    def fixed_transform(self, annotation: Path, label: str) -> NDArray[np.float64] | None:
        """Return a class's ``fixed_model_transform`` as a rigid 4×4 matrix for column vectors.

        It maps the mesh into the object frame. The file holds the transpose, scaled by the mesh's
        unit over the file's (100 for metres and centimetres); the translation is in the file's
        unit. None where there is none, or nothing that is a rotation, a scale and a translation.
        """
        for entry in self._objects(annotation, label):
            try:
                matrix = np.array(entry["fixed_model_transform"], np.float64).reshape(4, 4).T
            except (KeyError, TypeError, ValueError, OverflowError):
                continue
            linear = matrix[:3, :3]
            scale = float(np.cbrt(np.linalg.det(linear)))
            if scale > 0 and np.abs(linear @ linear.T / scale**2 - np.eye(3)).max() < 1e-2:
                matrix[:3, :3] = linear / scale
                return matrix
        return None

    def dimensions(self, annotation: Path, label: str) -> NDArray[np.float64] | None:
        """Return a class's ``cuboid_dimensions`` (x, y, z), file's unit; None where not usable."""
        for entry in self._objects(annotation, label):
            try:
                sides = np.array(entry["cuboid_dimensions"], np.float64).reshape(3)
            except (KeyError, TypeError, ValueError, OverflowError):
                continue
            if np.isfinite(sides).all() and (sides >= 0).all() and sides.any():
                return sides
        return None

    def class_id(self, annotation: Path, label: str) -> int | None:
        """Return a class's ``segmentation_class_id``, the value of its pixels in ``.seg.png``."""
        ids = [entry.get("segmentation_class_id") for entry in self._objects(annotation, label)]
        return next((value for value in ids if isinstance(value, int) and value > 0), None)

    def classes(self, annotation: Path) -> set[str] | None:
        """Return the names of the exported classes, None where no settings name them."""
        listed = self._of(annotation, OBJECT_SETTINGS)[1].get("exported_object_classes")
        return {str(name) for name in listed} if isinstance(listed, list) else None

    def _objects(self, annotation: Path, label: str) -> Iterator[Mapping[str, Any]]:
        settings = self._of(annotation, OBJECT_SETTINGS)[1]
        for entry in _entries(settings, "exported_objects"):
            if entry.get("class") == label:
                yield entry


def _entries(settings: Mapping[str, Any], name: str) -> Iterator[dict[str, Any]]:
    listed = settings.get(name)
    return (
        entry for entry in (listed if isinstance(listed, list) else []) if isinstance(entry, dict)
    )


DEPTH_UNIT: Final = 0.0001
"""Metres per value of a 16-bit ``.depth.png``: FAT's unit, and what we write; 0 is unknown."""


def read_depth(record: Mapping[str, Any], annotation: Path, shape: Shape) -> DepthMap | None:
    """Read depth in metres along z, or None where there is none or its unit is not known.

    The unit is known where the annotation states it, or from FAT's naming.

    Raises:
        UserError: The image is damaged, or of another size than ``shape`` (height, width).
    """
    unit = stated(record, "depth_unit_m")
    if unit is None and annotation.name.endswith((".left.json", ".right.json")):
        unit = DEPTH_UNIT
    path = companion(annotation, ".depth.png")
    if not isinstance(unit, (int, float)) or not 0 < unit <= 1 or not path.is_file():
        return None
    return read_map(path, shape).astype(np.float32) * np.float32(unit)


def read_labels(annotation: Path, shape: Shape) -> NDArray[Any] | None:
    """Read ``STEM.seg.png``; None where there is none, or colours, which no file explains.

    Raises:
        UserError: The image is damaged, or of another size than ``shape`` (height, width).
    """
    path = companion(annotation, ".seg.png")
    image = read_image(path) if path.is_file() else None
    return (
        one_channel(STRICT, path, image, shape) if image is not None and image.ndim == 2 else None
    )


class Masks:
    """The masks of one image; its labels are read when the first one is asked for.

    Args:
        has_own_ids: Whether labels are known to be ``segmentation_id``, never a class's.
        read: Reads the labels, None where there are none to be understood.
    """

    def __init__(
        self,
        objects: Objects,
        has_own_ids: bool,
        annotation: Path,
        settings: Settings,
        read: Callable[[], NDArray[Any] | None],
    ) -> None:
        self._has_own_ids, self._annotation = has_own_ids, annotation
        self._settings, self._read = settings, cache(read)
        ids = [item.get("segmentation_id") for _, item, _ in objects]
        self._ids = Counter(value for value in ids if isinstance(value, int))
        self._class_ids = Counter(settings.class_id(annotation, name) for _, _, name in objects)

    def of(self, segmentation_id: int | None, label: str) -> Mask | None:
        """Return an instance's mask, or None where its pixels' value is unknown or not only its."""
        class_id = None
        if not self._has_own_ids:
            class_id = self._settings.class_id(self._annotation, label)
        if segmentation_id is not None and self._ids[segmentation_id] == 1:
            value = segmentation_id
        elif segmentation_id is None and class_id is not None and self._class_ids[class_id] == 1:
            value = class_id
        else:
            return None
        labels = self._read()
        return None if labels is None else np.asarray(labels == value)
