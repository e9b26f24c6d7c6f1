"""Check NDDS and FAT folders without knowing the meshes: against their own cuboids and images.

What differs between data sets in the wild is no defect as long as a whole one does it one way: x,
y, z, w or w, x, y, z; boxes as (row, column) or (column, row); OpenCV's or OpenGL's camera axes. It
is noted, and objects that differ from the majority are defects.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dopepp.data.formats.ndds.check_object import Majority, ObjectCheck
from dopepp.data.formats.ndds.fields import (
    Objects,
    has_own_ids,
    objects_of,
    parse_object,
    read_record,
)
from dopepp.data.formats.ndds.files import (
    CAMERA_SETTINGS,
    IMAGE_SUFFIXES,
    OBJECT_SETTINGS,
    Masks,
    Settings,
    companion,
    find_items,
    image_of,
)
from dopepp.data.formats.problems import CheckReport, check_map, entries, mapping, picture_shape
from dopepp.data.formats.tolerances import camera_problem
from dopepp.drawing.pictures import Shape
from dopepp.geometry.camera import CameraMatrix

_MAPS: Final = (".depth.png", ".seg.png")
_DERIVED: Final = (".depth", ".seg", ".cs", ".is", ".16", ".8")
"""Ends of stems of images that belong to another image: no annotation is missing there."""


def check_ndds(report: CheckReport) -> None:
    """Check every annotation, every image and the settings."""
    items, lonely = find_items(report.root)
    _check_unannotated(report, items + lonely)
    for path in lonely:
        report.report(path, "image", f"missing: neither {' nor '.join(IMAGE_SUFFIXES)} beside it")
    folders = {path.parent for path in items}
    settings = Settings(report.root, report)
    for folder in sorted(folders | {report.root}):
        _check_settings(report, settings, folder)
    # What is there for one image of a folder must be there for all.
    expected = {
        folder: [suffix for suffix in _MAPS if any(folder.glob(f"*{suffix}"))] for folder in folders
    }
    majority = Majority(report)
    for path in sorted(items + lonely):
        _Item(report, path, settings, majority).check(expected.get(path.parent, []))
        report.count_image()
    majority.conclude()


def _check_settings(report: CheckReport, settings: Settings, folder: Path) -> None:
    """Check a folder's settings files; what reads from them reports once what is damaged."""
    path = folder / OBJECT_SETTINGS
    content = settings.read(path) or {}
    listed = content.get("exported_object_classes")
    objects = entries(report, path, "exported_objects", content.get("exported_objects", []))
    if isinstance(listed, list) and objects:
        names = {str(entry.get("class")) for entry in objects}
        for name in sorted(set(map(str, listed)) - names):
            report.report(path, "exported_objects", f"no entry for class {name!r:.60}")
    path = folder / CAMERA_SETTINGS
    cameras = settings.read(path)
    if cameras is not None:
        listed = entries(report, path, "camera_settings", cameras.get("camera_settings"))
        for camera_name in _twice(str(camera.get("name")) for camera in listed):
            report.report(path, "camera_settings.name", f"{camera_name!r:.60} twice")


def _twice(values: Iterable[Hashable]) -> list[Hashable]:
    """Return the values that come more than once."""
    return [value for value, number in Counter(values).items() if number > 1]


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
                report.report(path, "annotation", f"missing: no {stem}.json beside it")


class _Item:
    """One annotation with its images."""

    def __init__(
        self, report: CheckReport, path: Path, settings: Settings, majority: Majority
    ) -> None:
        self._report, self._path = report, path
        self._settings, self._majority = settings, majority

    def check(self, maps: list[str]) -> None:
        """Check everything; ``maps`` are the suffixes of images that must be there."""
        report, path = self._report, self._path
        image = image_of(path)
        shape = None if image is None else picture_shape(report, image)
        images = {
            suffix: check_map(report, companion(path, suffix), shape, colour=True)
            for suffix in maps
        }
        labels = images.get(".seg.png")
        record = read_record(path, report)
        if record is None:
            return
        K = self._camera(record, shape)
        objects = objects_of(record, path, report)
        self._check_ids(objects, labels, has_own_ids(record))
        masks = Masks(objects, has_own_ids(record), path, self._settings, lambda: labels)
        for field, item, label in objects:
            self._check_class(field, label)
            one = parse_object(item, field, path, report)
            mask = masks.of(one.segmentation_id, label)
            sides = self._settings.dimensions(path, label)
            ObjectCheck(report, path, one, item, self._majority).check(K, shape, mask, sides)

    def _camera(self, record: Mapping[str, Any], shape: Shape | None) -> CameraMatrix | None:
        data = mapping(record.get("camera_data"))
        width, height = data.get("width"), data.get("height")
        if shape is not None and None not in (width, height) and (height, width) != shape:
            got = f"{width}×{height}; the image has {shape[1]}×{shape[0]}"
            self._report.report(self._path, "camera_data.size", got)
        K = self._settings.camera(record, self._path, self._report)
        if not np.isfinite(K).all():
            return None
        problem = None if shape is None else camera_problem(K, shape)
        if problem is not None:
            self._report.report(self._path, "camera_data.intrinsics", problem)
        return K if problem is None else None

    def _check_ids(self, objects: Objects, labels: NDArray[Any] | None, own: bool) -> None:
        """Report ids that two objects share, and labels (``own``: by object) of none."""
        for name in ("instance_id", "segmentation_id"):
            ids = [item.get(name) for _, item, _ in objects]
            known = [value for value in ids if type(value) is int and value > 0]  # −1, 0: none
            for value in _twice(known):
                self._report.report(self._path, f"objects.{name}", f"{value} twice")
        if labels is not None and own:
            strangers = sorted(set(np.unique(labels).tolist()) - set(known) - {0})
            if strangers:
                path = companion(self._path, ".seg.png")
                got = f"{strangers[:10]}: no object's segmentation_id"
                self._report.report(path, "values", got)

    def _check_class(self, field: str, label: str) -> None:
        known = self._settings.classes(self._path)
        if known is not None and label and label not in known:
            got = f"unknown object {label!r:.60}; known: {', '.join(sorted(known)[:10])}"
            self._report.report(self._path, f"{field}.class", got)
