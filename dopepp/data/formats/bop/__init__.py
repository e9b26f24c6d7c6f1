"""Read BOP's annotations into arrays: cameras, poses and visible fractions, in metres.

A scene's ``scene_*.json`` (by image) and a shard's ``KEY.*.json`` hold the same records. A wrong
record is reported and leaves NaN in the arrays.
"""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int

from dopepp.data.formats.invariants import rotation_problem
from dopepp.data.formats.problems import FARTHEST, STRICT, Node, Problems, mapping
from dopepp.geometry.rotation import nearest_rotation

_log = logging.getLogger(__name__)

MM: Final = 1000.0  # millimetres per metre
EXACT: Final = 1e-3  # largest deviation of R·Rᵀ from the identity that is kept unchanged
INEXACT: Final = 1e-2
"""Largest deviation at which the nearest rotation replaces a matrix; LM-O has up to 2e-3."""

_ROUNDING: Final = 1e-3  # by which a visible fraction may lie outside [0, 1]
MAX_SCENE_BYTES: Final = 128_000_000
"""Largest JSON file of a scene: 40,000 images with ten objects each."""

Kind = tuple[tuple[str, ...], tuple[str, ...]]
IMAGES: Final[Kind] = ("rgb", "gray"), (".png", ".jpg", ".jpeg", ".tif", ".tiff")
DEPTHS: Final[Kind] = ("depth",), (".png", ".tif", ".tiff")
"""Alternative folders, of which the first existing is used, and suffixes of a scene's images."""

Record = Mapping[str, Any]

Nodes = Callable[[str, int], Node]
"""Maps ``camera``, ``gt`` or ``gt_info`` and a record's number to the record's node."""


@dataclass(frozen=True)
class BopPoses:
    """The posed objects of one or more images.

    Attributes:
        obj_ids: BOP object IDs; −1 if damaged.
        T_cam_obj: Rigid transforms, metres; NaN if damaged.
        visible_fractions: Annotated ``visib_fract``; NaN if missing.
        inexact: Whether the nearest rotation replaces the annotated matrix (``INEXACT``).
    """

    obj_ids: Int[np.ndarray, " objects"]
    T_cam_obj: Float[np.ndarray, "objects 4 4"]
    visible_fractions: Float[np.ndarray, " objects"]
    inexact: Bool[np.ndarray, " objects"]

    def select(self, selected: Bool[np.ndarray, " objects"] | slice) -> BopPoses:
        """Return the selected objects."""
        return BopPoses(*(values[selected] for values in vars(self).values()))

    def without_model(self, models: Collection[int]) -> Counter[int]:
        """Count the objects whose number is not in ``models``; 0 if ``models`` is empty."""
        ids = self.obj_ids[self.obj_ids >= 0].tolist()
        return Counter(number for number in ids if models and number not in models)


def read_cameras(
    records: Sequence[object], nodes: Nodes
) -> tuple[Float[np.ndarray, "images 3 3"], Float[np.ndarray, " images"]]:
    """Return each image's K in pixels and ``depth_scale`` in mm per unit (NaN if not stated)."""
    node = partial(nodes, "camera")
    K = _column(records, "cam_K", 9, node).reshape(-1, 3, 3)
    scales = _optional_column(records, "depth_scale", node)
    for number in np.flatnonzero(scales <= 0).tolist():
        node(number)["depth_scale"].report(f"{scales[number]:g}", "millimetres above 0")
    return K, scales


def pair_infos(truths: Sequence[Record], entry: object, node: Node) -> list[Record | None]:
    """Return each object's ``gt_info`` record of an image's ``entry`` at ``node``; None if missing.

    An entry of null or an empty list counts as missing.
    """
    if entry is None or entry == []:
        return [None] * len(truths)
    if isinstance(entry, list):
        entry = [{} if info is None else info for info in entry]
    infos = node.entries(entry)
    if len(infos) != len(truths):
        node.report(f"{len(infos)} objects", f"{len(truths)}, the number of poses")
    return [*infos[: len(truths)], *[None] * (len(truths) - len(infos))]


