"""BOP's annotations as checked arrays: camera, poses, visible fractions; millimetres to metres.

The same records stand in ``scene_*.json`` (by image) and in a shard's ``KEY.*.json``. What is wrong
with one goes to the :class:`~dopepp.data.formats.problems.Problems` and leaves NaN in the arrays.
"""

from __future__ import annotations

import logging
import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from dopepp.data.formats.problems import FARTHEST, STRICT, Place, Problems, mapping
from dopepp.data.formats.tolerances import rotation_problem
from dopepp.data.sample import Instance, hull_areas
from dopepp.drawing.pictures import Mask, Shape
from dopepp.geometry.camera import CameraMatrix, Transform, project, project_keypoints, transform
from dopepp.geometry.rotation import nearest_rotation
from dopepp.parts.part import Part

_log = logging.getLogger(__name__)

MAX_SCENE_BYTES: Final = 128_000_000
"""Of one JSON file: 40,000 images with ten objects each."""

IMAGE_FOLDERS: Final = ("rgb", "gray")
IMAGE_SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
DEPTH_SUFFIXES: Final = (".png", ".tif", ".tiff")

MM: Final = 1000.0
"""Millimetres per metre."""

_NUMBERED: Final = re.compile(r"obj_(\d{1,9})")

EXACT: Final = 1e-3
INEXACT: Final = 1e-2
"""How far R·Rᵀ may be from the identity: taken as it is, and as the nearest rotation. (105 of the
first 805 poses of LM-O, as published, are off by up to 2e-3.)"""

_ROUNDING: Final = 1e-3
"""By which a visible fraction may leave [0, 1]."""

ESTIMATED: Final = (
    "estimated: mask pixels, or without a mask those inside the image, over the hull of the points"
)
"""How :func:`make_instance` gets a visible fraction that the annotation does not state."""

Record = Mapping[str, Any]

Places = Callable[[str, int], Place]
"""From ``camera``, ``gt`` or ``gt_info`` and a record's number to where it stands."""


@dataclass(frozen=True)
class BopPoses:
    """The posed objects of one or more images.

    Attributes:
        obj_ids: BOP's object numbers; −1 where damaged.
        T_cam_obj: Rigid transforms, metres; with NaN where damaged.
        visible_fractions: As stated, NaN where they are not.
        inexact: Whether the stated matrix is a rotation to a hundredth only, and T_cam_obj has the
            nearest one.
    """

    obj_ids: Int[np.ndarray, " objects"]
    T_cam_obj: Float[np.ndarray, "objects 4 4"]
    visible_fractions: Float[np.ndarray, " objects"]
    inexact: Bool[np.ndarray, " objects"]

    def of(self, chosen: Bool[np.ndarray, " objects"]) -> BopPoses:
        """Return some of the objects."""
        return BopPoses(
            self.obj_ids[chosen],
            self.T_cam_obj[chosen],
            self.visible_fractions[chosen],
            self.inexact[chosen],
        )


def read_cameras(
    records: Sequence[object], places: Places
) -> tuple[Float[np.ndarray, "images 3 3"], Float[np.ndarray, " images"]]:
    """Return every image's K in pixels and its ``depth_scale`` (mm a unit; NaN where not stated).

    A record that is no camera, and a scale that is not above 0, is a problem.
    """
    place = partial(places, "camera")
    K = _column(records, "cam_K", 9, place).reshape(-1, 3, 3)
    stated = [n for n, record in enumerate(records) if "depth_scale" in mapping(record)]
    scales = _stated_column(records, stated, "depth_scale", place)
    for number in np.flatnonzero(scales <= 0).tolist():
        place(number)["depth_scale"].report(f"{scales[number]:g}", "millimetres above 0")
    return K, scales


def pair_infos(truths: Sequence[Record], stated: object, place: Place) -> list[Record | None]:
    """Return one ``gt_info`` record for each of an image's objects, None where there is none.

    ``stated`` is what its entry holds; null and an empty list state nothing, null in a list nothing
    of one object.
    """
    if stated is None or stated == []:
        return [None] * len(truths)
    if isinstance(stated, list):
        stated = [{} if one is None else one for one in stated]
    infos = place.entries(stated)
    if len(infos) != len(truths):
        place.report(f"{len(infos)} objects", f"{len(truths)}, as many as have a pose")
    return [*infos[: len(truths)], *[None] * (len(truths) - len(infos))]


