"""One scene folder of a BOP data set: its JSON files as checked arrays, its images unread."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int

from dopepp.data.formats.bop.records import (
    BopPoses,
    Record,
    pair_infos,
    read_cameras,
    read_poses,
)
from dopepp.data.formats.problems import STRICT, Problems, entries, load_object

_log = logging.getLogger(__name__)

MAX_SCENE_BYTES: Final = 128_000_000
"""Of one JSON file: 40,000 images with ten objects each."""

IMAGE_FOLDERS: Final = ("rgb", "gray")
IMAGE_SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
DEPTH_SUFFIXES: Final = (".png", ".tif", ".tiff")


@dataclass(frozen=True)
class SceneRecords:
    """What a scene's JSON files hold, by image.

    ``truths`` has one record per object, ``infos`` one for each of them, None where it is missing.
    """

    cameras: Mapping[int, object]
    truths: Mapping[int, list[Record]]
    infos: Mapping[int, list[Record | None]]


@dataclass(frozen=True)
class SceneFolder:
    """A scene's images, in the order of their numbers.

    Attributes:
        files: File of every image, relative to the folder; empty where it is not on disk.
        depth_scales: Millimetres a unit of its depth image; NaN where not stated.
        first: Objects ``first[i] … first[i + 1] − 1`` are on image i.
        gt_ids: Each object's place in its image's list, which names its masks.
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
    numbered = [path for path in split_dir.iterdir() if is_number(path.name) and path.is_dir()]
    return sorted(numbered, key=lambda path: (int(path.name), path.name))


def read_scene(folder: Path, wanted: set[int]) -> SceneFolder:
    """Read a scene's annotation: ``scene_camera.json`` and, if there, its ground truth's files.

    Objects that are not ``wanted`` are left out. Some data sets keep their ground truth private.

    Raises:
        UserError: A file is missing or damaged, or a record is impossible.
    """
    records = read_records(folder)
    cameras, truths, infos = records.cameras, records.truths, records.infos
    images = sorted(cameras)
    if without := truths.keys() - cameras.keys():
        _log.warning(
            "%s: %d images have ground truth and no camera, and are left out; first: %d",
            folder, len(without), min(without),
        )  # fmt: skip
    owners = [(row, n) for row, i in enumerate(images) for n in range(len(truths.get(i, ())))]

    def place(what: str, number: int) -> tuple[Path, str]:
        row, n = (number, None) if what == "camera" else owners[number]
        field = f"{images[row]}" if n is None else f"{images[row]}[{n}]"
        return folder / f"scene_{what}.json", field

    K, scales = read_cameras([cameras[i] for i in images], place)
    poses = read_poses(
        [truths[images[row]][n] for row, n in owners],
        [infos[images[row]][n] if infos else None for row, n in owners],
        place,
    )
    table = np.array(owners, np.int64).reshape(-1, 2)
    is_wanted = np.isin(poses.obj_ids, sorted(wanted))
    is_behind = poses.T_cam_obj[:, 2, 3] <= 0
    keep = is_wanted & ~is_behind
    files = image_files(folder, IMAGE_FOLDERS, IMAGE_SUFFIXES)
    return SceneFolder(
        folder,
        np.array(images, np.int64),
        [files[i].relative_to(folder).as_posix() if i in files else "" for i in images],
        K,
        scales,
        np.searchsorted(table[keep, 0], np.arange(len(images) + 1)),
        table[keep, 1],
        BopPoses(poses.obj_ids[keep], poses.T_cam_obj[keep], poses.visible_fractions[keep]),
        int((~is_wanted).sum()),
        int((is_wanted & is_behind).sum()),
    )


def read_records(folder: Path, problems: Problems = STRICT) -> SceneRecords:
    """Read a scene's JSON files; the two with ground truth may be missing."""
    cameras = _by_image(folder / "scene_camera.json", problems)
    truths, infos = (_objects(folder / f"scene_{n}.json", problems) for n in ("gt", "gt_info"))
    path = folder / "scene_gt_info.json"
    paired: dict[int, list[Record | None]] = {}
    for image, objects in truths.items() if infos else ():
        if image not in infos:
            problems.report(path, f"{image}", "missing", f"{len(objects)} objects")
        paired[image] = (
            pair_infos(objects, infos[image], path, f"{image}", problems)
            if image in infos
            else [None] * len(objects)
        )
    for image in sorted(infos.keys() - truths.keys()):
        paired[image] = []
    return SceneRecords(cameras, truths, paired)


def _objects(path: Path, problems: Problems) -> dict[int, list[Any]]:
    """Return each image's list of records; nothing where there is no such file."""
    by_image = _by_image(path, problems) if path.exists() else {}
    return {image: entries(problems, path, f"{image}", rows) for image, rows in by_image.items()}


def _by_image(path: Path, problems: Problems) -> dict[int, Any]:
    allowed = 'images by number: {"0": …, "1": …}'
    by_image: dict[int, Any] = {}
    for key, record in (load_object(problems, path, allowed, MAX_SCENE_BYTES) or {}).items():
        if not is_number(key):
            problems.report(path, f"{key!r:.40}", "no image's number", allowed)
        elif int(key) in by_image:
            problems.report(path, f"{key!r:.40}", f"image {int(key)} twice", "each once")
        else:
            by_image[int(key)] = record
    return by_image


def image_files(
    scene: Path, folders: tuple[str, ...], suffixes: tuple[str, ...], problems: Problems = STRICT
) -> dict[int, Path]:
    """Return the images of the first of some folders that is there, by number, all unread."""
    folder = next((scene / name for name in folders if (scene / name).is_dir()), None)
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()) if folder is not None else ():
        if not is_number(path.stem) or path.suffix.lower() not in suffixes:
            continue
        number = int(path.stem)
        if number in found:
            got = f"image {number} twice, also as {found[number].name}"
            problems.report(path, "file", got, "one file an image")
        else:
            found[number] = path
    return found


def is_number(text: str) -> bool:
    """Tell whether a key or a name is an image's, an object's or a scene's number."""
    return text.isascii() and text.isdecimal() and len(text) < 10
