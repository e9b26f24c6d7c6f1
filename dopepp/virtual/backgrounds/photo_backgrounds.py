"""Photos of a folder as backgrounds and images, divided between training, validation and test."""

from __future__ import annotations

import copy
import hashlib
import logging
import os
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal

import cv2
import numpy as np
from numpy.random import Generator

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import MAX_SIDE, RGBImage, Size, read_picture

logger = logging.getLogger(__name__)

PHOTO_SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".bmp", ".webp")

_LONGEST_PHOTO_PX: Final = 1000
"""Longest side of cached photos: enough for a sharp 640×480 crop. JPEG decodes at 1/2, 1/4 or 1/8,
so 1000 lets a photo of 4000 pixels decode at a quarter."""

_MIN_REDUCTION: Final = 2.0
"""Smallest factor by which a crop is reduced. A crop is taken from the coarsest of the photo's
:func:`_halvings` that allows this factor."""

PhotoSplit = Literal["train", "val", "test", "all"]

MIN_PHOTOS: Final = 2  # smallest number of photos in the validation split and in the test split
HELD_OUT: Final = 0.15  # Share of the photos in the validation split, and in the test split
_HASHED_BYTES: Final = 2**16  # leading bytes of a photo, whose hash determines the split

_SMALLEST_PX: Final = 30  # smallest valid shorter side of a halving
_KEPT_BYTES: Final = 200_000_000  # decoded photos cached per process: about 260 of VOC2007


class PhotoBackgrounds:
    """Random crops of photos, mirrored and dimmed at random.

    A damaged photo is logged and replaced by another random photo, so an image depends only on the
    generator and the files.

    A folder is searched recursively for :data:`PHOTO_SUFFIXES`, without hidden files and links to
    folders, unless ``names`` gives the photos' relative paths. Photos are sorted by relative path.

    Raises:
        UserError: The folder contains no photo; or, in :meth:`draw` and :meth:`frame`, more than 10
            photos or more than 1 % of all photos are damaged.
    """

    def __init__(self, folder: Path, names: Sequence[str] | None = None) -> None:
        self.folder, self.split = Path(folder), "all"
        photo_names = _photo_names(self.folder) if names is None else names
        self.paths = [self.folder / name for name in sorted(photo_names)]
        if not self.paths:
            allowed = f"a folder with {', '.join(PHOTO_SUFFIXES)} files"
            fix = "pass a folder of photos, or leave out this option"
            raise UserError(f"no photo in the folder {folder}", allowed, fix)
        self.bad: dict[Path, str] = {}
        self._photos: OrderedDict[Path, list[RGBImage]] = OrderedDict()
        self._kept_bytes = 0

    def __getstate__(self) -> dict[str, Any]:
        """Pickle without the decoded photos."""
        return self.__dict__ | {"_photos": OrderedDict(), "_kept_bytes": 0}

    def identity(self) -> list[str]:
        """Return the kind and split, the number of photos, and a hash of their paths and sizes."""
        digest = hashlib.sha256()
        for path in self.paths:
            name = path.relative_to(self.folder).as_posix()
            digest.update(f"{name}\0{path.stat().st_size}\0".encode("utf-8", "surrogateescape"))
        kind = "photos" if self.split == "all" else f"{self.split} photos"
        return [kind, str(len(self.paths)), digest.hexdigest()]

    def part(self, split: PhotoSplit, held_out: float = HELD_OUT) -> PhotoBackgrounds:
        """Return the photos of one split.

        Photos are divided by the order of their content's hashes. Splits therefore do not depend on
        names or folders, and copies of a photo are in the same split. With fewer than six different
        photos, all splits are the whole folder (:meth:`is_divided` is False).
        ``held_out`` is the share of the photos in the validation split, and in the test split.
        """
        if split == "all":
            return self
        names = tuple(path.relative_to(self.folder).as_posix() for path in self.paths)
        groups = _equal_photos(self.folder, names)
        part = copy.copy(self)
        if len(groups) >= 3 * MIN_PHOTOS:
            count = max(MIN_PHOTOS, round(held_out * len(groups)))
            val, test = len(groups) - 2 * count, len(groups) - count
            chosen = {"train": groups[:val], "val": groups[val:test], "test": groups[test:]}[split]
            part = PhotoBackgrounds(self.folder, [name for group in chosen for name in group])
            part.split = split
        return part

    @property
    def is_divided(self) -> bool:
        """Whether the photos are one split of the folder, not the whole folder."""
        return self.split != "all"

    def draw(self, rng: Generator, width: int, height: int) -> RGBImage:
        """Return a random crop of a photo: 40 % to 100 % of the largest crop of this shape."""
        sizes = None
        while sizes is None:
            sizes = self._photo(self.paths[int(rng.integers(len(self.paths)))])
        rows, columns = sizes[0].shape[:2]
        share = rng.uniform(0.4, 1.0)
        reduction = share * min(columns / width, rows / height)
        photo = sizes[int(np.clip(np.log2(reduction / _MIN_REDUCTION), 0, len(sizes) - 1))]
        rows, columns = photo.shape[:2]
        scale = share * min(columns / width, rows / height)
        crop_width, crop_height = max(int(width * scale), 1), max(int(height * scale), 1)
        left = int(rng.integers(columns - crop_width + 1))
        top = int(rng.integers(rows - crop_height + 1))
        crop = photo[top : top + crop_height, left : left + crop_width]
        interpolation = cv2.INTER_AREA if crop_width > width else cv2.INTER_LINEAR
        image = cv2.resize(crop, (width, height), interpolation=interpolation)
        if rng.random() < 0.5:
            image = cv2.flip(image, 1)
        return np.asarray(cv2.convertScaleAbs(image, alpha=float(rng.uniform(0.5, 1.1))), np.uint8)

    def frame(
        self, rng: Generator, number: int, size: Size, share: float = 1.0, mirrored: bool = False
    ) -> tuple[RGBImage, Path]:
        """Return a region of a photo, scaled to ``size``, and the photo's path.

        A damaged photo is replaced by the next after ``number``. ``share`` is the ratio of the
        region's side to the largest side at this aspect ratio; regions below 1 have a random
        position. ``mirrored`` flips left and right.

        Raises:
            UserError: More than 10 photos or more than 1 % of all photos are damaged.
        """
        photo = None
        while photo is None:
            path = self.paths[number % len(self.paths)]
            photo, number = self._read(path), number + 1
        (rows, columns), (width, height) = photo.shape[:2], size
        scale = share * min(columns / width, rows / height)
        crop_width, crop_height = max(round(width * scale), 1), max(round(height * scale), 1)
        left, top = (columns - crop_width) // 2, (rows - crop_height) // 2
        if share < 1:
            left = int(rng.integers(columns - crop_width + 1))
            top = int(rng.integers(rows - crop_height + 1))
        crop = photo[top : top + crop_height, left : left + crop_width]
        if mirrored:
            crop = cv2.flip(crop, 1)
        interpolation = cv2.INTER_AREA if crop_width > width else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(crop, size, interpolation=interpolation), np.uint8), path

    def _photo(self, path: Path) -> list[RGBImage] | None:
        """Return :func:`_halvings` of a photo from the cache or the file; None if damaged."""
        if path in self._photos:
            self._photos.move_to_end(path)
            return self._photos[path]
        photo = self._read(path, _LONGEST_PHOTO_PX)
        if photo is None:
            return None
        sizes = _halvings(photo)
        self._photos[path] = sizes
        self._kept_bytes += sum(size.nbytes for size in sizes)
        while self._kept_bytes > _KEPT_BYTES and len(self._photos) > 1:
            oldest = self._photos.popitem(last=False)[1]
            self._kept_bytes -= sum(size.nbytes for size in oldest)
        return sizes

    def _read(self, path: Path, longest: int | None = None) -> RGBImage | None:
        """Return a photo with sides of at most ``longest`` pixels; None, logged, if damaged."""
        if path in self.bad:
            return None
        try:
            return read_picture(path, longest)
        except ValueError as error:
            self.bad[path] = str(error)
        most = min(10, int(0.01 * len(self.paths)))
        if len(self.bad) > most:
            listed = "; ".join(f"{bad}: {reason}" for bad, reason in self.bad.items())
            raise UserError(
                f"{len(self.bad)} damaged of {len(self.paths)} background photos ({listed})",
                f"photos of at most {MAX_SIDE} pixels a side, with at most {most} damaged files",
                "delete these files, or copy them again",
            )
        text = "skipping the damaged background photo %s: %s (%d of at most %d)"
        logger.warning(text, path, self.bad[path], len(self.bad), most)
        return None