def read_poses(
    truths: Sequence[Record], infos: Sequence[Record | None], places: Places
) -> BopPoses:
    """Return the objects of ``gt`` and ``gt_info`` records.

    A field that is missing or of another shape, a matrix that is no rotation within a hundredth,
    and a fraction that is not in [0, 1] is a problem.

    ``truths`` have ``cam_R_m2c`` (row by row), ``cam_t_m2c`` (mm) and ``obj_id``; ``infos``, one
    for each of them or None, may have ``visib_fract``.
    """
    place, info_place = partial(places, "gt"), partial(places, "gt_info")
    rotations = _column(truths, "cam_R_m2c", 9, place).reshape(-1, 3, 3)
    errors = _orthogonality(rotations)
    inexact = (errors > EXACT) & (errors <= INEXACT)
    rotations[inexact] = nearest_rotation(rotations[inexact])
    poses = np.tile(np.eye(4), (len(truths), 1, 1))
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = _column(truths, "cam_t_m2c", 3, place) / MM
    ids = _column(truths, "obj_id", 1, place)[:, 0]
    for number in np.flatnonzero(~(errors <= INEXACT)).tolist():
        if problem := rotation_problem(rotations[number], INEXACT):
            place(number)["cam_R_m2c"].report(problem, "a rotation matrix, row by row")
        poses[number, :3, :3] = math.nan
    for number in np.flatnonzero((ids % 1 != 0) | (ids < 0)).tolist():
        if math.isfinite(ids[number]):
            place(number)["obj_id"].report(f"{ids[number]:g}", "an object's number")
        ids[number] = -1
    stated = [n for n, info in enumerate(infos) if "visib_fract" in mapping(info)]
    fractions = _stated_column(infos, stated, "visib_fract", info_place)
    for number in np.flatnonzero((fractions < -_ROUNDING) | (fractions > 1 + _ROUNDING)).tolist():
        info_place(number)["visib_fract"].report(f"{fractions[number]:.6g}", "0 – 1")
        fractions[number] = math.nan
    fractions = np.clip(fractions, 0.0, 1.0)
    return BopPoses(ids.astype(np.int64), poses, fractions, inexact)


def make_instance(
    part: Part,
    T_cam_obj: Transform,
    K: CameraMatrix,
    visible_fraction: float,
    mask: Mask | None,
    shape: Shape,
) -> Instance:
    """Return an annotated object as an instance.

    A fraction that is not stated (NaN) is estimated: mask pixels or, without a mask, the hull's
    area inside the image, over the area of the convex hull of the projected ADD points. For a
    concave object that comes out too small.
    """
    if math.isnan(visible_fraction):
        inside, whole = hull_areas(project(transform(T_cam_obj, part.points), K), shape)
        visible = inside if mask is None else float(np.count_nonzero(mask))
        visible_fraction = min(1.0, visible / whole) if whole > 0 else 0.0
    keypoints = project_keypoints(part.cuboid, T_cam_obj, K)
    return Instance(part.name, T_cam_obj, keypoints, visible_fraction, mask)


def _stated_column(
    records: Sequence[object], stated: list[int], field: str, place: Callable[[int], Place]
) -> Float[np.ndarray, " records"]:
    """Return a number of the records that state it, NaN of the others."""
    values = np.full(len(records), math.nan)
    some = [records[n] for n in stated]
    values[stated] = _column(some, field, 1, lambda n: place(stated[n]))[:, 0]
    return values


def _column(
    records: Sequence[object], field: str, count: int, place: Callable[[int], Place]
) -> Float[np.ndarray, "records count"]:
    """Return a field of all records; one by one only to find those that are wrong."""
    # Nested lists of the right size, ``[[…], […], […]]`` for a matrix, are taken as other tools do.
    if not records:
        return np.empty((0, count))
    try:
        values = np.array([record[field] for record in records])  # type: ignore[index]
        table = values.reshape(len(records), -1)
    except (IndexError, KeyError, TypeError, ValueError):
        table = np.empty((0, 0), object)
    if table.shape == (len(records), count) and table.dtype.kind in "iuf":
        table = table.astype(np.float64)
        if (np.abs(table) <= FARTHEST).all():
            return table
    rows = [mapping(record).get(field) for record in records]
    return np.array([place(n)[field].numbers(value, count) for n, value in enumerate(rows)])


