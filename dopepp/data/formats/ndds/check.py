"""Check NDDS and FAT folders without knowing the meshes: against their own cuboids and images.

What has several habits in the wild is no defect as long as the whole data set has one: x, y, z, w
or w, x, y, z; boxes as (row, column) or (column, row); OpenCV's or OpenGL's camera axes. The habit
is noted, and files that differ from the majority are defects.

Tolerances beside those of :mod:`~dopepp.data.formats.tolerances`: a stated projection lies within
2 px and 2 % of the cuboid's longer side of where K puts the 3-D point; edges of a cuboid are
perpendicular and equal within 2 %, and its class's within 5 %; an orientation agrees with the
cuboid's within 2 degrees.

Check NDDS's settings files, each once, and hand them on where they are usable.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dopepp.core.errors import UserError
from dopepp.data.formats.ndds.check_fields import ObjectFields
from dopepp.data.formats.ndds.check_object import Conventions, ObjectCheck
from dopepp.data.formats.ndds.fields import stated
from dopepp.data.formats.ndds.files import (
    CAMERA_SETTINGS,
    IMAGE_SUFFIXES,
    OBJECT_SETTINGS,
    Settings,
    companion,
    find_items,
    image_of,
)
from dopepp.data.formats.problems import (
    CheckReport,
    entries,
    is_colour,
    load_image,
    load_json,
    load_size,
    mapping,
)
from dopepp.data.formats.tolerances import camera_problem


class CheckedSettings:
    """The settings files; what is wrong with them is reported once."""

    def __init__(self, report: CheckReport) -> None:
        self._report = report
        self._settings = Settings(report.root)
        self._seen: dict[Path, bool] = {}

    def of(self, path: Path) -> Settings | None:
        """Return the settings of an annotation's folder, None where they are damaged."""
        places = [
            place
            for folder in {path.parent, self._report.root}
            for place in (folder / OBJECT_SETTINGS, folder / CAMERA_SETTINGS)
        ]
        for place in places:
            if place.is_file() and place not in self._seen:
                self._seen[place] = self._check(place)
        return self._settings if all(self._seen.get(place, True) for place in places) else None

    def _check(self, path: Path) -> bool:
        """Check one file; tell whether it can be used."""
        before = self._report.num_defects
        content = load_json(self._report, path)
        if not isinstance(content, dict):
            if content is not None:
                self._report.add(path, "top level", "allowed: a JSON object")
            return False
        usable = self._report.num_defects == before
        if path.name == OBJECT_SETTINGS:
            self._check_objects(path, content)
        else:
            cameras = entries(self._report, path, "camera_settings", content.get("camera_settings"))
            names = [str(camera.get("name")) for camera in cameras]
            for name in twice(names):
                self._report.add(path, "camera_settings.name", f"{name!r:.60} twice")
        return usable

    def _check_objects(self, path: Path, content: Mapping[str, Any]) -> None:
        listed = content.get("exported_object_classes")
        objects = entries(
            self._report, path, "exported_objects", content.get("exported_objects", [])
        )
        names = {entry.get("class") for entry in objects}
        if isinstance(listed, list) and objects:
            for name in sorted(set(map(str, listed)) - {str(name) for name in names}):
                self._report.add(path, "exported_objects", f"no entry for class {name!r:.60}")


def twice(values: Iterable[Hashable]) -> list[Hashable]:
    """Return the values that come more than once."""
    return [value for value, number in Counter(values).items() if number > 1]


_MAPS: Final = (".depth.png", ".seg.png")
_DERIVED: Final = (".depth", ".seg", ".cs", ".is", ".16", ".8")
"""Ends of stems of images that belong to another image: no annotation is missing there."""


def check_ndds(report: CheckReport) -> None:
    """Check every annotation, every image and the settings."""
    items, lonely = find_items(report.root)
    _check_unannotated(report, items + lonely)
    for path in lonely:
        report.add(path, "image", f"missing: neither {' nor '.join(IMAGE_SUFFIXES)} beside it")
    settings = CheckedSettings(report)
    habits = Conventions(report)
    folders = {path.parent for path in items}
    expected = {
        (folder, suffix) for folder in folders for suffix in _MAPS if any(folder.glob(f"*{suffix}"))
    }
    for path in sorted(items + lonely):
        _Item(report, path, settings, habits).check(
            [suffix for suffix in _MAPS if (path.parent, suffix) in expected]
        )
        report.count_image()
    habits.conclude()


def _check_unannotated(report: CheckReport, annotations: list[Path]) -> None:
    """Report pictures without an annotation, in folders that hold annotations."""
    stems: dict[Path, set[str]] = {}
    for path in annotations:
        stems.setdefault(path.parent, set()).add(path.name.removesuffix(".json"))
    for folder, annotated in sorted(stems.items()):
        for path in sorted(folder.iterdir()):
            stem = path.stem
            is_picture = path.suffix in IMAGE_SUFFIXES and not path.name.startswith((".", "_"))
            belongs = stem in annotated or any(
                stem.startswith(f"{stem[:place]}.") and stem[:place] in annotated
                for place, character in enumerate(stem)
                if character == "."
            )
            if is_picture and not belongs and not stem.endswith(_DERIVED):
                report.add(path, "annotation", f"missing: no {stem}.json beside it")


