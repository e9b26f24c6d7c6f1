"""Find and parse the files of an NDDS or FAT data set.

An item is ``STEM.json`` with an image ``STEM.png`` or ``STEM.jpg``; ``STEM`` is ``000000`` (NDDS)
or ``000000.left`` (FAT). Each folder may hold settings (``_*.json``); otherwise those in the data
set's folder apply. The readme of Falling Things (Tremblay et al., 2018) documents the formats.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from dopepp.data.formats.images import check_one_channel, read_map
from dopepp.data.formats.problems import STRICT, Node, Problems, mapping
from dopepp.drawing.pictures import DepthMap, Shape, read_image
from dopepp.geometry.camera import CameraMatrix, camera_matrix
from dopepp.geometry.rotation import Vector

OBJECT_SETTINGS: Final = "_object_settings.json"
CAMERA_SETTINGS: Final = "_camera_settings.json"
IMAGE_SUFFIXES: Final = (".png", ".jpg", ".jpeg")

MAX_ITEM_BYTES: Final = 16_000_000  # an annotation file; a hundred objects take 0.5 MB
DEPTH_UNIT: Final = 0.0001
"""Metres per value of a 16-bit ``.depth.png`` of FAT and of the writer; 0 is unknown."""

_NORM_TOLERANCE: Final = 0.1  # allowed deviation of a quaternion's norm from 1


Objects = list[tuple[Node, Mapping[str, Any], str]]
"""(node, JSON object, class name) of every object of an annotation."""


@dataclass(frozen=True)
class NddsObject:
    """An annotated object, in the file's unknown units and orders; NaN for damaged numbers.

    Attributes:
        location: Position of the object frame's origin in the camera frame.
        quaternion: The four numbers of ``quaternion_xyzw`` in the order of the file.
        corners_px: ``projected_cuboid`` without its centroid, if stated.
        cuboid: Corners in the camera frame, in the order of ``corners_px``, if stated.
        centroid: ``cuboid_centroid``, or else the mean of ``cuboid``; None without both.
        visibility: In [0, 1], or −1 for unknown, if stated.
    """

    node: Node
    label: str
    location: Vector
    quaternion: Float[np.ndarray, "4"]
    corners_px: Float[np.ndarray, "8 2"] | None
    cuboid: Float[np.ndarray, "8 3"] | None
    centroid: Vector | None
    visibility: float | None


def read_record(path: Path, problems: Problems = STRICT) -> Mapping[str, Any] | None:
    """Read an annotation or a settings file; report a damaged file and return None."""
    return Node(problems, path).load(max_bytes=MAX_ITEM_BYTES)


def objects_of(record: Mapping[str, Any], path: Path, problems: Problems = STRICT) -> Objects:
    """Return an annotation's objects, and report objects without a class."""
    objects: Objects = []
    node = Node(problems, path, "objects")
    for number, item in enumerate(node.entries(record.get("objects"))):
        label = item.get("class")
        if not isinstance(label, str):
            node[number]["class"].report(f"{label!r:.60}", "a name")
        objects.append((node[number], item, label if isinstance(label, str) else ""))
    return objects


def parse_object(item: Mapping[str, Any], node: Node) -> NddsObject:
    """Parse an annotated object; report wrong fields and replace them by NaN or None."""

    def numbers(name: str, *shape: int) -> NDArray[np.float64]:
        return node[name].numbers(item.get(name), *shape)

    def corners(name: str, axes: int) -> NDArray[np.float64] | None:
        value = item.get(name)
        # Some writers append the centroid as the ninth point.
        count = 9 if isinstance(value, list) and len(value) == 9 else 8
        return None if value in (None, []) else numbers(name, count, axes)[:8]

    quaternion = numbers("quaternion_xyzw", 4)
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > _NORM_TOLERANCE:
        node["quaternion_xyzw"].report(f"norm {norm:.4g}", "a quaternion of norm 1")
        quaternion = np.full(4, np.nan)
    corners_px, cuboid = corners("projected_cuboid", 2), corners("cuboid", 3)
    centroid = None if cuboid is None else cuboid.mean(axis=0)
    if item.get("cuboid_centroid") is not None:
        centroid = numbers("cuboid_centroid", 3)
    visibility = None if item.get("visibility") is None else float(numbers("visibility", 1)[0])
    if visibility is not None and (visibility > 1 or (visibility < 0 and visibility != -1)):
        node["visibility"].report(f"{visibility:g}", "0 … 1, or −1 for unknown")
        visibility = None
    label, location = str(item.get("class", "")), numbers("location", 3)
    return NddsObject(node, label, location, quaternion, corners_px, cuboid, centroid, visibility)


