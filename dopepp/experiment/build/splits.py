"""From the ``data`` and ``virtual`` configs to sources of rendered images.

From the ``data`` config to sources of labelled images in the formats of the field.

To add a format, write a source and one function in :data:`FORMATS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from dopepp.core.errors import UserError
from dopepp.core.machine import cache_folder
from dopepp.data.formats.bop.source import BopSource
from dopepp.data.formats.ndds.source import NddsSource
from dopepp.data.formats.webdataset.source import WebdatasetSource
from dopepp.data.formats.ycb_video.frame import read_image_set
from dopepp.data.formats.ycb_video.source import YcbVideoSource
from dopepp.data.sample import DescribedSource
from dopepp.data.sources.cache import CachedSource
from dopepp.data.sources.rendered import RenderedSource, Split
from dopepp.geometry.camera import Letterbox
from dopepp.parts.catalogue import load_part
from dopepp.parts.part import Part
from dopepp.virtual.backgrounds import Backgrounds, find_backgrounds
from dopepp.virtual.factory import Factory, code_hash
from dopepp.virtual.presets.preset import Preset, customised_preset

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


CACHES: Final = ("none", "memory", "disk")


def training_renders(data: Mapping[str, Any], parts: Sequence[Part], seed: int) -> DescribedSource:
    """Render at the size the network sees, which costs a fraction of the native one."""
    preset = choose_preset(data)
    input_size = (data["input_size"][0], data["input_size"][1])
    box = Letterbox.fit((preset.width, preset.height), input_size)
    factory = _factory(data, parts, preset.resized(box.width, box.height), seed)
    source = RenderedSource(factory, data["samples_per_epoch"])
    return kept(source, data, data["cache"], input_size)


def held_out_renders(
    data: Mapping[str, Any], parts: Sequence[Part], seed: int, split: Split, scale: float = 1.0
) -> DescribedSource:
    """Render a range that no other split uses, at its native size, with parts of any scale."""
    renderer, cache = data["virtual"]["renderer"], "none"
    if split == "test":
        renderer, cache = data["test"]["renderer"] or renderer, data["test"]["cache"]
    factory = _factory(data, parts, choose_preset(data), seed, renderer)
    name = "virtual" if renderer == "raster" else renderer
    source = RenderedSource(factory, data[f"num_{split}"], split, name, scale)
    return kept(source, data, cache, None)


def kept(
    source: DescribedSource,
    data: Mapping[str, Any],
    cache: str,
    input_size: tuple[int, int] | None,
) -> DescribedSource:
    """Put the chosen cache around a source.

    Raises:
        UserError: The choice is unknown, or there is no room.
    """
    if cache not in CACHES:
        raise UserError(f"data.cache={cache}", ", ".join(CACHES), "choose one of them")
    if cache == "none":
        return source
    folder = None if cache == "memory" else _cache_folder(data["cache_dir"])
    return CachedSource(source, input_size, folder, identity=code_hash())


def choose_preset(data: Mapping[str, Any]) -> Preset:
    """Return the preset with the config's changes."""
    virtual = data["virtual"]
    name = virtual["preset"] or ("paper" if data["root"] is None else "ycb")
    return customised_preset(name, virtual["scene"])


def choose_backgrounds(data: Mapping[str, Any]) -> Backgrounds:
    """Return the config's backgrounds."""
    return find_backgrounds(data["virtual"]["backgrounds"])


def _factory(
    data: Mapping[str, Any],
    parts: Sequence[Part],
    preset: Preset,
    seed: int,
    renderer: str | None = None,
) -> Factory:
    virtual = data["virtual"]
    return Factory(
        parts,
        preset,
        seed,
        choose_backgrounds(data),
        renderer=renderer or virtual["renderer"],
        negatives=[load_part(name, data["unit"]) for name in virtual["negatives"]],
    )


def _cache_folder(chosen: str | None) -> Path:
    return cache_folder() / "renders" if chosen is None else Path(chosen)
