"""Check YCB-Video's own layout: frames on disk, not those that a list names and nobody unpacked.

An object without a label pixel is no defect: some releases label only some objects.

Read what a YCB-Video ``meta.mat`` still holds, every pose by itself.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
import scipy.io
from numpy.typing import NDArray

from dopepp.core.errors import UserError
from dopepp.data.formats.problems import CheckReport, load_image, load_size, numbers
from dopepp.data.formats.tolerances import (
    Box,
    box_problem,
    camera_problem,
    rotation_problem,
    translation_problem,
)
from dopepp.data.formats.ycb_video.frame import (
    FOLDERS,
    Subset,
    read_classes,
    read_image_set,
    read_meta,
)
from dopepp.parts.mesh.measure import largest_distance

_FIELDS: Final = ("cls_indexes", "poses", "intrinsic_matrix", "factor_depth")
_MAX_META_BYTES: Final = 256_000_000


def load_meta(report: CheckReport, path: Path) -> Mapping[str, Any] | None:
    """Return the fields of a ``meta.mat``, None where there are none to look at."""
    if not path.is_file():
        report.add(path, "file", "missing")
        return None
    if path.stat().st_size > _MAX_META_BYTES:
        report.add(path, "file", f"{path.stat().st_size:,} bytes; at most {_MAX_META_BYTES:,}")
        return None
    try:
        fields = scipy.io.loadmat(path, variable_names=_FIELDS)
    except Exception as error:  # SciPy lets through whatever a damaged byte happens to cause
        report.add(path, "file", f"damaged ({error})")
        return None
    for name in ("cls_indexes", "poses", "factor_depth"):
        if name not in fields:
            report.add(path, name, "missing")
    try:
        read_meta(path)
    except UserError as error:
        if "cut short" in error.got:  # all else is a defect of its own below
            report.add(path, "file", error.got.removeprefix(f"{path}: "))
    return fields


def read_poses(
    report: CheckReport, path: Path, fields: Mapping[str, Any], classes: list[str]
) -> dict[int, tuple[str, NDArray[np.float64]]]:
    """Return (field, 3×4 pose) by class index."""
    if "cls_indexes" not in fields or "poses" not in fields:
        return {}
    indices = np.asarray(fields["cls_indexes"]).ravel()
    stack = np.asarray(fields["poses"])
    stack = stack[..., None] if stack.shape == (3, 4) else stack  # MATLAB drops a last axis of 1
    if stack.shape != (3, 4, len(indices)) or stack.dtype.kind not in "fiu":
        message = f"shape {stack.shape} for {len(indices)} classes; allowed: (3, 4, N)"
        report.add(path, "poses", message)
        return {}
    found: dict[int, tuple[str, NDArray[np.float64]]] = {}
    for number, index in enumerate(indices.tolist()):
        where = f"poses[{number}]"
        if index in found:
            report.add(path, f"cls_indexes[{number}]", f"class {index:g} twice")
            continue
        if not 1 <= index <= len(classes) or index != int(index):
            allowed = f"1 … {len(classes)}, the lines of classes.txt"
            report.add(path, f"cls_indexes[{number}]", f"unknown class {index:g}; {allowed}")
            continue
        pose = numbers(report, path, where, stack[..., number], 3, 4)
        found[int(index)] = (where, np.full((3, 4), np.nan) if pose is None else pose)
    return {index: entry for index, entry in found.items() if np.isfinite(entry[1]).all()}


_IMAGES: Final = ("color.png", "depth.png", "label.png")
_MAX_POINTS: Final = 100_000


def check_ycb(report: CheckReport) -> None:
    """Check the frames of ``data/`` and ``data_syn/``.

    Raises:
        UserError: The class list cannot be read.
    """
    classes = read_classes(report.root)
    if not classes or len(set(classes)) != len(classes):
        report.add(report.root / "image_sets" / "classes.txt", "names", "empty, or one name twice")
    _check_lists(report)
    models = _Models(report, classes)
    subsets: tuple[Subset, ...] = ("real", "synthetic")
    for subset in subsets:
        for start in _frames(report.root / FOLDERS[subset]):
            _check_frame(report, start, models)
            report.count_image()


def _check_lists(report: CheckReport) -> None:
    for path in sorted((report.root / "image_sets").glob("*.txt")):
        if path.stem == "classes":
            continue
        absent = 0
        for subset, folder in FOLDERS.items():
            try:
                listed = read_image_set(report.root, path.stem, subset)
            except UserError as error:
                report.add(path, "line", error.got.removeprefix(f"{path}: "))
                break
            places = (report.root / folder / f"{frame}-meta.mat" for frame in listed)
            absent += sum(not place.is_file() for place in places)
        if absent:
            report.note(f"{path.name} lists {absent:,} frames that are not on disk")


def _frames(folder: Path) -> Iterator[str]:
    """Yield the start of every frame's paths, ``…/000001``, also where files are missing."""
    scenes = [folder, *sorted(path for path in folder.glob("*") if path.is_dir())]
    for scene in scenes:
        names = {path.name.partition("-")[0] for path in scene.glob("*-*.*")}
        yield from (str(scene / name) for name in sorted(names) if name.isdigit())


