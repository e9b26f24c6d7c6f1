"""Check BOP's scenewise layout: a data set, one of its splits, or a single scene.

What is optional in BOP (depth, masks) must be there for every image of a scene as soon as it is
there for one. Noted are a scene without ``scene_gt.json`` (data sets keep the ground truth of
their tests private), objects without ``visib_fract``, objects without a model and inexact
rotations.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from dopepp.data.formats import STAGING, staged_items
from dopepp.data.formats.bop import records as bop
from dopepp.data.formats.bop.check_image import (
    Models,
    Oddities,
    ReadMask,
    check_image,
    load_models,
)
from dopepp.data.formats.bop.images import DEPTH_MODES, one_channel_of
from dopepp.data.formats.problems import COLOUR_MODES, CheckReport, Place, picture_shape
from dopepp.drawing.pictures import Mask, Shape

_SCENE_FILES: Final = ("scene_camera.json", "scene_gt.json", "scene_gt_info.json")
_MASKS: Final = ("mask", "mask_visib")


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
    # The models lie beside the splits: in this folder, or above the split or scene that it is.
    models = load_models(report, (report.root, *report.root.resolve().parents[:2]))
    for folder in scene_folders(report.root):
        if folder != report.root and not bop.is_number(folder.name):
            report.report(folder, "name", "no scene's number", "000000, 000001, …")
        _Scene(report, folder, models).check()


class _Scene:
    """One scene: its three JSON files and the files that its folders hold."""

    def __init__(self, report: CheckReport, folder: Path, models: Models | None) -> None:
        self._report, self._folder, self._models = report, folder, models
        self._oddities = Oddities()
        self._camera_path, self._truth_path, self._info_path = (
            folder / name for name in _SCENE_FILES
        )
        self._pictures = self._files(bop.IMAGE_FOLDERS, bop.IMAGE_SUFFIXES)
        self._depths = self._files(("depth",), bop.DEPTH_SUFFIXES)
        self._masks = {name: self._mask_files(name) for name in _MASKS}
        self._records = bop.read_records(folder, report)

    def check(self) -> None:
        self._tell_missing_truth()
        cameras, truths, infos = self._records
        images = sorted(cameras.keys() | self._pictures.keys() | truths.keys())
        for image in images:
            # A file that cannot be read is one defect, not one for every image.
            for by_image, path in ((cameras, self._camera_path), (truths, self._truth_path)):
                if by_image and image not in by_image:
                    self._report.report(path, str(image), "missing")
            self._check_image(image)
            self._report.count_image()
        self._oddities.note(self._report, self._folder)
        for name, found in (("depth", self._depths), (_SCENE_FILES[2], infos)):
            for image in sorted(found.keys() - set(images)):
                self._report.report(self._folder / name, str(image), "no such image in the scene")
        staged = len(staged_items(self._folder / STAGING, ".json"))
        if staged:
            self._report.note(f"{self._folder}: {staged} images written and not yet finalized")

    def _tell_missing_truth(self) -> None:
        if self._truth_path.is_file():
            return
        if self._info_path.is_file() or any(self._masks.values()):
            self._report.report(self._truth_path, "file", "missing")
        else:
            self._report.note(f"{self._folder} has no scene_gt.json: its poses are not published")

    def _check_image(self, image: int) -> None:
        report, folder, records = self._report, self._folder, self._records
        picture_path = self._pictures.get(image, folder / "rgb" / f"{image:06d}.png")
        shape = picture_shape(Place(report, picture_path), modes=COLOUR_MODES)
        if self._depths:
            path = self._depths.get(image, folder / "depth" / f"{image:06d}.png")
            one_channel_of(Place(report, path), shape, modes=DEPTH_MODES)
        truths = records.truths.get(image, [])
        infos = records.infos.get(image, [None] * len(truths))

        def places(what: str, number: int) -> Place:
            place = Place(report, folder / f"scene_{what}.json")[f"{image}"]
            return place if what == "camera" else place[number]

        poses = check_image(
            places,
            records.cameras.get(image),
            truths,
            infos,
            shape,
            bool(self._depths),
            self._models,
            self._read_mask(image, len(truths), shape),
        )
        self._oddities.count(poses, self._models)

    def _read_mask(self, image: int, count: int, shape: Shape | None) -> ReadMask:
        """Read an image's masks one by one; those of objects that are not there are defects."""
        files = {name: found.get(image, {}) for name, found in self._masks.items()}
        for found in files.values():
            for number in sorted(found.keys() - set(range(count))):
                if self._truth_path.is_file():
                    self._report.report(found[number], "file", f"no object {number} on the image")

        def read(name: str, number: int) -> Mask | None:
            if not self._masks[name]:
                return None
            path = files[name].get(number, self._folder / name / f"{image:06d}_{number:06d}.png")
            mask = one_channel_of(Place(self._report, path), shape)
            return None if mask is None else mask != 0

        return read

    def _files(self, folders: tuple[str, ...], suffixes: tuple[str, ...]) -> dict[int, Path]:
        """Find numbered images; others beside them are defects."""
        found = bop.image_files(self._folder, folders, suffixes, self._report)
        for folder in {path.parent for path in found.values()}:
            for path in sorted(folder.iterdir()):
                hidden = path.name.startswith(".")
                if path.suffix.lower() in suffixes and not hidden and not bop.is_number(path.stem):
                    self._report.report(path, "file", "no image's number")
        return found

    def _mask_files(self, name: str) -> dict[int, dict[int, Path]]:
        found: dict[int, dict[int, Path]] = {}
        folder = self._folder / name
        for path in sorted(folder.iterdir()) if folder.is_dir() else ():
            image, _, number = path.stem.partition("_")
            if image.isdecimal() and number.isdecimal():
                found.setdefault(int(image), {})[int(number)] = path
        return found
