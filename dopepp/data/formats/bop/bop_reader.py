"""Read BOP data sets in their scenewise layout: LM-O, T-LESS, YCB-V, ITODD or renders.

The folders ``SPLIT/NNNNNN/`` are scenes, see :mod:`~dopepp.data.formats.bop`.
"""

from __future__ import annotations

import hashlib
import logging
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil, floor
from pathlib import Path
from typing import Annotated, Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.core.json import read_json
from dopepp.core.validation import Range, parse
from dopepp.data.formats import ESTIMATED, bop, make_instance, share_slice
from dopepp.data.formats.bop import BopImage, read_scene
from dopepp.data.formats.bop.bop_models import objects_with_model, parts_by_id, read_models
from dopepp.data.formats.images import decode_depth, decode_mask, decode_rgb
from dopepp.data.sample import Sample, SourceInfo
from dopepp.drawing.pictures import Shape, Size, read_content
from dopepp.geometry.camera import CameraMatrix, check_camera, transform
from dopepp.geometry.cuboid import CENTROID
from dopepp.parts.part import Part

_log = logging.getLogger(__name__)

TARGETS_FILE: Final = "test_targets_bop19.json"
AUTO: Final = "auto"
"""Value of ``targets``: :data:`TARGETS_FILE` for a split like ``test_primesense``, if present."""

Count = Annotated[int, Range(0, 10**9 - 1)]


@dataclass(frozen=True)
class _Target:
    scene_id: Count
    im_id: Count
    obj_id: Count | None = None
    inst_count: Count = 1


Targets = dict[tuple[int, int], Counter[int] | None]
"""By (scene, image), the numbers of instances to find by object number; None for all objects."""


def read_targets(path: Path) -> Targets:
    """Return the instances to find that a file like ``test_targets_bop19.json`` lists."""
    records = parse(list[_Target], read_json(path), f"{path}", "download the file again")
    if not records:
        raise UserError(f"{path}, an empty list", "a list of targets", "download the file again")
    targets: Targets = {}
    for target in records:
        key = target.scene_id, target.im_id
        if target.obj_id is None:
            targets[key] = None
        elif (counts := targets.setdefault(key, Counter())) is not None:
            counts[target.obj_id] += target.inst_count
    return targets


