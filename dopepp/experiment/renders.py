"""From the ``data`` and ``virtual`` configs to sources of rendered images."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from dopepp.data.cache import CachedSource
from dopepp.data.rendered import RenderedSource, Split
from dopepp.data.sample import DescribedSource
from dopepp.errors import UserError
from dopepp.geometry.camera import Letterbox
from dopepp.parts.catalogue import load_part
from dopepp.parts.part import Part
from dopepp.virtual.backgrounds import Backgrounds, find_backgrounds
from dopepp.virtual.customise import customised_preset
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import Preset
from dopepp.virtual.version import code_hash

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
    if chosen is not None:
        return Path(chosen)
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home) / "dopepp" / "renders"
