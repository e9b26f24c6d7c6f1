"""BOP data sets in their scenewise layout: LM-O, T-LESS, YCB-V, ITODD, or a rendered one.

``SPLIT/NNNNNN/`` are scenes with ``scene_camera.json``, ``scene_gt.json``, ``scene_gt_info.json``
and the folders ``rgb`` (or ``gray``), ``depth`` and ``mask_visib``. Lengths are millimetres there.
"""

from __future__ import annotations

import hashlib
import logging
from collections import Counter
from collections.abc import Sequence, Set
from math import ceil, floor
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Int

from dopepp.core.errors import UserError
from dopepp.core.json import read_json
from dopepp.data.formats import share
from dopepp.data.formats.bop import records as bop
from dopepp.data.formats.bop.images import decode_depth, decode_mask, decode_rgb
from dopepp.data.formats.bop.models import modelled, parts_by_id, read_models
from dopepp.data.sample import Instance, Sample, SourceInfo
from dopepp.drawing.pictures import DepthMap, Mask, Shape, Size, read_content
from dopepp.geometry.camera import CameraMatrix, check_camera, transform
from dopepp.geometry.cuboid import CENTROID
from dopepp.parts.part import Part

_log = logging.getLogger(__name__)


Targets = dict[tuple[int, int], Counter[int] | None]
"""By scene and image, how many instances of each object are to be found; None for all there are."""

TARGETS_FILE: Final = "test_targets_bop19.json"
"""BOP's own list."""

AUTO: Final = "auto"
"""Of targets: :data:`TARGETS_FILE` of a split like ``test_primesense`` where it is there."""


def read_targets(path: Path) -> Targets:
    """Return the targets of a file like ``test_targets_bop19.json``.

    A UserError: it is no such list, or a target lacks one of ``scene_id``, ``im_id`` and, where it
    has an ``obj_id``, ``inst_count``.
    """
    records = read_json(path)
    if not isinstance(records, list) or not records:
        raise UserError(f"{path}", "a list of targets", "download the file again")
    targets: Targets = {}
    for number, record in enumerate(records):
        fields = record if isinstance(record, dict) else {}
        names = ["scene_id", "im_id"] + ["obj_id", "inst_count"] * ("obj_id" in fields)
        values: list[Any] = [fields.get(name) for name in names]
        if not all(type(value) is int and 0 <= value < 10**9 for value in values):
            raise UserError(
                f"{path}: target {number} with {' and '.join(names)} {tuple(values)}",
                "whole numbers from 0",
                "download the file again",
            )
        scene, image, *counted = values
        if counted:
            asked = targets.setdefault((scene, image), Counter())
            if asked is not None:
                asked[counted[0]] += counted[1]
        else:
            targets[scene, image] = None
    return targets