def read_poses(truths: Sequence[Record], infos: Sequence[Record | None], nodes: Nodes) -> BopPoses:
    """Return the objects of ``gt`` and ``gt_info`` records; report wrong values and make them NaN.

    A truth has ``cam_R_m2c`` (row by row), ``cam_t_m2c`` (mm) and ``obj_id``; an info may have
    ``visib_fract``.
    """
    node, info_node = partial(nodes, "gt"), partial(nodes, "gt_info")
    rotations = _column(truths, "cam_R_m2c", 9, node).reshape(-1, 3, 3)
    errors = _orthogonality(rotations)
    inexact = (errors > EXACT) & (errors <= INEXACT)
    rotations[inexact] = nearest_rotation(rotations[inexact])
    poses = np.tile(np.eye(4), (len(truths), 1, 1))
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = _column(truths, "cam_t_m2c", 3, node) / MM
    ids = _column(truths, "obj_id", 1, node)[:, 0]
    for number in np.flatnonzero(~(errors <= INEXACT)).tolist():
        if problem := rotation_problem(rotations[number], INEXACT):
            node(number)["cam_R_m2c"].report(problem, "a rotation matrix, row by row")
        poses[number, :3, :3] = math.nan
    for number in np.flatnonzero((ids % 1 != 0) | (ids < 0)).tolist():
        if math.isfinite(ids[number]):
            node(number)["obj_id"].report(f"{ids[number]:g}", "an object's number")
        ids[number] = -1
    fractions = _optional_column(infos, "visib_fract", info_node)
    for number in np.flatnonzero((fractions < -_ROUNDING) | (fractions > 1 + _ROUNDING)).tolist():
        info_node(number)["visib_fract"].report(f"{fractions[number]:.6g}", "0 – 1")
        fractions[number] = math.nan
    return BopPoses(ids.astype(np.int64), poses, np.clip(fractions, 0.0, 1.0), inexact)


def _optional_column(
    records: Sequence[object], field: str, node: Callable[[int], Node]
) -> Float[np.ndarray, " records"]:
    """Return the number in a field of each record, or NaN for records without the field."""
    indices = [n for n, record in enumerate(records) if field in mapping(record)]
    values = np.full(len(records), math.nan)
    rows = [records[n] for n in indices]
    values[indices] = _column(rows, field, 1, lambda n: node(indices[n]))[:, 0]
    return values


def _column(
    records: Sequence[object], field: str, count: int, node: Callable[[int], Node]
) -> Float[np.ndarray, "records count"]:
    """Return ``count`` numbers in a field of each record; report wrong fields and make them NaN."""
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
    return np.array([node(n)[field].numbers(value, count) for n, value in enumerate(rows)])


