"""From the ``data`` config to sources of labelled images in the formats of the field.

To add a format, write a source and one function in :data:`FORMATS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from dopepp.data.bop import BopSource
from dopepp.data.ndds import NddsSource
from dopepp.data.rendered import Split
from dopepp.data.sample import DescribedSource
from dopepp.data.webdataset import WebdatasetSource
from dopepp.data.ycb_layout import read_image_set
from dopepp.data.ycb_video import YcbVideoSource
from dopepp.errors import UserError
from dopepp.parts.part import Part
from dopepp.virtual.backgrounds import Backgrounds

_TRAINING_SHARE: Final = 0.8
"""Of the images of a folder that training shares with validation or test."""


def labelled_images(
    data: Mapping[str, Any], parts: Sequence[Part], seed: int, split: Split
) -> DescribedSource:
    """Open a split's labelled images.

    Raises:
        UserError: The format is unknown, or the folder does not hold it.
    """
    if data["format"] not in FORMATS:
        raise UserError(
            f"data.format={data['format']}", ", ".join(FORMATS), "choose the images' format"
        )
    return FORMATS[data["format"]](data, parts, seed, split)


def synthetic_companions(
    data: Mapping[str, Any], parts: Sequence[Part], seed: int, backgrounds: Backgrounds
) -> DescribedSource | None:
    """Open YCB-Video's own synthetic frames where its training list names any."""
    if data["format"] != "ycb_video":
        return None
    root, image_set = Path(data["root"]), data["image_sets"]["train"]
    if not read_image_set(root, image_set, "synthetic"):
        return None
    return YcbVideoSource(
        root, parts, image_set, "synthetic", backgrounds=backgrounds, seed=seed, read_depth=False
    )


def share_of(image_sets: Mapping[str, str], split: Split) -> tuple[float, float]:
    """Return the range of its folder's images that a split takes, as fractions.

    A folder that several splits name is divided in order (training, validation, test): 80 % to
    training if it is among them, the rest equally.
    """
    sharing = [name for name in ("train", "val", "test") if image_sets[name] == image_sets[split]]
    first = _TRAINING_SHARE if sharing[0] == "train" and len(sharing) > 1 else 1 / len(sharing)
    borders = [0.0, first]
    for number in range(1, len(sharing)):
        borders.append(first + (1 - first) * number / (len(sharing) - 1))
    place = sharing.index(split)
    return borders[place], borders[place + 1]


def _ycb_video(
    data: Mapping[str, Any], parts: Sequence[Part], seed: int, split: Split
) -> DescribedSource:
    """Open an image set of real frames, or the listed frames, the same for every split."""
    chosen = (
        {"image_set": data["image_sets"][split]}
        if data["frames"] is None
        else {"frames": data["frames"]}
    )
    return YcbVideoSource(
        Path(data["root"]), parts, seed=seed, read_depth=split == "test", **chosen
    )


def _bop(
    data: Mapping[str, Any], parts: Sequence[Part], seed: int, split: Split
) -> DescribedSource:
    sets = data["image_sets"]
    return BopSource(
        Path(data["root"]), parts, sets[split], part_of=share_of(sets, split),
        targets=data.get("targets") if split == "test" else None, read_depth=split == "test",
    )  # fmt: skip


def _webdataset(
    data: Mapping[str, Any], parts: Sequence[Part], seed: int, split: Split
) -> DescribedSource:
    sets = data["image_sets"]
    return WebdatasetSource(
        Path(data["root"]), parts, sets[split], part_of=share_of(sets, split),
        download_dir=data.get("download_dir"), read_depth=split == "test",
    )  # fmt: skip


def _ndds(
    data: Mapping[str, Any], parts: Sequence[Part], seed: int, split: Split
) -> DescribedSource:
    sets = data["image_sets"]
    return NddsSource(
        Path(data["root"]) / sets[split], parts, part_of=share_of(sets, split),
        classes=data.get("classes"),
        read_depth=split == "test",
    )  # fmt: skip


FORMATS: Final[dict[str, Callable[..., DescribedSource]]] = {
    "ycb_video": _ycb_video,
    "bop": _bop,
    "ndds": _ndds,
    "webdataset": _webdataset,
}
"""How the images of each format are opened."""