class BopSource:
    """The images of a split, by scene and number.

    Opening reads the scenes' JSON files and checks every record; images are read one by one. An
    image without ground truth has no instances. Objects that are none of the parts, and objects
    behind the camera (rendered sets pose them too), are left out and counted. The visible fraction
    is ``visib_fract`` of ``scene_gt_info.json``; without it, see
    :func:`~dopepp.data.formats.bop.records.make_instance`.

    Args:
        parts: The objects to return, called as in ``models_info.json`` or ``obj_000001``.
        split: Folder of the scenes, e.g. ``test``, ``train_pbr``, ``train_real``.
        targets: File in ``root`` that selects images and, in them, so many instances of an object,
            the most visible ones, e.g. ``test_targets_bop19.json``; ``auto`` takes that one where
            it is there.
        part_of: Consecutive share of the images to take, as (first, last) fractions: disjoint
            shares of one folder serve training, validation and test.
    """

    def __init__(
        self,
        root: str | Path,
        parts: Sequence[Part],
        split: str,
        targets: str | None = None,
        part_of: tuple[float, float] = (0.0, 1.0),
        read_depth: bool = True,
    ) -> None:
        self.root, self.split, self.name = Path(root), split, f"bop/{split}"
        self._parts = parts_by_id(self.root, parts)
        self._read_depth = read_depth
        folders = bop.scene_folders(_split_dir(self.root, split))
        if not folders:
            raise UserError(
                f"{self.root / split}, which has no scene", "folders 000000, 000001, …",
                "unpack the data set's images into it",
            )  # fmt: skip
        with_model = modelled(read_models(self.root))
        self._scenes = [bop.read_scene(folder, set(self._parts), with_model) for folder in folders]
        if targets == AUTO:
            is_there = split.startswith("test") and (self.root / TARGETS_FILE).is_file()
            targets = TARGETS_FILE if is_there else None
        self._targets = None if targets is None else read_targets(self.root / targets)
        items = self._present(self._targets)
        self._items = items[share(len(items), part_of, self.name)]
        other = sum(scene.num_other for scene in self._scenes)
        without = sum(scene.without_model.total() for scene in self._scenes)
        behind = sum(scene.num_behind for scene in self._scenes)
        self._left_out = {"other_objects": other + without, "behind_the_camera": behind}
        if other or behind:
            _log.info(
                "%s: left out %s objects that are none of the parts and %s behind the camera",
                self.name, f"{other:,}", f"{behind:,}",
            )  # fmt: skip
        self._tell_oddities()
        self._tell_lacking(with_model)

    def _tell_oddities(self) -> None:
        """Say once what of the annotation is not as it should be, and how it is taken."""
        inexact = sum(int(scene.poses.inexact.sum()) for scene in self._scenes)
        if inexact:
            _log.warning(
                "%s: %s rotations are orthogonal to %g only; the nearest are taken",
                self.name, f"{inexact:,}", bop.INEXACT,
            )  # fmt: skip
        without: Counter[int] = sum((scene.without_model for scene in self._scenes), Counter())
        if without:
            listed = ", ".join(f"{number} ({count:,})" for number, count in sorted(without.items()))
            _log.warning("%s: left out objects without a model: %s", self.name, listed)
        fractions = np.concatenate([scene.poses.visible_fractions for scene in self._scenes])
        if unknown := int(np.isnan(fractions).sum()):
            _log.info("%s: %s objects' visible fractions are estimated", self.name, f"{unknown:,}")

    def _tell_lacking(self, with_model: Set[int]) -> None:
        """Say how many of the listed instances cannot count: not annotated, or without a model."""
        lacking = 0
        for number, row in self._items.tolist() if self._targets is not None else ():
            scene, objects = self._scenes[number], self._scenes[number].objects(row)
            there = Counter(scene.poses.obj_ids[objects.start : objects.stop].tolist())
            asked = self._asked(scene, row) or Counter()
            known = self._parts.keys() | (asked.keys() - with_model if with_model else set())
            lacking += sum(max(0, asked[one] - there[one]) for one in known)
        if lacking:
            _log.warning(
                "%s: %s listed instances have no annotation or no model and are not counted",
                self.name, f"{lacking:,}",
            )  # fmt: skip

    def _asked(self, scene: bop.SceneFolder, row: int) -> Counter[int] | None:
        """Return how many instances the list asks for on an image of it; None for all."""
        assert self._targets is not None
        return self._targets[int(scene.folder.name), int(scene.image_ids[row])]

    def _present(self, targets: Targets | None) -> Int[np.ndarray, "items 2"]:
        """Return (scene, row) of the images that are selected and on disk, in order."""
        listed = [
            (number, row)
            for number, scene in enumerate(self._scenes)
            for row, image in enumerate(scene.image_ids.tolist())
            if targets is None or (int(scene.folder.name), image) in targets
        ]
        present = [(number, row) for number, row in listed if self._scenes[number].files[row]]
        num_wanted = len(listed) if targets is None else len(targets)
        if not present:
            raise UserError(
                f"no image under {self.root / self.split} ({num_wanted:,} listed)",
                "at least one listed image in rgb/ or gray/", "unpack the data set fully",
            )  # fmt: skip
        if len(present) < num_wanted:
            _log.warning(
                "%s: %s of %s listed images are absent",
                self.name, f"{num_wanted - len(present):,}", f"{num_wanted:,}",
            )  # fmt: skip
        return np.array(present, np.int64)

    def __len__(self) -> int:
        return len(self._items)

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Read an image; the epoch does not matter."""
        number, row = self._items[index]
        scene = self._scenes[number]
        path = scene.folder / scene.files[row]
        image = decode_rgb(read_content(path), str(path))
        shape: Shape = image.shape[:2]
        where = f"{scene.folder / 'scene_camera.json'}: image {scene.image_ids[row]}"
        K = check_camera(scene.K[row], (shape[1], shape[0]), where)
        instances = [self._instance(scene, k, path.stem, K, shape) for k in scene.objects(int(row))]
        if self._targets is not None:
            self._mark_wanted(instances, self._asked(scene, int(row)))
        depth = self._depth(scene, int(row), shape) if self._read_depth else None
        key = f"{scene.folder.name}/{scene.image_ids[row]:06d}"
        return Sample(image, K, instances, depth, self.name, key)

    def _mark_wanted(self, instances: list[Instance], asked: Counter[int] | None) -> None:
        """Mark the targets among an image's instances: of each object the most visible ones."""
        if asked is None:
            return
        names = {part.name: number for number, part in self._parts.items()}
        left = Counter(asked)
        for one in sorted(instances, key=lambda one: -one.visible_fraction):
            one.wanted = left[names[one.label]] > 0
            left[names[one.label]] -= 1

    def _instance(
        self, scene: bop.SceneFolder, k: int, stem: str, K: CameraMatrix, shape: Shape
    ) -> Instance:
        path = scene.folder / "mask_visib" / f"{stem}_{scene.gt_ids[k]:06d}.png"
        mask: Mask | None = None
        if path.exists():
            mask = decode_mask(read_content(path), str(path), shape)
        poses = scene.poses
        part = self._parts[int(poses.obj_ids[k])]
        fraction = float(poses.visible_fractions[k])
        return bop.make_instance(part, poses.T_cam_obj[k].copy(), K, fraction, mask, shape)

    def _depth(self, scene: bop.SceneFolder, row: int, shape: Shape) -> DepthMap | None:
        """Read the depth image; None in a scene without any."""
        if not any(scene.depth_files):
            return None
        missing = f"depth/{scene.image_ids[row]:06d}.png"
        path = scene.folder / (scene.depth_files[row] or missing)
        scale = float(scene.depth_scales[row])
        return decode_depth(read_content(path), str(path), scale, shape)

    def view(self) -> tuple[Size, CameraMatrix, tuple[float, float] | None]:
        """Return the first picture's (width, height) and K, pixels, and how far objects are.

        That is the nearest and the farthest depth of a cuboid's centre over all pictures, metres,
        rounded outwards to centimetres; None where no object is annotated, as where a challenge
        keeps the truth to itself.
        """
        depths = [
            float(transform(T_cam_obj, self._parts[int(number)].cuboid[[CENTROID]])[0, 2])
            for scene in self._scenes
            for number, T_cam_obj in zip(scene.poses.obj_ids, scene.poses.T_cam_obj, strict=True)
        ]
        first = self.sample(0)
        if not depths:
            return first.size, first.K, None
        return first.size, first.K, (floor(100 * min(depths)) / 100, ceil(100 * max(depths)) / 100)

    def contains(self, label: str) -> bool:
        """Tell whether an image holds this object."""
        return bool(self._count_instances().get(label))

    def describe(self) -> list[SourceInfo]:
        """Return the hash of the annotation, the objects and how visible fractions are known."""
        digest = hashlib.sha256()
        unknown = 0
        for number, row in self._items.tolist():
            scene = self._scenes[number]
            objects = scene.objects(row)
            chosen = slice(objects.start, objects.stop)
            digest.update(f"{scene.folder.name}/{scene.image_ids[row]}".encode())
            for array in (scene.K[row], scene.poses.T_cam_obj[chosen], scene.poses.obj_ids[chosen]):
                digest.update(np.ascontiguousarray(array).tobytes())
            unknown += int(np.isnan(scene.poses.visible_fractions[chosen]).sum())
        identity: dict[str, object] = {
            "annotation": digest.hexdigest(),
            "objects": {part.name: part.mesh_hash for part in self._parts.values()},
            "left_out": self._left_out,
            "visible_fractions": "scene_gt_info.json" if not unknown else bop.ESTIMATED,
        }
        return [SourceInfo(self.name, len(self), identity, self._count_instances())]

    def _count_instances(self) -> dict[str, int]:
        counts = {part.name: 0 for part in self._parts.values()}
        for number in np.unique(self._items[:, 0]):
            scene = self._scenes[number]
            rows = self._items[self._items[:, 0] == number, 1]
            owners = np.repeat(np.arange(len(scene.image_ids)), np.diff(scene.first))
            ids = scene.poses.obj_ids[np.isin(owners, rows)]
            for object_id, part in self._parts.items():
                counts[part.name] += int((ids == object_id).sum())
        return counts


def _split_dir(root: Path, split: str) -> Path:
    folder = root / split
    if not folder.is_dir():
        found = sorted(path.parent.parent.name for path in root.glob("*/*/scene_camera.json"))
        raise UserError(
            f"{folder}, which is no folder",
            f"one of {sorted(set(found))}" if found else "a BOP data set's folder with its splits",
            "correct data.root or data.image_sets; without labelled images to learn from, "
            "data=bop_renders learns renders of the models",
        )
    return folder