def _orthogonality(matrices: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    """Return each matrix's deviation of R·Rᵀ from the identity; infinite for a reflection."""
    with np.errstate(invalid="ignore", over="ignore"):
        error = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        return np.where(np.linalg.det(matrices) < 0, np.inf, error)


def is_number(text: str) -> bool:
    """Return whether a text is a number of an image, object or scene: 1 to 9 ASCII digits."""
    return text.isascii() and text.isdecimal() and len(text) < 10


SceneRecords = tuple[
    Mapping[int, object], Mapping[int, list[Record]], Mapping[int, list[Record | None]]
]
"""Cameras, truths and infos by image; the infos have an entry for each truth, or None."""


def read_records(folder: Path, problems: Problems = STRICT) -> SceneRecords:
    """Read a scene's JSON files; ``scene_gt`` and ``scene_gt_info`` may be missing."""
    camera, gt, gt_info = (
        Node(problems, folder / f"scene_{name}.json") for name in ("camera", "gt", "gt_info")
    )
    cameras = _by_image(camera)
    truths, infos = (_by_image(p) if Path(p.path).exists() else {} for p in (gt, gt_info))
    objects = {image: gt[f"{image}"].entries(rows) for image, rows in truths.items()}
    # Images that only scene_gt_info lists have no objects.
    paired: dict[int, list[Record | None]] = {image: [] for image in infos.keys() - objects}
    for image, records in objects.items():
        paired[image] = pair_infos(records, infos.get(image), gt_info[f"{image}"])
    return cameras, objects, paired


def _by_image(node: Node) -> dict[int, Any]:
    """Read a JSON file whose keys are image numbers; report other keys and repeated numbers."""
    allowed = 'images by number: {"0": …, "1": …}'
    by_image: dict[int, Any] = {}
    for key, record in (node.load(allowed, MAX_SCENE_BYTES) or {}).items():
        if not is_number(key):
            node[f"{key!r:.40}"].report("not an image number", allowed)
        elif int(key) in by_image:
            node[f"{key!r:.40}"].report(f"image {int(key)} twice", "each image once")
        else:
            by_image[int(key)] = record
    return by_image


def image_files(scene: Path, kind: Kind, problems: Problems = STRICT) -> dict[int, Path]:
    """Return a scene's colour (:data:`IMAGES`) or depth files by number; report repeated ones."""
    folders, suffixes = kind
    folder = next((scene / name for name in folders if (scene / name).is_dir()), None)
    files: dict[int, Path] = {}
    for path in sorted(folder.iterdir()) if folder is not None else ():
        if not is_number(path.stem) or path.suffix.lower() not in suffixes:
            continue
        number = int(path.stem)
        if number in files:
            problem = f"image {number} twice, also as {files[number].name}"
            problems.report(path, "file", problem, "one file per image")
        else:
            files[number] = path
    return files


@dataclass(frozen=True)
class BopImage:
    """An image and its objects.

    Attributes:
        number: Number of the image in its scene.
        file: The colour image; None if it is missing.
        depth_file: The depth image, which may be missing; None in a scene without depth images.
        depth_scale: Millimetres per unit of the depth image; NaN if not stated.
        gt_ids: Each object's index in the image's list, which names its masks.
    """

    scene: Path
    number: int
    file: Path | None
    depth_file: Path | None
    K: Float[np.ndarray, "3 3"]
    depth_scale: float
    gt_ids: Int[np.ndarray, " objects"]
    poses: BopPoses

    def select(self, is_selected: Bool[np.ndarray, " objects"]) -> BopImage:
        """Return the image with only some of its objects."""
        return replace(self, gt_ids=self.gt_ids[is_selected], poses=self.poses.select(is_selected))


def read_scene(folder: Path) -> list[BopImage]:
    """Read the annotation of a scene's images: ``scene_camera.json`` and, if present, the truth."""
    cameras, truths, infos = read_records(folder)
    numbers = sorted(cameras)
    if without_camera := truths.keys() - cameras.keys():
        problem = f"ignoring {len(without_camera)} images with ground truth but without a camera"
        _log.warning("%s: %s; first: %d", folder, problem, min(without_camera))
    owners = [(i, n) for i in numbers for n in range(len(truths.get(i, ())))]

    def nodes(record_kind: str, number: int) -> Node:
        node = Node(STRICT, folder / f"scene_{record_kind}.json")
        if record_kind == "camera":
            return node[f"{numbers[number]}"]
        image, n = owners[number]
        return node[f"{image}"][n]

    K, scales = read_cameras([cameras[i] for i in numbers], nodes)
    poses = read_poses([truths[i][n] for i, n in owners], [infos[i][n] for i, n in owners], nodes)
    files, depth_files = image_files(folder, IMAGES), image_files(folder, DEPTHS)
    images, first = [], 0
    for row, number in enumerate(numbers):
        last = first + len(truths.get(number, ()))
        expected = folder / "depth" / f"{number:06d}.png"
        depth_file = depth_files.get(number, expected) if depth_files else None
        objects, gt_ids = poses.select(slice(first, last)), np.arange(last - first)
        scale, file = float(scales[row]), files.get(number)
        images.append(BopImage(folder, number, file, depth_file, K[row], scale, gt_ids, objects))
        first = last
    return images