@cache
def _equal_photos(folder: Path, names: tuple[str, ...]) -> list[list[str]]:
    """Return groups of photos that begin with the same bytes, in the order of these bytes' hashes.

    The files are read once per process, because a run divides a folder several times.
    """
    by_hash: dict[bytes, list[str]] = {}
    for name in names:
        with (folder / name).open("rb") as file:
            key = hashlib.sha256(file.read(_HASHED_BYTES)).digest()
        by_hash.setdefault(key, []).append(name)
    return [by_hash[key] for key in sorted(by_hash)]


def _halvings(photo: RGBImage) -> list[RGBImage]:
    """Return a photo and the same photo at 1/2, 1/4, … of its size, to a side of 30 pixels."""
    sizes = [photo]
    while min(sizes[-1].shape[:2]) >= 2 * _SMALLEST_PX:
        half = cv2.resize(sizes[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        sizes.append(np.asarray(half, np.uint8))
    return sizes


def _photo_names(folder: Path) -> Iterator[str]:
    """Yield the paths of all photos below a folder, relative to the folder, in any order."""
    if not folder.is_dir():
        return
    pending = [""]
    while pending:
        prefix = pending.pop()
        with os.scandir(folder / prefix) as entries:
            for entry in entries:
                if entry.name.startswith("."):  # such as a Mac's ._photo.jpg
                    continue
                if entry.is_dir(follow_symlinks=False):
                    pending.append(f"{prefix}{entry.name}/")
                elif entry.name.lower().endswith(PHOTO_SUFFIXES) and entry.is_file():
                    yield f"{prefix}{entry.name}"
