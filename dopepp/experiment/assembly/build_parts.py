"""Load the parts to learn, and the negatives (parts to show unlabelled), from the config."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Final

from dopepp.core.errors import UserError
from dopepp.data.formats.bop.bop_models import bop_parts
from dopepp.data.formats.ycb_video import read_classes
from dopepp.data.part_symmetries import choose_symmetries
from dopepp.experiment.config.data_config import DataConfig
from dopepp.parts.catalogue import load_part
from dopepp.parts.mesh.read import ycb_part
from dopepp.parts.part import Part, Parts

PAPER_OBJECTS: Final = (
    "003_cracker_box",
    "005_tomato_soup_can",
    "006_mustard_bottle",
    "009_gelatin_box",
    "010_potted_meat_can",
)
"""The YCB objects of the paper's tables."""


def build_parts(data: DataConfig) -> list[Part]:
    """Load the parts to learn, from ``data.root`` or ``data.parts``, with their symmetries.

    With a camera, a part with ``data.symmetries=auto`` may differ from its rotated copy by a pixel.
    """
    view = data.virtual.view
    resolution = 0.0 if view is None else view.resolution
    return choose_symmetries(_read_parts(data), data.symmetries, resolution)


def _read_parts(data: DataConfig) -> list[Part]:
    """Load the objects of ``data.root`` (YCB-Video, BOP), else the parts that ``parts`` lists."""
    if data.root is None:
        if data.format == "bop":
            fix = "set data.root, or train on renders of mesh files with data=virtual"
            raise UserError(f"data={data.name} without data.root", "a BOP data set's folder", fix)
        for option, value in (("objects", data.objects), ("frames", data.frames)):
            if value is not None:
                raise UserError(
                    f"data.{option}={list(value)} without data.root",
                    f"data.{option} together with data.root, or data.parts for mesh files",
                    "set data.root, or use data.parts",
                )
    elif data.format == "ycb_video":
        classes = read_classes(data.root)
        names = PAPER_OBJECTS if data.objects is None else data.objects
        if unknown := [name for name in names if name not in classes]:
            fix = "set data.objects to one or more of these names"
            raise UserError(f"data.objects with {unknown[0]!r}", ", ".join(classes), fix)
        return [ycb_part(data.root, name) for name in names]
    elif data.format in ("bop", "webdataset"):
        return bop_parts(data.root, data.objects)
    return [load_part(name, data.unit) for name in data.parts]


def build_negatives(data: DataConfig, parts: Parts) -> list[Part]:
    """Load the parts that renders show unlabelled: ``virtual.negatives``, other models of BOP."""
    listed = []
    for name in data.virtual.negatives:
        path = Path(name)
        changed_at = path.stat().st_mtime_ns if path.is_file() else 0  # 0 for a built-in part
        listed.append(_negative(name, data.unit, changed_at))
    if data.root is None or data.format != "bop" or data.objects is None:
        return listed
    hashes = {part.mesh_hash for part in (*parts, *listed)}
    return listed + [part for part in _all_models(data.root) if part.mesh_hash not in hashes]


@lru_cache(maxsize=16)
def _negative(name: str, unit: str | None, changed_at: int) -> Part:
    """Load a part once per process and state of its file, so that messages appear once."""
    return load_part(name, unit)


@lru_cache(maxsize=1)
def _all_models(root: Path) -> tuple[Part, ...]:
    """Load all models of a BOP data set, once per process."""
    return tuple(bop_parts(root))
