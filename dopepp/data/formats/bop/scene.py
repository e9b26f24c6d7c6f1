"""A scene of BOP: its JSON files, read and checked, and its images by number.

A scene has ``scene_camera.json``, ``scene_gt.json``, ``scene_gt_info.json`` and the folders ``rgb``
(or ``gray``), ``depth``, ``mask`` and ``mask_visib``. Lengths are millimetres there.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dopepp.data.formats import bop
from dopepp.data.formats.problems import STRICT, Place, Problems

_log = logging.getLogger(__name__)

MAX_SCENE_BYTES: Final = 128_000_000
"""Largest JSON file of a scene: 40,000 images with ten objects each."""

IMAGE_FOLDERS: Final = ("rgb", "gray")
IMAGE_SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
DEPTH_SUFFIXES: Final = (".png", ".tif", ".tiff")


class SceneRecords(NamedTuple):
    """The content of a scene's JSON files, by image.

    ``infos`` has one record for each of ``truths``, None where it is missing.
    """

    cameras: Mapping[int, object]
    truths: Mapping[int, list[bop.Record]]
    infos: Mapping[int, list[bop.Record | None]]


def read_records(folder: Path, problems: Problems = STRICT) -> SceneRecords:
    """Read a scene's JSON files; the two with ground truth may be missing."""
    camera, gt, gt_info = (
        Place(problems, folder / f"scene_{name}.json") for name in ("camera", "gt", "gt_info")
    )
    cameras = _by_image(camera)
    truths, infos = (_by_image(p) if Path(p.path).exists() else {} for p in (gt, gt_info))
    objects = {image: gt[f"{image}"].entries(rows) for image, rows in truths.items()}
    paired: dict[int, list[bop.Record | None]] = {image: [] for image in infos.keys() - objects}
    for image, records in objects.items():
        paired[image] = bop.pair_infos(records, infos.get(image), gt_info[f"{image}"])
    return SceneRecords(cameras, objects, paired)


def _by_image(place: Place) -> dict[int, Any]:
    allowed = 'images by number: {"0": …, "1": …}'
    by_image: dict[int, Any] = {}
    for key, record in (place.load(allowed, MAX_SCENE_BYTES) or {}).items():
        if not bop.is_number(key):
            place[f"{key!r:.40}"].report("no image's number", allowed)
        elif int(key) in by_image:
            place[f"{key!r:.40}"].report(f"image {int(key)} twice", "each once")
        else:
            by_image[int(key)] = record
    return by_image


def image_files(
    scene: Path, folders: tuple[str, ...], suffixes: tuple[str, ...], problems: Problems = STRICT
) -> dict[int, Path]:
    """Return the images in the first existing one of some folders, by number."""
    folder = next((scene / name for name in folders if (scene / name).is_dir()), None)
    files: dict[int, Path] = {}
    for path in sorted(folder.iterdir()) if folder is not None else ():
        if not bop.is_number(path.stem) or path.suffix.lower() not in suffixes:
            continue
        number = int(path.stem)
        if number in files:
            got = f"image {number} twice, also as {files[number].name}"
            problems.report(path, "file", got, "one file an image")
        else:
            files[number] = path
    return files


@dataclass(frozen=True)
class Scene:
    """A scene's images, in the order of their numbers.

    Attributes:
        files: File of every image, relative to the folder; empty where it is not on disk.
        depth_files: File of every depth image likewise.
        depth_scales: Millimetres a unit of its depth image; NaN where not stated.
        first: Objects ``first[i] … first[i + 1] − 1`` are on image i.
        gt_ids: Each object's index in its image's list, which names its masks.
        num_other: Number of other parts' objects that have a model.
        without_model: Numbers of objects without a model, by object number.
        num_behind: Number of objects behind the camera, which are left out like the others.
    """

    folder: Path
    image_ids: Int[np.ndarray, " images"]
    files: list[str]
    depth_files: list[str]
    K: Float[np.ndarray, "images 3 3"]
    depth_scales: Float[np.ndarray, " images"]
    first: Int[np.ndarray, " bounds"]
    gt_ids: Int[np.ndarray, " objects"]
    poses: bop.BopPoses
    num_other: int
    without_model: Counter[int]
    num_behind: int

    def objects(self, row: int) -> slice:
        """Return the slice of the objects on an image."""
        return slice(int(self.first[row]), int(self.first[row + 1]))


def read_scene(folder: Path, wanted: Collection[int], with_model: Collection[int] = ()) -> Scene:
    """Read a scene's annotation: ``scene_camera.json`` and, if present, its ground truth.

    ``wanted`` are the numbers of the objects to keep, ``with_model`` those of the objects with a
    model, empty where the data set has no models.
    """
    cameras, truths, infos = read_records(folder)
    images = sorted(cameras)
    if without := truths.keys() - cameras.keys():
        got = f"{len(without)} images have ground truth and no camera, and are left out"
        _log.warning("%s: %s; first: %d", folder, got, min(without))
    owners = [(row, n) for row, i in enumerate(images) for n in range(len(truths.get(i, ())))]

    def places(what: str, number: int) -> Place:
        place = Place(STRICT, folder / f"scene_{what}.json")
        if what == "camera":
            return place[f"{images[number]}"]
        row, n = owners[number]
        return place[f"{images[row]}"][n]

    K, scales = bop.read_cameras([cameras[i] for i in images], places)
    poses = bop.read_poses(
        [truths[images[row]][n] for row, n in owners],
        [infos[images[row]][n] for row, n in owners],
        places,
    )
    table = np.array(owners, np.int64).reshape(-1, 2)
    is_wanted = np.isin(poses.obj_ids, sorted(wanted))
    is_behind = poses.T_cam_obj[:, 2, 3] <= 0
    keep = is_wanted & ~is_behind
    without_model = poses.of(~is_wanted).without_model(with_model)
    return Scene(
        folder,
        np.array(images, np.int64),
        _relative_files(folder, IMAGE_FOLDERS, IMAGE_SUFFIXES, images),
        _relative_files(folder, ("depth",), DEPTH_SUFFIXES, images),
        K,
        scales,
        np.searchsorted(table[keep, 0], np.arange(len(images) + 1)),
        table[keep, 1],
        poses.of(keep),
        int((~is_wanted).sum()) - without_model.total(),
        without_model,
        int((is_wanted & is_behind).sum()),
    )


def _relative_files(
    folder: Path, folders: tuple[str, ...], suffixes: tuple[str, ...], images: Sequence[int]
) -> list[str]:
    """Return the file of every image, relative to the scene; empty where there is none."""
    files = image_files(folder, folders, suffixes)
    return [files[i].relative_to(folder).as_posix() if i in files else "" for i in images]
