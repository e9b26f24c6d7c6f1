"""Check that the records, models, masks and images of a BOP data set agree.

The reader parses the records, and its problems are defects. Optional files (depth, masks) must
exist for every image of a scene or for none. Deviations that every reader handles are notes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from dopepp.data.formats import STAGING, bop, staged_items
from dopepp.data.formats.bop import MM, BopPoses, Nodes, Record
from dopepp.data.formats.bop.bop_models import (
    INFO_FILE,
    info_path,
    objects_with_model,
    parse_models,
    read_part,
)
from dopepp.data.formats.images import COLOUR_MODES, DEPTH_MODES, decode_one_channel, image_shape
from dopepp.data.formats.invariants import Box, check_box, check_translation, plausible_camera
from dopepp.data.formats.problems import CheckReport, Node, mapping
from dopepp.drawing.pictures import Mask, Shape
from dopepp.geometry.camera import CameraMatrix, transform
from dopepp.geometry.cuboid import cuboid_keypoints

DIAMETERS_MM: Final = (5.0, 5000.0)
FRACTION_TOLERANCE: Final = 0.05  # difference of visib_fract from the quotient of the pixel counts
PIXEL_TOLERANCE: Final = 0.01
"""Allowed difference of ``px_count_visib`` from a mask's pixels, a share (plus a border row)."""

BOX_EDGE_PX: Final = 2.0
"""Allowed distance of ``bbox_visib`` from the mask's box: some tools exclude the last pixel."""

_ROUNDING: Final = 1.001  # factor between a diameter and its box, rounded to a few digits
_CAMERA, _TRUTH, _INFO = "scene_camera.json", "scene_gt.json", "scene_gt_info.json"
_MASKS: Final = ("mask", "mask_visib")

ReadMask = Callable[[str, int], Mask | None]
"""Reads the ``mask`` or ``mask_visib`` of an object by number; None without a readable mask."""


def scene_folders(root: Path) -> Iterator[Path]:
    """Yield in order the scenes of a data set or split, or ``root`` itself if it is a scene."""
    if _is_scene(root):
        yield root
        return
    for folder in sorted(path for path in root.glob("*") if path.is_dir()):
        if _is_scene(folder):
            yield folder
        elif not folder.name.startswith("."):
            yield from sorted(path for path in folder.glob("*") if _is_scene(path))


def _is_scene(folder: Path) -> bool:
    named = folder.name.isdecimal() and (folder / "rgb").is_dir()
    return named or any((folder / name).is_file() for name in (_CAMERA, _TRUTH, _INFO))


def check_bop(report: CheckReport) -> None:
    """Check the models and every scene of a data set, a split, or a single scene."""
    # The models lie next to the splits: in this folder, or above this split or scene.
    models = load_models(report, (report.root, *report.root.resolve().parents[:2]))
    for folder in scene_folders(report.root):
        if folder != report.root and not bop.is_number(folder.name):
            report.report(folder, "name", "not a scene number", "000000, 000001, …")
        _SceneCheck(report, folder, models).check()


class _SceneCheck:
    """Check of a scene's JSON files and of its images and masks."""

    def __init__(self, report: CheckReport, folder: Path, models: ModelSizes | None) -> None:
        self._report, self._folder, self._models = report, folder, models
        self._images, self._depths = map(self._image_files, (bop.IMAGES, bop.DEPTHS))
        self._masks = {name: _mask_files(folder / name) for name in _MASKS}
        self._records = bop.read_records(folder, report)
        self._has_truth = (folder / _TRUTH).is_file()

    def _image_files(self, kind: bop.Kind) -> dict[int, Path]:
        """Return colour or depth images by number; report images without a numeric name."""
        files = bop.image_files(self._folder, kind, self._report)
        for folder in {path.parent for path in files.values()}:
            for path in sorted(folder.glob("[!.]*")):
                if path.suffix.lower() in kind[1] and not bop.is_number(path.stem):
                    self._report.report(path, "file", "not an image number")
        return files

    def check(self) -> None:
        report, folder, (cameras, truths, infos) = self._report, self._folder, self._records
        if not self._has_truth:
            if (folder / _INFO).is_file() or any(self._masks.values()):
                report.report(folder / _TRUTH, "file", "missing")
            else:
                report.note(f"{folder} has no {_TRUTH}: its poses are not published")
        deviations = Deviations()
        images = sorted(cameras.keys() | self._images.keys() | truths.keys())
        for image in images:
            # An unreadable file is a single defect, not a defect of every image.
            for by_image, name in ((cameras, _CAMERA), (truths, _TRUTH)):
                if by_image and image not in by_image:
                    report.report(folder / name, str(image), "missing")
            deviations.count(self._check_image(image), self._models)
            report.count_image()
        deviations.note(report, folder)
        for name, by_number in (("depth", self._depths), (_INFO, infos)):
            for image in sorted(by_number.keys() - set(images)):
                report.report(folder / name, str(image), "no such image in the scene")
        if staged := len(staged_items(folder / STAGING, ".json")):
            report.note(f"{folder}: {staged} images written and not yet finalized")

    def _check_image(self, image: int) -> BopPoses:
        report, folder, (cameras, truths, infos) = self._report, self._folder, self._records
        path = self._images.get(image, folder / "rgb" / f"{image:06d}.png")
        shape = image_shape(Node(report, path), modes=COLOUR_MODES)
        if self._depths:
            path = self._depths.get(image, folder / "depth" / f"{image:06d}.png")
            decode_one_channel(Node(report, path), shape, modes=DEPTH_MODES)
        objects = truths.get(image, [])
        masks = {name: by_image.get(image, {}) for name, by_image in self._masks.items()}
        for by_number in masks.values() if self._has_truth else ():
            for number in sorted(by_number.keys() - set(range(len(objects)))):
                report.report(by_number[number], "file", f"no object {number} on the image")

        def nodes(record_kind: str, number: int) -> Node:
            node = Node(report, folder / f"scene_{record_kind}.json")[f"{image}"]
            return node if record_kind == "camera" else node[number]

        def read_mask(name: str, number: int) -> Mask | None:
            if not self._masks[name]:
                return None
            path = masks[name].get(number, folder / name / f"{image:06d}_{number:06d}.png")
            mask = decode_one_channel(Node(report, path), shape)
            return None if mask is None else mask != 0

        infos_of_image = infos.get(image, [None] * len(objects))
        has_depth, camera = bool(self._depths), cameras.get(image)
        return check_image(
            nodes, camera, objects, infos_of_image, shape, has_depth, self._models, read_mask
        )


