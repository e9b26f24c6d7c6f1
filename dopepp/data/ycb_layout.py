"""YCB-Video's folder: its two subsets, its class list and its image sets."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal

from dopepp.errors import UserError

Subset = Literal["real", "synthetic"]
FOLDERS: Final[dict[Subset, str]] = {"real": "data", "synthetic": "data_syn"}
"""Where each subset's frames are."""


def read_classes(root: Path) -> list[str]:
    """Return the object names of ``image_sets/classes.txt``; a class index is the line from 1.

    Raises:
        UserError: The folder is missing, has no ``data/``, or has no class list.
    """
    layout = "a YCB-Video folder with data/, image_sets/classes.txt and models/"
    fix = "set data.root to the unpacked YCB-Video data set"
    if not root.is_dir():
        raise UserError(f"data.root={root}, which is no folder", layout, fix)
    if not (root / "data").is_dir():
        raise UserError(f"data.root={root}, which has no data/", layout, fix)
    path = root / "image_sets" / "classes.txt"
    if not path.is_file():
        raise UserError(f"data.root={root}, which has no image_sets/classes.txt", layout, fix)
    return path.read_text().split()


def read_image_set(root: Path, image_set: str, subset: Subset) -> list[str]:
    """Return a subset's frames in ``image_sets/NAME.txt``, e.g. ``0050/000003`` or ``000000``.

    Raises:
        UserError: There is no such list, or a line is no frame.
    """
    path = root / "image_sets" / f"{image_set}.txt"
    if not path.is_file():
        lists = sorted(p.stem for p in path.parent.glob("*.txt") if p.stem != "classes")
        raise UserError(f"image set {image_set!r}", f"one of {lists}", f"correct it or add {path}")
    frames = []
    for line in path.read_text().split():
        scene, _, number = line.partition("/")
        if not number.isdigit() or not (scene.isdigit() or scene == "data_syn"):
            raise UserError(
                f"{path}: line {line!r}", "SSSS/NNNNNN or data_syn/NNNNNN", "correct it"
            )
        if (scene == "data_syn") == (subset == "synthetic"):
            frames.append(number if subset == "synthetic" else line)
    return frames
