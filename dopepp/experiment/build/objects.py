"""From the ``data`` config to the objects to learn."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import NoneType
from typing import Any, Final

from dopepp.core.checks import check_integer, check_number
from dopepp.core.errors import UserError
from dopepp.data.formats.bop.models import bop_parts
from dopepp.data.formats.ycb_video.frame import read_classes
from dopepp.data.part_symmetries import choose_symmetries
from dopepp.data.sources.rendered import MAX_ITEMS
from dopepp.parts.catalogue import load_part
from dopepp.parts.mesh.read import ycb_part
from dopepp.parts.part import Part

PAPER_OBJECTS: Final = (
    "003_cracker_box",
    "005_tomato_soup_can",
    "006_mustard_bottle",
    "009_gelatin_box",
    "010_potted_meat_can",
)
"""The YCB objects of the paper's tables."""

MAX_WORKERS: Final = 1024
"""More loader processes than any machine here has cores: a slip of the keyboard."""


_KINDS: Final[Mapping[str, tuple[type, ...]]] = {
    "name": (str,),
    "format": (str,),
    "root": (str, NoneType),
    "objects": (list, NoneType),
    "parts": (list,),
    "frames": (list, NoneType),
    "unit": (str, NoneType),
    "image_sets": (dict,),
    "virtual": (dict, NoneType),
    "samples_per_epoch": (int,),
    "eval_seed": (int,),
    "num_val": (int,),
    "num_test": (int,),
    "batch_size": (int,),
    "num_workers": (int, NoneType),
    "input_size": (list,),
    "real_fraction": (int, float),
    "synthetic_fraction": (int, float),
}
"""Options that every data config has, with what their values may be."""


def check_data(data: Mapping[str, Any], source: str) -> None:
    """Refuse a data config that is none: a checkpoint's may be by anybody.

    Args:
        data: The config.
        source: Where it is from, for the error.

    Raises:
        UserError: An option is missing or of another kind.
    """
    for name, kinds in _KINDS.items():
        if name not in data or type(data[name]) not in kinds:
            got = f"{name}={data[name]!r:.80}" if name in data else f"no {name}"
            raise UserError(
                f"{source}, whose data config has {got}",
                f"{name} as {' or '.join(kind.__name__ for kind in kinds)}",
                "choose the data with data=…, or use a checkpoint written by train.py",
            )


def build_parts(data: Mapping[str, Any]) -> list[Part]:
    """Build the objects to learn: those of the labelled images in ``root``, else the listed parts.

    They have the symmetries that ``data.symmetries`` says.

    Raises:
        UserError: The root, an object or a part is wrong, or real frames are asked for without a
            root.
    """
    _check_options(data)
    # Checkpoints of earlier versions were trained without the option.
    return choose_symmetries(_read_parts(data), data.get("symmetries"))


def _read_parts(data: Mapping[str, Any]) -> list[Part]:
    if data["root"] is None:
        for option in ("objects", "frames"):
            if data[option] is not None:
                raise UserError(
                    f"data.{option}={data[option]} without data.root",
                    f"data.{option} names {option} of a data set; data.parts names meshes",
                    "set data.root, or use data.parts",
                )
    elif data["format"] == "ycb_video":
        return _ycb_parts(Path(data["root"]), data["objects"])
    elif data["format"] in ("bop", "webdataset"):
        return bop_parts(Path(data["root"]), data["objects"])
    return [load_part(name, data["unit"]) for name in data["parts"]]


def _ycb_parts(root: Path, objects: list[str] | None) -> list[Part]:
    classes = read_classes(root)
    names = PAPER_OBJECTS if objects is None else objects
    unknown = [name for name in names if name not in classes]
    if unknown:
        raise UserError(
            f"data.objects with {unknown[0]!r}", ", ".join(classes), "choose from this list"
        )
    return [ycb_part(root, name) for name in names]


def _check_options(data: Mapping[str, Any]) -> None:
    """Refuse lists and numbers of the wrong kind before anything is read or rendered."""
    for name in ("objects", "parts", "frames"):
        value = data[name]
        if value is not None and not isinstance(value, list):
            raise UserError(
                f"data.{name}={value}", "a list, also of a single one", f"data.{name}=[{value}]"
            )
    for name in ("samples_per_epoch", "num_val", "num_test", "batch_size"):
        check_integer(f"data.{name}", data[name], 1, MAX_ITEMS)
    for name in ("real_fraction", "synthetic_fraction"):
        check_number(f"data.{name}", data[name], 0, 1)
    if data["num_workers"] is not None:
        check_integer("data.num_workers", data["num_workers"], 0, MAX_WORKERS)
    size = data["input_size"]
    sides = size if isinstance(size, list) and len(size) == 2 else [0]
    if not all(type(side) is int and side >= 32 and side % 32 == 0 for side in sides):
        raise UserError(
            f"data.input_size={size}",
            "[width, height], each a multiple of 32",
            "round up; images are letterboxed into it",
        )