def _orthogonality(matrices: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    """Return how far R·Rᵀ is from the identity; infinite for a mirror image, NaN for NaN."""
    with np.errstate(invalid="ignore", over="ignore"):
        error = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        return np.where(np.linalg.det(matrices) < 0, np.inf, error)


class SceneRecords(NamedTuple):
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
        depth_files: File of every depth image likewise.
        depth_scales: Millimetres a unit of its depth image; NaN where not stated.
        first: Objects ``first[i] … first[i + 1] − 1`` are on image i.
        gt_ids: Each object's place in its image's list, which names its masks.
        num_other: Objects that are not of interest and have a model.
        without_model: How many objects of each number, not of interest, have no model.
        num_behind: Objects of interest behind the camera, left out like the others.
    """

    folder: Path
    image_ids: Int[np.ndarray, " images"]
    files: list[str]
    depth_files: list[str]
    K: Float[np.ndarray, "images 3 3"]
    depth_scales: Float[np.ndarray, " images"]
    first: Int[np.ndarray, " bounds"]
    gt_ids: Int[np.ndarray, " objects"]
    poses: BopPoses
    num_other: int
    without_model: Counter[int]
    num_behind: int

    def objects(self, image: int) -> range:
        """Return which objects are on an image."""
        return range(int(self.first[image]), int(self.first[image + 1]))


def scene_folders(split_dir: Path) -> list[Path]:
    """Return a split's scenes by number: the folders that are called by one."""
    numbered = [path for path in split_dir.iterdir() if is_number(path.name) and path.is_dir()]
    return sorted(numbered, key=lambda path: (int(path.name), path.name))


def read_scene(folder: Path, wanted: set[int], modelled: Collection[int] = ()) -> SceneFolder:
    """Read a scene's annotation: ``scene_camera.json`` and, if there, its ground truth's files.

    Objects that are not ``wanted`` are left out; ``modelled`` are those with a model, empty where
    the data set has none. Some data sets keep their ground truth private.
    """
    cameras, truths, infos = read_records(folder)
    images = sorted(cameras)
    if without := truths.keys() - cameras.keys():
        _log.warning(
            "%s: %d images have ground truth and no camera, and are left out; first: %d",
            folder, len(without), min(without),
        )  # fmt: skip
    owners = [(row, n) for row, i in enumerate(images) for n in range(len(truths.get(i, ())))]

    def places(what: str, number: int) -> Place:
        place = Place(STRICT, folder / f"scene_{what}.json")
        if what == "camera":
            return place[f"{images[number]}"]
        row, n = owners[number]
        return place[f"{images[row]}"][n]

    K, scales = read_cameras([cameras[i] for i in images], places)
    poses = read_poses(
        [truths[images[row]][n] for row, n in owners],
        [infos[images[row]][n] for row, n in owners],
        places,
    )
    table = np.array(owners, np.int64).reshape(-1, 2)
    is_wanted = np.isin(poses.obj_ids, sorted(wanted))
    is_behind = poses.T_cam_obj[:, 2, 3] <= 0
    keep = is_wanted & ~is_behind
    without_model = objects_without_model(poses.of(~is_wanted), modelled)
    return SceneFolder(
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


def objects_without_model(poses: BopPoses, modelled: Collection[int]) -> Counter[int]:
    """Count annotated objects, by number, that have no model; none where no object has."""
    ids = poses.obj_ids[poses.obj_ids >= 0]
    return Counter(int(one) for one in ids if modelled and int(one) not in modelled)


def read_records(folder: Path, problems: Problems = STRICT) -> SceneRecords:
    """Read a scene's JSON files; the two with ground truth may be missing."""
    camera, gt, gt_info = (
        Place(problems, folder / f"scene_{name}.json") for name in ("camera", "gt", "gt_info")
    )
    cameras, truths, infos = _by_image(camera), _if_there(gt), _if_there(gt_info)
    objects = {image: gt[f"{image}"].entries(rows) for image, rows in truths.items()}
    paired: dict[int, list[Record | None]] = {image: [] for image in infos.keys() - objects.keys()}
    for image, records in objects.items():
        paired[image] = pair_infos(records, infos.get(image), gt_info[f"{image}"])
    return SceneRecords(cameras, objects, paired)


def _if_there(place: Place) -> dict[int, Any]:
    """Return each image's entry; nothing where there is no such file."""
    return _by_image(place) if Path(place.path).exists() else {}


def _by_image(place: Place) -> dict[int, Any]:
    allowed = 'images by number: {"0": …, "1": …}'
    by_image: dict[int, Any] = {}
    for key, record in (place.load(allowed, MAX_SCENE_BYTES) or {}).items():
        if not is_number(key):
            place[f"{key!r:.40}"].report("no image's number", allowed)
        elif int(key) in by_image:
            place[f"{key!r:.40}"].report(f"image {int(key)} twice", "each once")
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


def number_in_name(name: str) -> int | None:
    """Return the number in a name as BOP's files have it, ``obj_000005``; None in any other."""
    numbered = _NUMBERED.fullmatch(name)
    return int(numbered[1]) if numbered else None


def model_numbers(names: Sequence[str]) -> dict[str, int]:
    """Return the number of each object by name: 1, 2, … unless all are called as BOP's files are.

    A data set that is rendered of another one's models goes on with that one's numbers.
    """
    stated = {name: number_in_name(name) for name in names}
    numbers = {name: number for name, number in stated.items() if number}
    if len(set(numbers.values())) == len(names):
        return numbers
    return {name: number for number, name in enumerate(names, start=1)}


def is_number(text: str) -> bool:
    """Tell whether a key or a name is an image's, an object's or a scene's number."""
    return text.isascii() and text.isdecimal() and len(text) < 10