class _Item:
    """One annotation with its images."""

    def __init__(
        self, report: CheckReport, path: Path, settings: CheckedSettings, habits: Conventions
    ) -> None:
        self._report, self._path, self._habits = report, path, habits
        self._settings = settings.of(path)

    def check(self, maps: list[str]) -> None:
        """Check everything; ``maps`` are the suffixes of images that must be there."""
        size, segmentation = self._images(maps)
        record = load_json(self._report, self._path)
        if not isinstance(record, dict):
            if record is not None:
                self._report.add(self._path, "top level", "allowed: a JSON object")
            return
        K = self._camera(record, size)
        objects = entries(self._report, self._path, "objects", record.get("objects"))
        self._check_unique(objects)
        if stated(record, "segmentation") == "segmentation_id":
            class_ids: Counter[int | None] = Counter()  # its values are no class's
            self._check_values(objects, segmentation)
        else:
            class_ids = Counter(self._class_id(item) for item in objects)
        for number, item in enumerate(objects):
            self._check_class(number, item)
            mask = self._mask(item, objects, class_ids, segmentation)
            fields = ObjectFields(self._report, self._path, f"objects[{number}]", item)
            ObjectCheck(fields, self._path, self._habits).check(K, size, mask, self._sides(item))

    def _sides(self, item: Mapping[str, Any]) -> NDArray[np.float64] | None:
        name = item.get("class")
        if self._settings is None or not isinstance(name, str):
            return None
        return self._settings.dimensions(self._path, name)

    def _images(self, maps: list[str]) -> tuple[tuple[int, int] | None, NDArray[Any] | None]:
        """Return the size of the picture and the segmentation, where they can be read."""
        path = image_of(self._path)
        size = None if path is None else load_size(self._report, path)
        images = {suffix: self._map(companion(self._path, suffix), size) for suffix in maps}
        return size, images.get(".seg.png")

    def _map(self, path: Path, size: tuple[int, int] | None) -> NDArray[Any] | None:
        if is_colour(path):
            # Colours stand for depths or objects in a way that no file states.
            if load_size(self._report, path) not in (size, None) and size is not None:
                self._report.add(path, "size", f"another than the image's {size[0]}×{size[1]}")
            return None
        return load_image(self._report, path, size)

    def _camera(
        self, record: Mapping[str, Any], size: tuple[int, int] | None
    ) -> NDArray[np.float64] | None:
        data = mapping(record.get("camera_data"))
        stated = data.get("width"), data.get("height")
        if size is not None and None not in stated and stated != size:
            message = f"{stated[0]}×{stated[1]}; the image has {size[0]}×{size[1]}"
            self._report.add(self._path, "camera_data.size", message)
        if self._settings is None and "intrinsics" not in data:
            return None  # damaged settings are one defect, not one for every image
        try:
            K = (self._settings or Settings(self._report.root)).camera(record, self._path)
        except UserError as error:
            message = error.got.partition(": ")[2] or error.got
            self._report.add(self._path, "camera_data.intrinsics", f"{message}; {error.allowed}")
            return None
        problem = None if size is None else camera_problem(K, size)
        if problem is not None:
            self._report.add(self._path, "camera_data.intrinsics", problem)
        return K if problem is None and np.isfinite(K).all() else None

    def _check_unique(self, objects: list[Any]) -> None:
        for field in ("instance_id", "segmentation_id"):
            values = [value for item in objects if _is_id(value := item.get(field))]
            for value in twice(values):
                self._report.add(self._path, f"objects.{field}", f"{value} twice")

    def _check_values(self, objects: list[Any], segmentation: NDArray[Any] | None) -> None:
        """Report values of a segmentation by object that belong to none."""
        known = {value for item in objects if _is_id(value := item.get("segmentation_id"))}
        if segmentation is not None:
            strangers = sorted(set(np.unique(segmentation).tolist()) - known - {0})
            if strangers:
                path = companion(self._path, ".seg.png")
                self._report.add(path, "values", f"{strangers[:10]}: no object's segmentation_id")

    def _check_class(self, number: int, item: Mapping[str, Any]) -> None:
        name, where = item.get("class"), f"objects[{number}].class"
        if not isinstance(name, str):
            self._report.add(self._path, where, f"{name!r:.60}; allowed: a name")
            return
        known = None if self._settings is None else self._settings.classes(self._path)
        if known is not None and name not in known:
            listed = ", ".join(sorted(known)[:10])
            self._report.add(self._path, where, f"unknown object {name!r:.60}; known: {listed}")

    def _class_id(self, item: Mapping[str, Any]) -> int | None:
        name = item.get("class")
        if self._settings is None or not isinstance(name, str):
            return None
        return self._settings.class_id(self._path, name)

    def _mask(
        self,
        item: Mapping[str, Any],
        objects: list[Any],
        class_ids: Counter[int | None],
        segmentation: NDArray[Any] | None,
    ) -> NDArray[np.bool_] | None:
        """Return an object's pixels where the segmentation's values are known to be its own."""
        if segmentation is None:
            return None
        own = item.get("segmentation_id")
        if isinstance(own, int):
            alone = sum(other.get("segmentation_id") == own for other in objects) == 1
            return np.asarray(segmentation == own) if alone and own > 0 else None
        class_id = self._class_id(item)
        if class_id is None or class_ids[class_id] != 1:
            return None
        return np.asarray(segmentation == class_id)


def _is_id(value: object) -> bool:
    """Tell whether it is an id; −1 and 0 stand for none."""
    return type(value) is int and value > 0
