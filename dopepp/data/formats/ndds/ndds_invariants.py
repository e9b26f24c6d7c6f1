"""Check that NDDS and FAT annotations agree with their cuboids, images and settings.

No mesh is needed. Data sets differ in their conventions. The report notes the convention of most
objects; deviating objects are defects.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from dopepp.data.formats import ndds
from dopepp.data.formats.images import image_shape, read_map
from dopepp.data.formats.invariants import plausible_camera
from dopepp.data.formats.ndds import IMAGE_SUFFIXES, NddsSettings, Objects
from dopepp.data.formats.ndds.object_invariants import Majority, ObjectCheck
from dopepp.data.formats.problems import CheckReport, Node, mapping
from dopepp.drawing.pictures import Shape
from dopepp.geometry.camera import CameraMatrix

_MAPS: Final = (".depth.png", ".seg.png")
_DERIVED: Final = (".depth", ".seg", ".cs", ".is", ".16", ".8")
"""Ends of the stems of derived images, which need no annotation."""


def check_ndds(report: CheckReport) -> None:
    """Check every annotation, image and settings file of a data set."""
    items, without_image = ndds.find_items(report.root)
    _check_unannotated(report, items + without_image)
    for path in without_image:
        report.report(path, "image", f"missing: no {' or '.join(IMAGE_SUFFIXES)} of this name")
    folders = {path.parent for path in items}
    settings = NddsSettings(report.root, report)
    for folder in sorted(folders | {report.root}):
        _check_settings(report, settings, folder)
    # If any image of a folder has a map, every image must have the map.
    expected = {
        folder: [suffix for suffix in _MAPS if any(folder.glob(f"*{suffix}"))] for folder in folders
    }
    majority = Majority(report)
    for path in sorted(items + without_image):
        _check_item(report, path, settings, majority, expected.get(path.parent, []))
        report.count_image()
    majority.conclude()


def _check_settings(report: CheckReport, settings: NddsSettings, folder: Path) -> None:
    """Report exported classes without an entry and repeated camera names in a folder's settings."""
    content = settings.read(folder / ndds.OBJECT_SETTINGS) or {}
    listed = content.get("exported_object_classes")
    node = Node(report, folder / ndds.OBJECT_SETTINGS, "exported_objects")
    objects = node.entries(content.get("exported_objects", []))
    if isinstance(listed, list) and objects:
        names = {str(entry.get("class")) for entry in objects}
        for name in sorted(set(map(str, listed)) - names):
            node.report(f"no entry for class {name!r:.60}")
    cameras = settings.read(folder / ndds.CAMERA_SETTINGS)
    if cameras is not None:
        node = Node(report, folder / ndds.CAMERA_SETTINGS, "camera_settings")
        entries = node.entries(cameras.get("camera_settings"))
        for camera_name in _repeated(str(camera.get("name")) for camera in entries):
            node["name"].report(f"{camera_name!r:.60} twice")


def _repeated(values: Iterable[Hashable]) -> list[Hashable]:
    return [value for value, number in Counter(values).items() if number > 1]


def _check_unannotated(report: CheckReport, annotations: list[Path]) -> None:
    """Report images without an annotation, in folders with annotations."""
    stems: dict[Path, set[str]] = {}
    for path in annotations:
        stems.setdefault(path.parent, set()).add(path.name.removesuffix(".json"))
    for folder, annotated in sorted(stems.items()):
        for path in sorted(folder.iterdir()):
            stem = path.stem
            is_image = path.suffix in IMAGE_SUFFIXES and not path.name.startswith((".", "_"))
            starts = (stem[:end] for end, character in enumerate(stem) if character == ".")
            belongs = stem in annotated or not annotated.isdisjoint(starts)
            if is_image and not belongs and not stem.endswith(_DERIVED):
                report.report(path, "annotation", f"missing: no {stem}.json in the folder")


def _check_item(
    report: CheckReport, path: Path, settings: NddsSettings, majority: Majority, maps: list[str]
) -> None:
    """Check an annotation at ``path``, its image and the required ``maps``, given by suffix."""
    image = ndds.image_path(path)
    shape = None if image is None else image_shape(Node(report, image))
    images = {
        suffix: read_map(Node(report, ndds.sibling_path(path, suffix)), shape, colour=True)
        for suffix in maps
    }
    labels = images.get(".seg.png")
    record = ndds.read_record(path, report)
    if record is None:
        return
    K = _check_camera(Node(report, path, "camera_data"), settings, record, shape)
    objects = ndds.objects_of(record, path, report)
    ids = _check_ids(Node(report, path, "objects"), objects)
    if labels is not None and ndds.has_object_ids(record):
        unknown = sorted(set(np.unique(labels).tolist()) - ids - {0})
        if unknown:
            message = f"{unknown[:10]}: no object's segmentation_id"
            report.report(ndds.sibling_path(path, ".seg.png"), "values", message)
    values = ndds.label_values(objects, record, path, settings)
    classes = settings.classes(path)
    for node, item, label in objects:
        if classes is not None and label and label not in classes:
            message = f"unknown object {label!r:.60}; known: {', '.join(sorted(classes)[:10])}"
            node["class"].report(message)
        value = values[node.where]
        mask = None if labels is None or value is None else labels == value
        parsed, sides = ndds.parse_object(item, node), settings.dimensions(path, label)
        ObjectCheck(parsed, item, majority).check(K, shape, mask, sides)


def _check_camera(
    node: Node, settings: NddsSettings, record: Mapping[str, Any], shape: Shape | None
) -> CameraMatrix | None:
    """Check an annotation's image size and K; return K, or None if K is missing or implausible."""
    data = mapping(record.get("camera_data"))
    width, height = data.get("width"), data.get("height")
    if shape is not None and None not in (width, height) and (height, width) != shape:
        node["size"].report(f"{width}×{height}; the image has {shape[1]}×{shape[0]}")
    K = settings.camera(record, Path(node.path), node.problems)
    return plausible_camera(node["intrinsics"], K, shape)


def _check_ids(node: Node, objects: Objects) -> set[int]:
    for name in ("instance_id", "segmentation_id"):
        stated = [item.get(name) for _, item, _ in objects]
        ids = [value for value in stated if type(value) is int and value > 0]  # −1, 0: none
        for value in _repeated(ids):
            node[name].report(f"{value} twice")
    return set(ids)
