"""One scene folder of a BOP data set: its JSON files as checked arrays, its images unread."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int

from dopepp.core.errors import UserError
from dopepp.core.json import read_json
from dopepp.data.formats.bop.records import BopPoses, read_cameras, read_poses

_log = logging.getLogger(__name__)

MAX_SCENE_BYTES: Final = 128_000_000
"""Of one JSON file: 40,000 images with ten objects each."""

IMAGE_FOLDERS: Final = ("rgb", "gray")
IMAGE_SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".tif", ".tiff")

_MAX_ID: Final = 10**9


@dataclass(frozen=True)
class SceneFolder:
    """A scene's images, in the order of their numbers.

    Attributes:
        folder: The scene's folder.
        image_ids: BOP's ``im_id`` of every image.
        files: File of every image, relative to the folder; empty where it is not on disk.
        K: Camera matrix of every image, pixels.
        depth_scales: Millimetres a unit of its depth image; NaN where not stated.
        first: Objects ``first[i] … first[i + 1] − 1`` are on image i.
        gt_ids: Each object's place in its image's list, which names its masks.
        poses: The objects of interest.
        num_other: Objects that are none of the parts.
        num_behind: Objects of interest behind the camera, left out like the others.
    """

    folder: Path
    image_ids: Int[np.ndarray, " images"]
    files: list[str]
    K: Float[np.ndarray, "images 3 3"]
    depth_scales: Float[np.ndarray, " images"]
    first: Int[np.ndarray, " bounds"]
    gt_ids: Int[np.ndarray, " objects"]
    poses: BopPoses
    num_other: int
    num_behind: int

    def objects(self, image: int) -> range:
        """Return which objects are on an image."""
        return range(int(self.first[image]), int(self.first[image + 1]))


def scene_folders(split_dir: Path) -> list[Path]:
    """Return a split's scenes by number: the folders that are called by one."""
    numbered = [path for path in split_dir.iterdir() if _is_number(path.name) and path.is_dir()]
    return sorted(numbered, key=lambda path: (int(path.name), path.name))


def read_scene(folder: Path, wanted: set[int]) -> SceneFolder:
    """Read a scene's annotation.

    Args:
        folder: It has ``scene_camera.json``; ``scene_gt.json`` and ``scene_gt_info.json`` may be
            missing, as where a data set keeps its ground truth private.
        wanted: Object numbers of interest; other objects are left out.

    Raises:
        UserError: A file is missing or damaged, or a record is impossible.
    """
    path = folder / "scene_camera.json"
    cameras = _by_image(path)
    images = sorted(cameras)
    K, scales = read_cameras([cameras[i] for i in images], lambda n: f"{path}: image {images[n]}")
    truths, infos = _objects(folder, "scene_gt.json"), _objects(folder, "scene_gt_info.json")
    _check_counts(folder, truths, infos)
    if without := truths.keys() - cameras.keys():
        _log.warning(
            "%s: %d images have ground truth and no camera, and are left out; first: %d",
            folder, len(without), min(without),
        )  # fmt: skip
    owners = [(row, n) for row, i in enumerate(images) for n in range(len(truths.get(i, ())))]
    poses = read_poses(
        [truths[images[row]][n] for row, n in owners],
        [infos[images[row]][n] for row, n in owners] if infos else None,
        lambda k: (
            f"{folder / 'scene_gt.json'} (or _info): image {images[owners[k][0]]}, "
            f"object {owners[k][1]}"
        ),
    )
    table = np.array(owners, np.int64).reshape(-1, 2)
    is_wanted = np.isin(poses.obj_ids, sorted(wanted))
    is_behind = poses.T_cam_obj[:, 2, 3] <= 0
    keep = is_wanted & ~is_behind
    return SceneFolder(
        folder,
        np.array(images, np.int64),
        _image_files(folder, images),
        K,
        scales,
        np.searchsorted(table[keep, 0], np.arange(len(images) + 1)),
        table[keep, 1],
        BopPoses(poses.obj_ids[keep], poses.T_cam_obj[keep], poses.visible_fractions[keep]),
        int((~is_wanted).sum()),
        int((is_wanted & is_behind).sum()),
    )


def _objects(folder: Path, name: str) -> Mapping[int, list[Any]]:
    """Return each image's list of records; nothing where there is no such file."""
    path = folder / name
    if not path.exists():
        return {}
    by_image = _by_image(path)
    for image, records in by_image.items():
        if not isinstance(records, list):
            raise _bad(f"{path}: image {image}", "a list of objects")
    return by_image


def _by_image(path: Path) -> dict[int, Any]:
    records = read_json(path, MAX_SCENE_BYTES)
    if not isinstance(records, dict):
        raise _bad(f"{path}", 'images by number: {"0": …, "1": …}')
    by_image: dict[int, Any] = {}
    for key, record in records.items():
        number = int(key) if _is_number(key) else -1
        if number < 0 or number in by_image:
            raise _bad(f"{path}: image {key!r:.40}", f"each number 0 – {_MAX_ID - 1} once")
        by_image[number] = record
    return by_image


def _check_counts(
    folder: Path, truths: Mapping[int, list[Any]], infos: Mapping[int, list[Any]]
) -> None:
    if not infos:
        return
    for image, records in truths.items():
        stated = len(infos[image]) if image in infos else math.nan
        if stated != len(records):
            raise _bad(
                f"{folder / 'scene_gt_info.json'}: image {image} with {stated} objects",
                f"{len(records)}, as many as in scene_gt.json",
            )


def _image_files(folder: Path, images: list[int]) -> list[str]:
    """Find every image in ``rgb`` or ``gray``; folders are listed once, no image is opened."""
    found: dict[int, str] = {}
    for name in IMAGE_FOLDERS:
        if not (folder / name).is_dir():
            continue
        for path in (folder / name).iterdir():
            if not (_is_number(path.stem) and path.suffix.lower() in IMAGE_SUFFIXES):
                continue
            if int(path.stem) in found:
                raise _bad(
                    f"{folder}: image {int(path.stem)} as {found[int(path.stem)]} and "
                    f"{name}/{path.name}",
                    "one file an image",
                )
            found[int(path.stem)] = f"{name}/{path.name}"
        break
    return [found.get(image, "") for image in images]


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdecimal() and len(text) < 10


def _bad(got: str, allowed: str) -> UserError:
    return UserError(got, allowed, "correct the file or download it again")