def convention_entry(record: Mapping[str, Any], name: str) -> object:
    """Return an entry of the ``conventions`` that ``NddsWriter`` adds to annotations, or None."""
    return mapping(record.get("conventions")).get(name)


def find_items(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the paths of annotations with an image, and of those without an image, sorted.

    The search skips settings (``_*.json``) and hidden files.
    """
    with_image: list[Path] = []
    without: list[Path] = []
    for parent, folders, names in os.walk(folder):
        folders.sort()
        present = set(names)
        for name in sorted(present):
            if name.endswith(".json") and not name.startswith(("_", ".")):
                stem = name.removesuffix(".json")
                has_image = any(stem + suffix in present for suffix in IMAGE_SUFFIXES)
                (with_image if has_image else without).append(Path(parent, name))
    return with_image, without


def sibling_path(annotation: Path, suffix: str) -> Path:
    """Return the path of an annotation's stem with another suffix, e.g. ``.seg.png``."""
    return annotation.with_name(annotation.name.removesuffix(".json") + suffix)


def image_path(annotation: Path) -> Path | None:
    """Return the path of an annotation's image, or None without an image."""
    paths = [sibling_path(annotation, suffix) for suffix in IMAGE_SUFFIXES]
    return next((path for path in paths if path.is_file()), None)


class NddsSettings:
    """Settings files of a data set, each read once on first use."""

    def __init__(self, root: Path, problems: Problems = STRICT) -> None:
        self._root, self._problems = root, problems
        self._files: dict[Path, Mapping[str, Any] | None] = {}

    def read(self, path: Path) -> Mapping[str, Any] | None:
        """Return the content of a settings file; None if it is missing or damaged."""
        if path not in self._files:
            self._files[path] = read_record(path, self._problems) if path.is_file() else None
        return self._files[path]

    def _of(self, annotation: Path, name: str) -> tuple[Path, Mapping[str, Any]]:
        """Return the path and content of settings in the annotation's folder, or in the root."""
        for path in (annotation.with_name(name), self._root / name):
            content = self.read(path)
            if content is not None:
                return path, content
        return annotation.with_name(name), {}

    def camera(
        self, record: Mapping[str, Any], annotation: Path, problems: Problems = STRICT
    ) -> CameraMatrix:
        """Return K (pixels) from an annotation's ``camera_data.intrinsics`` or the camera settings.

        If the settings have several cameras, the end of the stem names the camera (FAT's ``left``
        and ``right``). If no camera or several cameras match, the problem is reported and K is NaN.
        """
        node = Node(problems, annotation, "camera_data.intrinsics")
        intrinsics = mapping(record.get("camera_data")).get("intrinsics")
        if not isinstance(intrinsics, dict):
            path, settings = self._of(annotation, CAMERA_SETTINGS)
            side = annotation.name.removesuffix(".json").rpartition(".")[2]
            cameras = _entries(settings, "camera_settings")
            cameras = [camera for camera in cameras if camera.get("name") == side] or cameras
            stated = [camera.get("intrinsic_settings") for camera in cameras]
            if len(stated) != 1 or not isinstance(stated[0], dict):
                # An unreadable settings file is reported once, not for each image.
                files = annotation.with_name(CAMERA_SETTINGS), self._root / CAMERA_SETTINGS
                if not any(file.is_file() and self.read(file) is None for file in files):
                    where = f"of one camera or one named {side!r}, in {path.name}"
                    allowed = f"fx, fy, cx, cy there or, {where}"
                    node.report(f"{len(cameras)} cameras that match", allowed)
                return np.full((3, 3), np.nan)
            intrinsics = stated[0]
            node = Node(problems, path, "camera_settings[].intrinsic_settings")
        values = [intrinsics.get(name) for name in ("fx", "fy", "cx", "cy")]
        return camera_matrix(*node.numbers(values, 4))

    def fixed_transform(self, annotation: Path, label: str) -> NDArray[np.float64] | None:
        """Return a class's ``fixed_model_transform`` as a rigid 4×4 matrix for column vectors.

        The matrix maps the mesh into the object frame; its translation is in the file's unit. The
        file stores the transpose of this matrix, with a rotation multiplied by the ratio of the
        units of mesh and file, e.g. 100 for metres and centimetres. None without such a matrix.
        """
        for matrix in self._arrays(annotation, label, "fixed_model_transform", 4, 4):
            rigid = matrix.T
            linear = rigid[:3, :3]
            scale = float(np.cbrt(np.linalg.det(linear)))
            if scale > 0 and np.abs(linear @ linear.T / scale**2 - np.eye(3)).max() < 1e-2:
                rigid[:3, :3] = linear / scale
                return rigid
        return None

    def dimensions(self, annotation: Path, label: str) -> NDArray[np.float64] | None:
        """Return a class's ``cuboid_dimensions`` (x, y, z; file's unit); None if negative or 0."""
        for sides in self._arrays(annotation, label, "cuboid_dimensions", 3):
            if np.isfinite(sides).all() and (sides >= 0).all() and sides.any():
                return sides
        return None

    def class_id(self, annotation: Path, label: str) -> int | None:
        """Return a class's ``segmentation_class_id``, the value of its pixels in ``.seg.png``."""
        ids = [entry.get("segmentation_class_id") for entry in self._objects(annotation, label)]
        return next((value for value in ids if isinstance(value, int) and value > 0), None)

    def classes(self, annotation: Path) -> set[str] | None:
        """Return the names of the exported classes, or None if no settings list them."""
        listed = self._of(annotation, OBJECT_SETTINGS)[1].get("exported_object_classes")
        return {str(name) for name in listed} if isinstance(listed, list) else None

    def _objects(self, annotation: Path, label: str) -> list[dict[str, Any]]:
        entries = _entries(self._of(annotation, OBJECT_SETTINGS)[1], "exported_objects")
        return [entry for entry in entries if entry.get("class") == label]

    def _arrays(
        self, annotation: Path, label: str, name: str, *shape: int
    ) -> Iterator[NDArray[np.float64]]:
        """Yield field ``name`` of a class's entries as arrays; skip fields of a different shape."""
        for entry in self._objects(annotation, label):
            with suppress(KeyError, TypeError, ValueError, OverflowError):
                yield np.array(entry[name], np.float64).reshape(shape)


def _entries(settings: Mapping[str, Any], name: str) -> list[dict[str, Any]]:
    rows = settings.get(name)
    return [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []


def read_depth(record: Mapping[str, Any], annotation: Path, shape: Shape) -> DepthMap | None:
    """Read an item's depth image of ``shape``, metres along z.

    None if it is missing, or if neither the annotation nor FAT's file names imply its unit.
    """
    unit = convention_entry(record, "depth_unit_m")
    if unit is None and annotation.name.endswith((".left.json", ".right.json")):
        unit = DEPTH_UNIT
    path = sibling_path(annotation, ".depth.png")
    if not isinstance(unit, (int, float)) or not 0 < unit <= 1 or not path.is_file():
        return None
    values = read_map(Node(STRICT, path), shape)
    assert values is not None
    return values.astype(np.float32) * np.float32(unit)


def read_labels(annotation: Path, shape: Shape) -> NDArray[Any] | None:
    """Read ``STEM.seg.png``; None if it is missing or a colour image, whose meaning is unknown."""
    path = sibling_path(annotation, ".seg.png")
    image = read_image(path) if path.is_file() else None
    is_map = image is not None and image.ndim == 2
    return check_one_channel(Node(STRICT, path), image, shape) if is_map else None


def label_values(
    objects: Objects, record: Mapping[str, Any], annotation: Path, settings: NddsSettings
) -> dict[str, int | None]:
    """Return the value of each object's pixels in ``STEM.seg.png``, by the object's ``Node.where``.

    The value is None if it is unknown or belongs to several objects. An object without
    ``segmentation_id`` has its class's value, unless the annotation states that values are ids.
    """
    ids = [item.get("segmentation_id") for _, item, _ in objects]
    of_object = [value if isinstance(value, int) and value > 0 else None for value in ids]
    of_class = [settings.class_id(annotation, label) for _, _, label in objects]
    counts, class_counts = Counter(of_object), Counter(of_class)
    values: dict[str, int | None] = {}
    for (node, _, _), value, class_id in zip(objects, of_object, of_class, strict=True):
        is_unique = counts[value] == 1
        if value is None and not has_object_ids(record):
            value, is_unique = class_id, class_counts[class_id] == 1
        values[node.where] = value if is_unique else None
    return values


def has_object_ids(record: Mapping[str, Any]) -> bool:
    """Return whether an annotation states that pixels of ``.seg.png`` are ids of objects."""
    return convention_entry(record, "segmentation") == "segmentation_id"