class BopReader:
    """Reader of the images of a split, ordered by scene and image number.

    The constructor reads and checks the scenes' JSON files, but no image. An image without ground
    truth has no instances. Objects that are not among the parts or lie behind the camera are
    ignored and counted. The visible fraction is ``visib_fract`` of ``scene_gt_info.json``, or an
    estimate of :func:`~dopepp.data.formats.make_instance`.

    Args:
        parts: Objects to return, named as in ``models_info.json`` or ``obj_000001``.
        split: Folder of the scenes, e.g. ``test``, ``train_pbr``, ``train_real``.
        targets: File in ``root`` that selects images and the number of instances of each object,
            of which the most visible are targets; :data:`AUTO` for BOP's file.
        part_of: Consecutive share of the images as (first, last) fractions.
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
        self._num_behind, self._others = 0, Counter[int]()
        with_model = objects_with_model(read_models(self.root))
        folders = _scene_folders(self.root, split)
        self._images = [
            self._select_objects(image) for folder in folders for image in read_scene(folder)
        ]
        if targets == AUTO:
            is_present = split.startswith("test") and (self.root / TARGETS_FILE).is_file()
            targets = TARGETS_FILE if is_present else None
        self._targets = None if targets is None else read_targets(self.root / targets)
        items = self._find_items()
        self._items = items[share_slice(len(items), part_of, self.name)]
        self._log_deviations(with_model)

    def _select_objects(self, image: BopImage) -> BopImage:
        """Count the objects to ignore, and return the image with the others."""
        poses = image.poses
        is_wanted = np.isin(poses.obj_ids, list(self._parts))
        is_behind = poses.T_cam_obj[:, 2, 3] <= 0
        self._num_behind += int((is_wanted & is_behind).sum())
        self._others.update(poses.obj_ids[~is_wanted].tolist())
        return image.select(is_wanted & ~is_behind)

    def _find_items(self) -> list[BopImage]:
        targets = self._targets
        listed = [i for i in self._images if targets is None or _key(i) in targets]
        present = [image for image in listed if image.file is not None]
        num_listed = len(listed) if targets is None else len(targets)
        if not present:
            problem = f"no image under {self.root / self.split} ({num_listed:,} listed)"
            allowed = "at least one of the listed images in rgb/ or gray/"
            fix = "unpack all archives of the data set into this folder"
            raise UserError(problem, allowed, fix)
        if len(present) < num_listed:
            absent = f"{num_listed - len(present):,} of {num_listed:,}"
            _log.warning("%s: %s listed images are absent", self.name, absent)
        return present

    def _log_deviations(self, with_model: Collection[int]) -> None:
        without = {
            number: count
            for number, count in sorted(self._others.items())
            if number >= 0 and with_model and number not in with_model
        }
        other = self._others.total() - sum(without.values())
        poses = [image.poses for image in self._images]
        if other or self._num_behind:
            problem = f"{other:,} objects that are not among the parts"
            problem += f" and {self._num_behind:,} behind the camera"
            _log.info("%s: ignoring %s", self.name, problem)
        if inexact := sum(int(p.inexact.sum()) for p in poses):
            problem = f"{inexact:,} rotations are orthogonal to {bop.INEXACT:g} only"
            _log.warning("%s: %s; using the nearest rotations", self.name, problem)
        if without:
            listed = ", ".join(f"{number} ({count:,})" for number, count in without.items())
            _log.warning("%s: ignoring objects without a model: %s", self.name, listed)
        if unknown := sum(int(np.isnan(p.visible_fractions).sum()) for p in poses):
            _log.info("%s: %s objects' visible fractions are estimated", self.name, f"{unknown:,}")
        lacking = 0
        for image in self._items if self._targets is not None else ():
            present = Counter(image.poses.obj_ids.tolist())
            counts = self._target_counts(image) or Counter()
            counted = self._parts.keys() | (counts.keys() - with_model if with_model else set())
            lacking += sum(max(0, counts[obj_id] - present[obj_id]) for obj_id in counted)
        if lacking:
            problem = "listed instances have no annotation or no model and are not counted"
            _log.warning("%s: %s %s", self.name, f"{lacking:,}", problem)

    def _target_counts(self, image: BopImage) -> Counter[int] | None:
        return None if self._targets is None else self._targets[_key(image)]

    def __len__(self) -> int:
        return len(self._items)

    @cached_property
    def image_ids(self) -> list[tuple[str, int]]:
        """Name of the scene's folder and number of each image."""
        return [(image.scene.name, image.number) for image in self._items]

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Read an image; the epoch is ignored."""
        item = self._items[index]
        assert item.file is not None
        image = decode_rgb(read_content(item.file), str(item.file))
        shape: Shape = image.shape[:2]
        where = f"{item.scene / 'scene_camera.json'}: image {item.number}"
        K = check_camera(item.K, (shape[1], shape[0]), where)
        instances = []
        for n, gt_id in enumerate(item.gt_ids.tolist()):
            path = _mask_path(item.scene, item.file, gt_id)
            mask = decode_mask(read_content(path), str(path), shape) if path.exists() else None
            part, T_cam_obj = self._parts[int(item.poses.obj_ids[n])], item.poses.T_cam_obj[n]
            fraction = float(item.poses.visible_fractions[n])
            instances.append(make_instance(part, T_cam_obj.copy(), K, fraction, mask, shape))
        if (counts := self._target_counts(item)) is not None:
            remaining = Counter({part.name: counts[n] for n, part in self._parts.items()})
            for instance in sorted(instances, key=lambda instance: -instance.visible_fraction):
                instance.wanted = remaining[instance.label] > 0
                remaining[instance.label] -= 1
        depth, depth_file = None, item.depth_file
        if self._read_depth and depth_file is not None:
            content = read_content(depth_file)
            depth = decode_depth(content, str(depth_file), item.depth_scale, shape)
        key = f"{item.scene.name}/{item.number:06d}"
        return Sample(image, K, instances, depth, self.name, key)

    def view(self) -> tuple[Size, CameraMatrix, tuple[float, float] | None]:
        """Return the first image's (width, height) and K, and the range of the objects' depths.

        The range holds the depths of the cuboids' centres over all images, metres, rounded
        outwards to centimetres; None without an annotated object.
        """
        depths = [
            float(transform(T_cam_obj, self._parts[int(number)].cuboid[[CENTROID]])[0, 2])
            for image in self._images
            for number, T_cam_obj in zip(image.poses.obj_ids, image.poses.T_cam_obj, strict=True)
        ]
        first = self.sample(0)
        if not depths:
            return first.size, first.K, None
        return first.size, first.K, (floor(100 * min(depths)) / 100, ceil(100 * max(depths)) / 100)

    def contains(self, label: str) -> bool:
        """Return whether the object is annotated on any selected image."""
        return bool(self._num_instances.get(label))

    def files(self) -> Iterator[Path]:
        """Yield the annotations of each scene, and the image and the masks of each item."""
        for scene in dict.fromkeys(item.scene for item in self._items):
            yield from sorted(scene.glob("*.json"))
        for item in self._items:
            assert item.file is not None
            yield item.file
            for gt_id in item.gt_ids.tolist():
                yield _mask_path(item.scene, item.file, gt_id)

    def describe(self) -> list[SourceInfo]:
        """Return one entry: hashes of annotations and meshes, and the visible fractions' origin."""
        digest, is_stated = hashlib.sha256(), True
        for image in self._items:
            poses = image.poses
            digest.update(f"{image.scene.name}/{image.number}".encode())
            for array in (image.K, poses.T_cam_obj, poses.obj_ids):
                digest.update(np.ascontiguousarray(array).tobytes())
            is_stated &= not np.isnan(poses.visible_fractions).any()
        ignored = {"other_objects": self._others.total(), "behind_the_camera": self._num_behind}
        identity: dict[str, object] = {
            "annotation": digest.hexdigest(),
            "objects": {part.name: part.mesh_hash for part in self._parts.values()},
            "left_out": ignored,
            "visible_fractions": "scene_gt_info.json" if is_stated else ESTIMATED,
        }
        return [SourceInfo(self.name, len(self), identity, self._num_instances)]

    @cached_property
    def _num_instances(self) -> dict[str, int]:
        counts = Counter(number for image in self._items for number in image.poses.obj_ids.tolist())
        return {part.name: counts[object_id] for object_id, part in self._parts.items()}


def _key(image: BopImage) -> tuple[int, int]:
    return int(image.scene.name), image.number


def _mask_path(scene: Path, image: Path, gt_id: int) -> Path:
    return scene / "mask_visib" / f"{image.stem}_{gt_id:06d}.png"


def _scene_folders(root: Path, split: str) -> list[Path]:
    if not (root / split).is_dir():
        splits = sorted({path.parent.parent.name for path in root.glob("*/*/scene_camera.json")})
        raise UserError(
            f"{root / split}, which is not a folder",
            f"one of {splits}" if splits else "a BOP data set's folder with its splits",
            "set data.root and data.image_sets to existing folders; without labelled images, train "
            "on renders of the models with data=bop_renders",
        )
    folders = [p for p in (root / split).iterdir() if bop.is_number(p.name) and p.is_dir()]
    if not folders:
        problem, allowed = f"{root / split}, which has no scene", "folders 000000, 000001, …"
        raise UserError(problem, allowed, "unpack the data set's images into it")
    return sorted(folders, key=lambda path: (int(path.name), path.name))
