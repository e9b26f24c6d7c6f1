"""Read NDDS and FAT data sets: pairs of a JSON annotation and a PNG or JPEG image.

The reader determines the data set's pose convention by reprojection
(:mod:`~dopepp.data.formats.ndds.conventions`), logs it, and checks it on each instance. Data from
:class:`~dopepp.data.formats.ndds.ndds_writer.NddsWriter` are read back exactly.
"""

from __future__ import annotations

import hashlib
import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Final

from dopepp.core.errors import UserError
from dopepp.data.formats import ndds, share_slice
from dopepp.data.formats.ndds import conventions
from dopepp.data.formats.ndds.conventions import NddsFinding, Observation
from dopepp.data.sample import Instance, Sample, SourceInfo, hull_areas
from dopepp.drawing.pictures import Shape, read_rgb
from dopepp.geometry.camera import CameraMatrix, check_camera, project_keypoints
from dopepp.parts.part import Part

_log = logging.getLogger(__name__)

_FAT_SUFFIX: Final = "_16k"  # of class names in FAT, e.g. ``003_cracker_box_16k``
_MAX_OBSERVATIONS: Final = 60  # instances, evenly spread, that determine the convention
_MAX_COUNTED_ITEMS: Final = 1000  # takes about a second to read


class NddsReader:
    """Reader of the items in an NDDS or FAT folder and in the folders below it.

    Most files state a ``visibility`` that ignores the image's border. The reader then multiplies it
    by the share of the projected cuboid inside the image. A visibility that is missing or −1
    (nvisii: unknown) counts as 1. Objects of other classes, and invisible objects behind the
    camera, are ignored and counted. An instance has a mask if ``STEM.seg.png`` has a unique value
    for it: its ``segmentation_id`` or its class's ``segmentation_class_id``.

    Args:
        parts: Objects to return. An instance's ``class`` is a part's name, FAT's form of that name
            (``NAME_16k``), or a key of ``classes``.
        part_of: Share of the sorted items to use as (first, last) fractions, e.g. (0, 0.9).
        classes: Part names by the class names in the files.

    Raises:
        UserError: The folder has no items, no instance of the parts, or no clear convention.
    """

    def __init__(
        self,
        folder: Path,
        parts: Sequence[Part],
        part_of: tuple[float, float] = (0.0, 1.0),
        classes: Mapping[str, str] | None = None,
        read_depth: bool = True,
    ) -> None:
        self.folder, self._read_depth = Path(folder), read_depth
        self.name = f"ndds/{self.folder.resolve().name}"
        self._parts = {part.name: part for part in parts}
        self._classes = classes or {}
        unknown = sorted(set(self._classes.values()) - set(self._parts))
        if unknown:
            allowed = f"parts of {sorted(self._parts)}"
            fix = "map each class to the name of a part"
            raise UserError(f"classes of the parts {unknown}", allowed, fix)
        self._settings = ndds.NddsSettings(self.folder)
        items = _find_items(self.folder)
        self.items = items[share_slice(len(items), part_of, self.name)]
        # From all items, so that training and validation shares have the same convention.
        self.finding = self._find_convention(items)
        _log.info("%s: %s items; found: %s", self.name, f"{len(self.items):,}", self.finding)

    def _find_convention(self, items: Sequence[Path]) -> NddsFinding:
        visible: list[Observation] = []
        hidden: list[Observation] = []
        others: Counter[str] = Counter()
        step = max(1, len(items) // _MAX_OBSERVATIONS)
        # Evenly spread items come first, so that the first items represent the whole data set.
        for path in (path for start in range(step) for path in items[start::step]):
            observations, labels = self._read(path)
            others.update(labels)
            for observation in observations:
                if observation.item.corners_px is not None:
                    (hidden if observation.item.visibility == 0 else visible).append(observation)
            if len(visible) >= _MAX_OBSERVATIONS:
                break
        if not visible and not hidden:
            listed = ", ".join(f"{name} ({number})" for name, number in others.most_common(8))
            names = f"{', '.join(self._parts)}; other classes: {listed or 'none'}"
            problem = f"{self.folder}: no instance with projected_cuboid of the parts {names}"
            fix = "name the parts like the classes, or set data.classes={CLASS: part}"
            raise UserError(problem, "at least one instance whose class is a part's name", fix)
        # Hidden objects may be behind the camera, where projections are meaningless.
        return conventions.find_convention(visible or hidden, str(self.folder))

    def _part(self, label: str) -> Part | None:
        label = self._classes.get(label, label)
        if label not in self._parts and label.lower().endswith(_FAT_SUFFIX):
            label = label[: -len(_FAT_SUFFIX)]
        return self._parts.get(label)

    def _read(self, path: Path) -> tuple[list[Observation], list[str]]:
        """Return an annotation's instances of the parts, and the classes of its other objects."""
        record = ndds.read_record(path) or {}
        observations: list[Observation] = []
        others: list[str] = []
        K: CameraMatrix | None = None
        for node, item, label in ndds.objects_of(record, path):
            part = self._part(label)
            if part is None:
                others.append(label)
                continue
            K = self._settings.camera(record, path) if K is None else K
            fixed = self._settings.fixed_transform(path, label)
            observations.append(Observation(ndds.parse_object(item, node), part, K, fixed))
        return observations, others

    def __len__(self) -> int:
        return len(self.items)

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Read an item; the epoch is ignored."""
        path = self.items[index]
        image = read_rgb(ndds.image_path(path) or ndds.sibling_path(path, ndds.IMAGE_SUFFIXES[0]))
        shape: Shape = image.shape[:2]
        record = ndds.read_record(path) or {}
        K = check_camera(self._settings.camera(record, path), shape[::-1], str(path))
        objects = ndds.objects_of(record, path)
        values = ndds.label_values(objects, record, path, self._settings)
        labels = cache(lambda: ndds.read_labels(path, shape))
        counts_truncation = ndds.convention_entry(record, "visibility_counts_truncation") is True
        instances = []
        for observation in self._read(path)[0]:
            if not self._is_out_of_view(observation):
                instance = self._instance(observation, shape, counts_truncation)
                value = values[observation.item.node.where]
                if value is not None and (map_of_labels := labels()) is not None:
                    instance.mask = map_of_labels == value
                instances.append(instance)
        depth = ndds.read_depth(record, path, shape) if self._read_depth else None
        return Sample(image, K, instances, depth, self.name, self._key(path))

    def _key(self, path: Path) -> str:
        return path.relative_to(self.folder).as_posix().removesuffix(".json")

    def _is_out_of_view(self, observation: Observation) -> bool:
        """Return whether an object is behind the camera and invisible according to the file."""
        T_cam_obj = observation.T_cam_obj(self.finding.convention)
        behind = T_cam_obj is not None and T_cam_obj[2, 3] <= 0
        visibility = observation.item.visibility
        return behind and visibility is not None and visibility <= 0

    def _instance(
        self, observation: Observation, shape: Shape, counts_truncation: bool
    ) -> Instance:
        T_cam_obj = conventions.check_observation(observation, self.finding.convention)
        part, fraction = observation.part, observation.item.visibility
        keypoints = project_keypoints(part.cuboid, T_cam_obj, observation.K)
        if fraction is None or fraction == -1:
            fraction, counts_truncation = 1.0, False
        if not counts_truncation:
            inside, whole = hull_areas(keypoints[:8], shape)
            fraction *= min(1.0, inside / whole) if whole > 0 else 0.0
        return Instance(part.name, T_cam_obj, keypoints, float(fraction))

    def contains(self, label: str) -> bool:
        """Return whether the object is annotated on any item; read annotations until it is."""
        return label in self._parts and any(
            self._part(name) is self._parts[label]
            for path in self.items
            for _, _, name in ndds.objects_of(ndds.read_record(path) or {}, path)
        )

    def files(self) -> list[Path]:
        """Return all files of the folder."""
        return sorted(path for path in self.folder.rglob("*") if path.is_file())

    def describe(self) -> list[SourceInfo]:
        """Return one entry: hashes, convention and, for up to 1,000 items, numbers of instances."""
        identity: dict[str, object] = {
            "items": hashlib.sha256("\n".join(map(self._key, self.items)).encode()).hexdigest(),
            "objects": {part.name: part.mesh_hash for part in self._parts.values()},
            "convention": str(self.finding.convention),
        }
        if len(self.items) > _MAX_COUNTED_ITEMS:
            return [SourceInfo(self.name, len(self.items), identity)]
        num_instances = dict.fromkeys(self._parts, 0)
        ignored: Counter[str] = Counter()
        for path in self.items:
            observations, others = self._read(path)
            ignored.update(others)
            for observation in observations:
                if self._is_out_of_view(observation):
                    ignored[f"{observation.item.label}, behind the camera"] += 1
                else:
                    num_instances[observation.part.name] += 1
        identity["left out"] = dict(sorted(ignored.items()))
        return [SourceInfo(self.name, len(self.items), identity, num_instances)]


def _find_items(folder: Path) -> list[Path]:
    items, without_image = ndds.find_items(folder) if folder.is_dir() else ([], [])
    if not items:
        counts = f"({len(without_image)} JSON files without an image)"
        allowed = "an NDDS or FAT folder with pairs such as 000000.json and 000000.png or .jpg"
        problem = f"{folder} without an annotated image {counts}"
        raise UserError(problem, allowed, "pass the folder of the data set")
    if without_image:
        message = "%s: ignoring %s annotations without an image; first: %s"
        _log.warning(message, folder, f"{len(without_image):,}", without_image[0])
    return items
