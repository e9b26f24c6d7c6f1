"""Pictures in files: one after the other, each decoded when its turn comes."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import read_photo
from dopepp.inference.sources.bag import BAGS, is_bag_folder
from dopepp.inference.sources.frame import Frame
from dopepp.inference.sources.video import VIDEOS

SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
"""Of a folder's pictures; a file that is named alone may have any."""


class Pictures:
    """Picture files, in the order given."""

    rate = None
    camera = None

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = paths
        self.name, self.stem = str(paths[0]), paths[0].stem
        self.count = len(paths)
        numbers = [int(one.stem) if one.stem.isdecimal() else -1 for one in paths]
        own = min(numbers) >= 0 and len(set(numbers)) == len(numbers)
        self._numbers = numbers if own else range(len(paths))

    def frames(self, stride: int = 1) -> Iterator[Frame]:
        """Yield every so manieth picture; a UserError names the one that is damaged."""
        for number, path in list(zip(self._numbers, self._paths, strict=True))[::stride]:
            yield Frame(read_photo(path), str(path), number)


def pictures_of(path: Path) -> list[Path] | None:
    """Return a folder's pictures or the path itself; None where it is a video or a bag.

    A :class:`UserError`: a folder has no pictures.
    """
    if not path.is_dir():
        return None if path.suffix.lower() in (*VIDEOS, *BAGS) else [path]
    if is_bag_folder(path):
        return None
    found = in_order(one for one in path.iterdir() if one.suffix.lower() in SUFFIXES)
    if not found:
        allowed = f"a folder with pictures ({', '.join(SUFFIXES)})"
        raise UserError(f"{path} without a picture", allowed, "pass the folder they are in")
    return found


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Sort paths as a person would: frame 10 behind frame 9."""
    return sorted(paths, key=lambda path: [_word(one) for one in re.split(r"(\d+)", str(path))])


def _word(text: str) -> tuple[int, str]:
    return (int(text), "") if text.isdecimal() else (-1, text)