def _mask_files(folder: Path) -> dict[int, dict[int, Path]]:
    files: dict[int, dict[int, Path]] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        image, _, number = path.stem.partition("_")
        if image.isdecimal() and number.isdecimal():
            files.setdefault(int(image), {})[int(number)] = path
    return files


@dataclass
class Deviations:
    """Counts of deviations that every reader handles, so they are notes and not defects."""

    inexact: int = 0
    without_fraction: int = 0
    without_model: Counter[int] = field(default_factory=Counter)

    def count(self, poses: BopPoses, models: ModelSizes | None) -> None:
        """Count an image's deviations."""
        self.inexact += int(poses.inexact.sum())
        self.without_fraction += int(np.isnan(poses.visible_fractions).sum())
        self.without_model += poses.without_model(models or ())

    def note(self, report: CheckReport, where: Path | str) -> None:
        """Add a note to the report for each deviation and how readers handle it."""
        if self.inexact:
            message = f"{self.inexact:,} rotations are orthogonal to {bop.INEXACT:g} only"
            report.note(f"{where}: {message}; readers use the nearest rotation")
        if self.without_fraction:
            message = f"{self.without_fraction:,} objects without visib_fract"
            report.note(f"{where}: {message}; readers estimate the visible fractions")
        for number, count in sorted(self.without_model.items()):
            message = f"object {number} is annotated {count:,} times and has no model"
            report.note(f"{where}: {message}; readers ignore the object")


@dataclass(frozen=True)
class ModelSize:
    """Diameter and box corners (mesh frame), metres; None for a missing or damaged field."""

    diameter: float | None = None
    corners: Float[np.ndarray, "8 3"] | None = None


ModelSizes = dict[int, ModelSize]


def load_models(report: CheckReport, roots: Sequence[Path]) -> ModelSizes | None:
    """Check the first ``models*/models_info.json`` below one of the folders, and its meshes.

    Returns:
        Sizes of the objects with a mesh (of all if none has one); None without a readable file.
    """
    path = next(filter(None, map(info_path, roots)), None)
    if path is None:
        report.note(f"no {INFO_FILE}: objects' numbers, sizes and boxes are not checked")
        return None
    node = Node(report, path)
    records = node.load()
    if records is None:
        return None
    infos = parse_models(path, records, report)
    present = objects_with_model(infos)
    if absent := infos.keys() - present:
        numbers = ", ".join(map(str, sorted(absent)))
        report.note(f"{path.parent}: no file of object {numbers}, whose annotations are ignored")
    for number in sorted(present):
        Node(report, infos[number].path)["mesh"].attempt(partial(read_part, infos[number]))
    sizes = {
        int(key): _model(node[key], record, infos[int(key)].diameter)
        for key, record in records.items()
        if bop.is_number(key)
    }
    return {number: size for number, size in sizes.items() if number in present}


