"""Check the frames of YCB-Video that are on disk; listed frames may be missing.

An object without a label pixel is not a defect: some releases label only some objects.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np

from dopepp.core.errors import UserError
from dopepp.data.formats import ycb_video
from dopepp.data.formats.invariants import Box, check_box, check_translation, plausible_camera
from dopepp.data.formats.problems import CheckReport, Node
from dopepp.data.formats.ycb_video import Subset
from dopepp.drawing.pictures import Shape
from dopepp.geometry.camera import transform
from dopepp.parts.mesh import Points, largest_distance
from dopepp.parts.mesh.read import read_points


def check_ycb(report: CheckReport) -> None:
    """Check the frames of ``data/`` and ``data_syn/``.

    Raises:
        UserError: The folder has no class list.
    """
    classes = ycb_video.read_classes(report.root)
    if not classes or len(set(classes)) != len(classes):
        path = report.root / "image_sets" / "classes.txt"
        report.report(path, "names", "empty, or one name twice")
    _check_lists(report)
    check = _FrameCheck(report, classes)
    for subset, folder in ycb_video.FOLDERS.items():
        for start in _frames(report.root / folder):
            check.check(start, subset)
            report.count_image()


def _check_lists(report: CheckReport) -> None:
    """Check the files in ``image_sets/``, and note frames that they list but the disk lacks."""
    for path in sorted((report.root / "image_sets").glob("*.txt")):
        if path.stem == "classes":
            continue
        num_absent = 0
        for subset, folder in ycb_video.FOLDERS.items():
            try:
                listed = ycb_video.read_image_set(report.root, path.stem, subset)
            except UserError as error:
                report.report_error(path, "line", error)
                break
            metas = (report.root / folder / f"{frame}-meta.mat" for frame in listed)
            num_absent += sum(not meta.is_file() for meta in metas)
        if num_absent:
            report.note(f"{path.name} lists {num_absent:,} frames that are not on disk")


def _frames(folder: Path) -> Iterator[str]:
    """Yield the start of each frame's paths, ``…/000001``, even if files are missing."""
    scenes = [folder, *sorted(path for path in folder.glob("*") if path.is_dir())]
    for scene in scenes:
        names = {path.name.partition("-")[0] for path in scene.glob("*-*.*")}
        yield from (str(scene / name) for name in sorted(names) if name.isdigit())


class _FrameCheck:
    """Check of frames, which reads an object's points on first use."""

    def __init__(self, report: CheckReport, classes: list[str]) -> None:
        self._report, self._classes, self._size = report, classes, cache(self._read_size)

    def _read_size(self, name: str) -> tuple[Points, float] | None:
        """Return an object's points and diameter in metres; None without readable points."""
        path = self._report.root / "models" / name / "points.xyz"
        if not path.is_file():
            self._report.note(f"models/{name}/points.xyz is missing: its boxes are not checked")
            return None
        points = Node(self._report, path, "points").attempt(lambda: read_points(path))
        return None if points is None else (points, largest_distance(points))

    def check(self, start: str, subset: Subset) -> None:
        """Check the files of the frame whose paths start with ``start``."""
        frame = ycb_video.read_frame(start, subset, self._report)
        meta, label = frame.meta, frame.labels
        node = Node(self._report, Path(f"{start}-meta.mat"))
        K = plausible_camera(node["intrinsic_matrix"], meta.K, frame.shape)
        self._check_box_file(Path(f"{start}-box.txt"), frame.shape)
        is_read = bool(meta.poses) or np.isfinite(meta.factor_depth)
        if label is not None and is_read:
            without_pose = sorted(set(np.unique(label).tolist()) - {0, *meta.poses})
            if without_pose:
                message = f"classes {without_pose} without a pose in meta.mat"
                self._report.report(Path(f"{start}-label.png"), "values", message)
        for index, T_cam_obj in meta.poses.items():
            column = meta.columns[index]
            if not 1 <= index <= len(self._classes):
                allowed = f"1 … {len(self._classes)}, the lines of classes.txt"
                node["cls_indexes"][column].report(f"unknown class {index}", allowed)
                continue
            pose_node = node["poses"][column]
            points, diameter = self._size(self._classes[index - 1]) or (None, None)
            is_posed = check_translation(pose_node, T_cam_obj[:3, 3], diameter)
            is_posed &= bool(np.isfinite(T_cam_obj).all())
            if is_posed and points is not None and K is not None:
                visible_box = None if label is None else Box.of_mask(label == index)
                check_box(pose_node["box"], transform(T_cam_obj, points), K, visible_box)

    def _check_box_file(self, path: Path, shape: Shape | None) -> None:
        """Check ``box.txt``, if present, with lines of name, left, top, right and bottom."""
        lines = path.read_text(errors="replace").splitlines() if path.is_file() else []
        for number, line in enumerate(lines, 1):
            name, *values = line.split() or [""]
            if not name:
                continue
            node, message = Node(self._report, path, f"line {number}"), f"{line!r:.60}"
            try:
                left, top, right, bottom = map(float, values)
            except ValueError:
                node.report(message, "a name and four numbers")
                continue
            if name not in self._classes:
                node.report(f"unknown object {name!r:.60}")
            if not (left < right and top < bottom):
                node.report(message, "left < right and top < bottom")
            elif shape is not None:
                height, width = shape
                if left >= width or top >= height or right < 0 or bottom < 0:
                    node.report(f"{message} outside the {width}×{height} image")