class _Models:
    """The objects' names and points, read when they are first needed."""

    def __init__(self, report: CheckReport, classes: list[str]) -> None:
        self._report, self.classes = report, classes
        self.shape = cache(self._shape)

    def _shape(self, name: str) -> tuple[NDArray[np.float64], float] | None:
        """Return an object's points and diameter, metres; None where it has no points."""
        path = self._report.root / "models" / name / "points.xyz"
        if not path.is_file():
            self._report.note(f"models/{name}/points.xyz is missing: its boxes are not checked")
            return None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                points = np.loadtxt(path, max_rows=_MAX_POINTS, ndmin=2)
            if points.shape[1] != 3 or not np.isfinite(points).all():
                raise ValueError(f"shape {points.shape}, or not finite")
        except (ValueError, UserWarning) as error:
            self._report.add(path, "points", f"{error}; allowed: three finite numbers a line")
            return None
        return points, largest_distance(points)


def _check_frame(report: CheckReport, start: str, models: _Models) -> None:
    colour_path, depth_path, label_path = (Path(f"{start}-{name}") for name in _IMAGES)
    size = load_size(report, colour_path)
    load_image(report, depth_path, size)
    label = load_image(report, label_path, size)
    path = Path(f"{start}-meta.mat")
    fields = load_meta(report, path)
    if fields is None:
        return
    poses = read_poses(report, path, fields, models.classes)
    factor = numbers(report, path, "factor_depth", fields.get("factor_depth"), 1)
    if factor is not None and factor[0] <= 0:
        report.add(path, "factor_depth", f"{factor[0]:g}; allowed: above 0")
    K = fields.get("intrinsic_matrix")
    camera = None if K is None else numbers(report, path, "intrinsic_matrix", K, 3, 3)
    if camera is not None and size is not None:
        problem = camera_problem(camera, size)
        if problem is not None:
            report.add(path, "intrinsic_matrix", problem)
            camera = None
    _check_box_file(report, Path(f"{start}-box.txt"), models.classes, size)
    if label is not None:
        strangers = sorted(set(np.unique(label).tolist()) - {0, *poses})
        if strangers:
            report.add(label_path, "values", f"classes {strangers} without a pose in meta.mat")
    for index, (where, pose) in poses.items():
        _check_pose(report, path, where, pose, models, index, camera, label)


def _check_pose(
    report: CheckReport,
    path: Path,
    where: str,
    pose: NDArray[np.float64],
    models: _Models,
    index: int,
    K: NDArray[np.float64] | None,
    label: NDArray[Any] | None,
) -> None:
    problem = rotation_problem(pose[:, :3])
    if problem is not None:
        report.add(path, f"{where}.R", problem)
    known = 1 <= index <= len(models.classes)
    shape = models.shape(models.classes[index - 1]) if known else None
    place = translation_problem(pose[:, 3], None if shape is None else shape[1])
    if place is not None:
        report.add(path, f"{where}.{place[0]}", place[1])
    if problem or place or shape is None or K is None or label is None:
        return
    points = shape[0] @ pose[:, :3].T + pose[:, 3]
    problem = box_problem(points, K, Box.of_mask(label == index))
    if problem is not None:
        report.add(path, f"{where}.box", problem)


def _check_box_file(
    report: CheckReport, path: Path, classes: list[str], size: tuple[int, int] | None
) -> None:
    """Check ``box.txt``, where there is one: name, left, top, right and bottom a line."""
    if not path.is_file():
        return
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
        name, *values = line.split() or [""]
        if not name:
            continue
        try:
            left, top, right, bottom = map(float, values)
        except ValueError:
            report.add(path, f"line {number}", f"{line!r:.60}; allowed: a name and four numbers")
            continue
        if name not in classes:
            report.add(path, f"line {number}", f"unknown object {name!r:.60}")
        if not (left < right and top < bottom):
            report.add(path, f"line {number}", f"{line!r:.60}; left < right and top < bottom")
        elif size is not None and (left >= size[0] or top >= size[1] or right < 0 or bottom < 0):
            report.add(
                path, f"line {number}", f"{line!r:.60} outside the {size[0]}×{size[1]} image"
            )
