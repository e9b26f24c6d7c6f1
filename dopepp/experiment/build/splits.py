"""What a split's images are: labelled ones in a format of the field, or renders.

To add a format, write a source and one function in :data:`FORMATS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from dopepp.core.errors import UserError
from dopepp.core.files import cache_folder
from dopepp.data.formats.bop.source import BopSource
from dopepp.data.formats.ndds.source import NddsSource
from dopepp.data.formats.webdataset.source import WebdatasetSource
from dopepp.data.formats.ycb_video.frame import read_image_set
from dopepp.data.formats.ycb_video.source import YcbVideoSource
from dopepp.data.sample import DescribedSource
from dopepp.data.sources.cache import CachedSource
from dopepp.data.sources.rendered import RenderedSource, Split
from dopepp.experiment.config.data import Cache, DataConfig
from dopepp.geometry.camera import Letterbox
from dopepp.parts.catalogue import load_part
from dopepp.parts.part import Parts
from dopepp.virtual.backgrounds import Backgrounds, find_backgrounds
from dopepp.virtual.factory import Factory, code_hash
from dopepp.virtual.presets.preset import Preset, customised_preset

_TRAINING_SHARE: Final = 0.8
"""Of the images of a folder that training shares with validation or test."""


def labelled_images(data: DataConfig, parts: Parts, seed: int, split: Split) -> DescribedSource:
    """Open a split's labelled images, which are in ``data.root``.

    A :class:`UserError`: the format is unknown, or the folder does not hold it.
    """
    assert data.root is not None
    if data.format not in FORMATS:
        formats = ", ".join(FORMATS)
        raise UserError(f"data.format={data.format}", formats, "choose the images' format")
    return FORMATS[data.format](data, data.root, parts, seed, split)


def synthetic_companions(
    data: DataConfig, parts: Parts, seed: int, backgrounds: Backgrounds
) -> DescribedSource | None:
    """Open YCB-Video's own synthetic frames where its training list names any."""
    if data.root is None or data.format != "ycb_video":
        return None
    image_set = data.image_sets["train"]
    if not read_image_set(data.root, image_set, "synthetic"):
        return None
    return YcbVideoSource(
        data.root, parts, image_set, "synthetic",
        backgrounds=backgrounds, seed=seed, read_depth=False,
    )  # fmt: skip


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
    data: DataConfig, root: Path, parts: Parts, seed: int, split: Split
) -> DescribedSource:
    """Open an image set of real frames, or the listed frames, the same for every split."""
    return YcbVideoSource(
        root, parts, data.image_sets[split] if data.frames is None else None,
        frames=data.frames, seed=seed, read_depth=split == "test",
    )  # fmt: skip


def _bop(data: DataConfig, root: Path, parts: Parts, seed: int, split: Split) -> DescribedSource:
    return BopSource(
        root, parts, data.image_sets[split], part_of=share_of(data.image_sets, split),
        targets=data.targets if split == "test" else None, read_depth=split == "test",
    )  # fmt: skip


def _webdataset(
    data: DataConfig, root: Path, parts: Parts, seed: int, split: Split
) -> DescribedSource:
    return WebdatasetSource(
        root, parts, data.image_sets[split], part_of=share_of(data.image_sets, split),
        download_dir=data.download_dir, read_depth=split == "test",
    )  # fmt: skip


def _ndds(data: DataConfig, root: Path, parts: Parts, seed: int, split: Split) -> DescribedSource:
    return NddsSource(
        root / data.image_sets[split], parts, part_of=share_of(data.image_sets, split),
        classes=data.classes, read_depth=split == "test",
    )  # fmt: skip


FORMATS: Final[dict[str, Callable[..., DescribedSource]]] = {
    "ycb_video": _ycb_video,
    "bop": _bop,
    "ndds": _ndds,
    "webdataset": _webdataset,
}
"""How the images of each format are opened."""


def training_renders(data: DataConfig, parts: Parts, seed: int) -> DescribedSource:
    """Render at the size the network sees, which costs a fraction of the native one."""
    preset = choose_preset(data)
    box = Letterbox.fit((preset.width, preset.height), data.input_size)
    small = preset.resized(box.width, box.height)
    factory = _factory(data, parts, small, seed, data.virtual.renderer)
    source = RenderedSource(factory, data.samples_per_epoch)
    return kept(source, data, data.cache, data.input_size)


def held_out_renders(
    data: DataConfig, parts: Parts, split: Split, scale: float = 1.0
) -> DescribedSource:
    """Render a range that no other split uses, at its native size, with parts of any scale."""
    renderer, count = data.virtual.renderer, data.num_val
    cache: Cache = "none"
    if split == "test":
        renderer, count, cache = data.test.renderer or renderer, data.num_test, data.test.cache
    factory = _factory(data, parts, choose_preset(data), data.eval_seed, renderer)
    name = "virtual" if renderer == "raster" else renderer
    return kept(RenderedSource(factory, count, split, name, scale), data, cache, None)


def kept(
    source: DescribedSource, data: DataConfig, cache: Cache, input_size: tuple[int, int] | None
) -> DescribedSource:
    """Put the chosen cache around a source; a :class:`UserError` where there is no room."""
    if cache == "none":
        return source
    folder = None
    if cache == "disk":
        folder = cache_folder() / "renders" if data.cache_dir is None else Path(data.cache_dir)
    return CachedSource(source, input_size, folder, identity=code_hash())


def choose_preset(data: DataConfig) -> Preset:
    """Return the preset with the config's changes."""
    name = data.virtual.preset or ("paper" if data.root is None else "ycb")
    return customised_preset(name, data.virtual.scene or {})


def _factory(data: DataConfig, parts: Parts, preset: Preset, seed: int, renderer: str) -> Factory:
    return Factory(
        parts,
        preset,
        seed,
        find_backgrounds(data.virtual.backgrounds),
        renderer=renderer,
        negatives=[load_part(name, data.unit) for name in data.virtual.negatives],
    )