def _model(node: Node, record: object, stated: float) -> ModelSize:
    """Check a model's record with the ``stated`` diameter (metres, or NaN); return its size."""
    fields, diameter = mapping(record), None if np.isnan(stated) else stated
    if fields and "diameter" not in fields:
        node["diameter"].report("missing")
    if diameter is not None and not DIAMETERS_MM[0] <= diameter * MM <= DIAMETERS_MM[1]:
        least, most = DIAMETERS_MM
        allowed = f"{least:g} … {most:g} mm: is it in another unit?"
        node["unit"].report(f"{diameter * MM:.4g} mm", allowed)
        diameter = None
    bounds = [fields.get(f"{bound}_{axis}") for bound in ("min", "size") for axis in "xyz"]
    if all(value is None for value in bounds):
        return ModelSize(diameter)
    low, size = node["min_x … size_z"].numbers(bounds, 2, 3) / MM
    if (size < 0).any():
        node["size_x … size_z"].report(f"{(size * MM).tolist()}", "0 and above")
    if not (size >= 0).all():
        return ModelSize(diameter)
    length = float(np.linalg.norm(size))
    if diameter is not None and not size.max() / _ROUNDING <= diameter <= length * _ROUNDING:
        message = f"{diameter * MM:.5g} mm for a box of {np.round(size * MM, 3).tolist()} mm"
        node["diameter"].report(message)
    return ModelSize(diameter, cuboid_keypoints(low, low + size)[:8])


def check_image(
    nodes: Nodes,
    camera: object,
    truths: Sequence[Record],
    infos: Sequence[Record | None],
    shape: Shape | None,
    has_depth: bool,
    models: ModelSizes | None,
    read_mask: ReadMask,
) -> BopPoses:
    """Check camera, poses, boxes, counts and masks of one image; return the poses.

    ``camera`` is the image's record, or None if it is missing; ``shape`` is None for an unreadable
    image. With ``has_depth``, the camera must state the scale of a depth image.
    """
    K = None if camera is None else _check_camera(nodes, camera, shape, has_depth)
    poses = bop.read_poses(truths, infos, nodes)
    for n, info in enumerate(infos):
        node, T_cam_obj, stated = nodes("gt", n), poses.T_cam_obj[n], poses.visible_fractions[n]
        fraction = None if np.isnan(stated) else float(stated)
        model = (models or {}).get(int(poses.obj_ids[n]), ModelSize())
        is_posed = check_translation(node["cam_t_m2c"], T_cam_obj[:3, 3], model.diameter)
        whole, visible = read_mask("mask", n), read_mask("mask_visib", n)
        if whole is not None and visible is not None and whole.shape == visible.shape:
            outside = int(np.count_nonzero(visible & ~whole))
            if outside > PIXEL_TOLERANCE * visible.sum():
                node["mask_visib"].report(f"{outside} visible pixels outside the whole mask")
        visible_box = None if visible is None else Box.of_mask(visible)
        if info is not None:
            _check_counts(nodes("gt_info", n), info, visible, fraction)
            visible_box = _check_boxes(nodes("gt_info", n), info, visible_box)
        is_posed &= bool(np.isfinite(T_cam_obj).all())
        if is_posed and K is not None and model.corners is not None:
            check_box(node["box"], transform(T_cam_obj, model.corners), K, visible_box, fraction)
    return poses


def _check_camera(
    nodes: Nodes, camera: object, shape: Shape | None, has_depth: bool
) -> CameraMatrix | None:
    node = nodes("camera", 0)
    K: CameraMatrix = bop.read_cameras([camera], nodes)[0][0]
    if has_depth and "depth_scale" not in mapping(camera):
        node["depth_scale"].report("missing", "millimetres per unit of the depth")
    return plausible_camera(node["cam_K"], K, shape)


def _check_counts(
    node: Node, info: Mapping[str, Any], visible: Mask | None, fraction: float | None
) -> None:
    """Report pixel counts that contradict each other, the visible fraction or the mask."""
    total, count = (
        node[field].scalar(info[field]) if field in info else np.nan
        for field in ("px_count_all", "px_count_visib")
    )
    if count < 0 or count > total:
        node["px_count_visib"].report(f"{count:g} pixels, but px_count_all is {total:g}")
    elif fraction is not None and total > 0:
        slack = FRACTION_TOLERANCE + 1 / np.sqrt(total)
        if abs(count / total - fraction) > slack:
            message = f"{fraction:.3g}, but the pixel counts give {count / total:.3g}"
            node["visib_fract"].report(message)
    if visible is not None:
        pixels = int(np.count_nonzero(visible))
        if abs(pixels - count) > PIXEL_TOLERANCE * max(pixels, count) + np.sqrt(pixels):
            node["px_count_visib"].report(f"{count:g}, but mask_visib has {pixels} pixels")


def _check_boxes(node: Node, info: Mapping[str, Any], mask_box: Box | None) -> Box | None:
    """Report a ``bbox_visib`` unlike the mask's box; return the mask's box, or else the other."""
    boxes: dict[str, Box] = {}
    for field_name in ("bbox_visib", "bbox_obj"):
        if field_name in info:
            x, y, width, height = node[field_name].numbers(info[field_name], 4).tolist()
            if width >= 0 and height >= 0:  # −1 without a visible pixel
                boxes[field_name] = Box(x, y, x + width, y + height)
    box = boxes.get("bbox_visib")
    if mask_box is not None and box is not None:
        distance = max(abs(a - b) for a, b in zip(mask_box, box, strict=True))
        if distance > BOX_EDGE_PX:
            node["bbox_visib"].report(f"{box}, but mask_visib has {mask_box}")
    return mask_box or box
