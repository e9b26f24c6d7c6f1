"""Check BOP's scenewise layout: a data set, one of its splits, or a single scene.

What is optional in BOP (depth, masks, ``scene_gt_info.json``) must be there for every image of a
scene as soon as it is there for one. A scene without ``scene_gt.json`` is noted: data sets keep the
ground truth of their tests private.

The objects of a BOP data set, as far as ``models_info.json`` tells and with what is wrong.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from dopepp.data.formats.bop.check_image import ImageRecords, Silhouettes, check_image_records
from dopepp.data.formats.bop.check_models import Models, load_models
from dopepp.data.formats.bop.scene import IMAGE_FOLDERS, IMAGE_SUFFIXES, MAX_SCENE_BYTES
from dopepp.data.formats.bop.writer import STAGING, staged_items
from dopepp.data.formats.problems import (
    CheckReport,
    load_image,
    load_json,
    load_size,
    mapping,
)

_SCENE_FILES: Final = ("scene_camera.json", "scene_gt.json", "scene_gt_info.json")
_MASKS: Final = ("mask", "mask_visib")
_DEPTH_SUFFIXES: Final = (".png", ".tif", ".tiff")


def scene_folders(root: Path) -> Iterator[Path]:
    """Yield the scenes of a data set, a split, or the scene that ``root`` is, in order."""
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
    return named or any((folder / name).is_file() for name in _SCENE_FILES)


def check_bop(report: CheckReport) -> None:
    """Check the models and every scene."""
    scenes = list(scene_folders(report.root))
    # The models lie beside the splits: in this folder, or above the split or scene that it is.
    roots = (report.root, *report.root.resolve().parents[:2])
    models = load_models(report, roots)
    for scene in scenes:
        _Scene(report, scene, models).check()


class _Scene:
    """One scene: its three JSON files and the files that its folders hold."""

    def __init__(self, report: CheckReport, folder: Path, models: Models | None) -> None:
        self._report, self._folder, self._models = report, folder, models
        self._camera_path, self._truth_path, self._info_path = (
            folder / name for name in _SCENE_FILES
        )
        self._pictures = self._files(IMAGE_FOLDERS, IMAGE_SUFFIXES)
        self._depths = self._files(("depth",), _DEPTH_SUFFIXES)
        self._masks = {name: self._mask_files(name) for name in _MASKS}

    def check(self) -> None:
        cameras = self._by_image(self._camera_path)
        truths = self._by_image(self._truth_path) if self._has_truth() else None
        infos = self._by_image(self._info_path) if self._info_path.is_file() else None
        images = sorted(cameras.keys() | self._pictures.keys() | (truths or {}).keys())
        for image in images:
            self._check_image(image, cameras, truths, infos)
            self._report.count_image()
        for name, found in (("depth", self._depths), ("scene_gt_info.json", infos or {})):
            for image in sorted(found.keys() - set(images)):
                self._report.add(self._folder / name, str(image), "no such image in the scene")
        staged = len(staged_items(self._folder / STAGING, ".json"))
        if staged:
            self._report.note(f"{self._folder}: {staged} images written and not yet finalized")

    def _has_truth(self) -> bool:
        if self._truth_path.is_file():
            return True
        if self._info_path.is_file() or any(self._masks.values()):
            self._report.add(self._truth_path, "file", "missing")
        else:
            self._report.note(f"{self._folder} has no scene_gt.json: its poses are not published")
        return False

    def _by_image(self, path: Path) -> dict[int, Any]:
        records = load_json(self._report, path, MAX_SCENE_BYTES)
        if records is not None and not isinstance(records, dict):
            self._report.add(path, "top level", f"{records!r:.60}; allowed: images by number")
        found: dict[int, Any] = {}
        for key, record in mapping(records).items():
            number = int(key) if key.isascii() and key.isdecimal() and len(key) < 10 else None
            if number is None:
                self._report.add(path, f"{key!r:.40}", "no image's number")
            elif number in found:
                self._report.add(path, f"{key!r:.40}", f"image {number} twice")
            else:
                found[number] = record
        return found

    def _check_image(
        self,
        image: int,
        cameras: Mapping[int, Any],
        truths: Mapping[int, Any] | None,
        infos: Mapping[int, Any] | None,
    ) -> None:
        report, folder = self._report, self._folder
        files = (
            (cameras, self._camera_path),
            (truths, self._truth_path),
            (infos, self._info_path),
        )
        for by_image, path in files:
            # A file that cannot be read is one defect, not one for every image.
            if by_image and image not in by_image:
                report.add(path, str(image), "missing")
        picture_path = self._pictures.get(image)
        size = None
        if picture_path is None:
            report.add(folder / "rgb" / f"{image:06d}.png", "file", "missing")
        else:
            size = load_size(report, picture_path)
        if self._depths:
            path = self._depths.get(image, folder / "depth" / f"{image:06d}.png")
            load_image(report, path, size)
        records = ImageRecords(
            cameras.get(image),
            (truths or {}).get(image),
            (infos or {}).get(image),
            bool(self._depths),
        )
        count = len(records.truths) if isinstance(records.truths, list) else 0
        check_image_records(
            report,
            lambda name: (folder / f"scene_{name}.json", str(image)),
            records,
            size,
            self._models,
            self._silhouettes(image, count, size),
        )

    def _silhouettes(self, image: int, count: int, size: tuple[int, int] | None) -> Silhouettes:
        """Read an image's masks one by one; those of objects that are not there are defects."""
        files: dict[str, dict[int, Path]] = {
            name: found.get(image, {}) for name, found in self._masks.items()
        }
        for found in files.values():
            for number in sorted(found.keys() - set(range(count))):
                if self._truth_path.is_file():
                    self._report.add(found[number], "file", f"no object {number} on the image")

        def read(name: str, number: int) -> Any:
            if not self._masks[name]:
                return None
            path = files[name].get(number, self._folder / name / f"{image:06d}_{number:06d}.png")
            mask = load_image(self._report, path, size)
            return None if mask is None else mask != 0

        return Silhouettes(lambda n: read("mask", n), lambda n: read("mask_visib", n))

    def _files(self, folders: tuple[str, ...], suffixes: tuple[str, ...]) -> dict[int, Path]:
        """Return the numbered images of the first of the folders that is there."""
        folder = next((self._folder / n for n in folders if (self._folder / n).is_dir()), None)
        found: dict[int, Path] = {}
        for path in sorted(folder.iterdir()) if folder is not None else ():
            if path.name.startswith(".") or path.suffix.lower() not in suffixes:
                continue
            if not path.stem.isdecimal():
                self._report.add(path, "file", "no image's number")
            elif int(path.stem) in found:
                self._report.add(path, "file", f"image {int(path.stem)} twice")
            else:
                found[int(path.stem)] = path
        return found

    def _mask_files(self, name: str) -> dict[int, dict[int, Path]]:
        found: dict[int, dict[int, Path]] = {}
        folder = self._folder / name
        for path in sorted(folder.iterdir()) if folder.is_dir() else ():
            image, _, number = path.stem.partition("_")
            if image.isdecimal() and number.isdecimal():
                found.setdefault(int(image), {})[int(number)] = path
        return found
