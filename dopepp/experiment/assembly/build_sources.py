"""Build the DataModule, the images of each split and their camera from the ``data`` config.

To add a format of labelled images, write a source and add it to :data:`FORMATS`, or publish an
:data:`Opener` as an entry point ``dopepp.formats`` (:mod:`dopepp.core.extensions`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Final

from dopepp.core import extensions
from dopepp.core.errors import UserError
from dopepp.core.pool import available_cores
from dopepp.data.datamodule import PoseDataModule
from dopepp.data.formats.bop.bop_reader import BopReader
from dopepp.data.formats.ndds.ndds_reader import NddsReader
from dopepp.data.formats.webdataset.webdataset_reader import WebdatasetReader
from dopepp.data.formats.ycb_video import read_image_set
from dopepp.data.formats.ycb_video.ycb_reader import YcbVideoReader
from dopepp.data.hybrid import HybridSource, WindowedSource
from dopepp.data.rendered import RenderedSource, Split
from dopepp.data.sample import DescribedSource
from dopepp.data.transforms.augment import Photometric
from dopepp.data.transforms.jitter import CameraJitter
from dopepp.data.transforms.masking import RandomMask
from dopepp.experiment.assembly.build_system import build_optional
from dopepp.experiment.assembly.photos import training_backgrounds
from dopepp.experiment.assembly.renders import (
    held_out_renders,
    training_renders,
    validation_windows,
    with_cache,
)
from dopepp.experiment.config.data_config import DataConfig
from dopepp.geometry.camera import Letterbox
from dopepp.parts.part import Parts
from dopepp.virtual.backgrounds import Backgrounds

_log = logging.getLogger(__name__)


def build_datamodule(data: DataConfig, parts: Parts, seed: int) -> PoseDataModule:
    """Build the DataModule. ``seed`` determines the training images, ``eval_seed`` the others."""
    backgrounds = training_backgrounds(data)
    val = val_images = held_out_source(data, parts, "val")
    if data.virtual.view is not None and isinstance(val, RenderedSource):
        val = validation_windows(data, parts)
    return PoseDataModule(
        train=_train_source(data, parts, seed, backgrounds),
        val=val,
        test=held_out_source(data, parts, "test"),
        object_names=[part.name for part in parts],
        input_size=data.network_input,
        batch_size=data.batch_size,
        num_workers=available_cores() if data.num_workers is None else data.num_workers,
        seed=seed,
        jitter=build_optional("jitter", CameraJitter, data.jitter),
        masking=build_optional("masking", RandomMask, data.masking),
        augment=build_optional("augmentation", Photometric, data.augment),
        backgrounds=backgrounds,
        val_images=val_images,
    )


def held_out_source(data: DataConfig, parts: Parts, split: Split) -> DescribedSource:
    """Build the validation or test images at their native resolution.

    Validation falls back to renders, with a warning, if no labelled image shows a part.
    """
    if data.is_rendered(split):
        return held_out_renders(data, parts, split)
    labelled = labelled_images(data, parts, data.eval_seed, split)
    has_objects = split == "test" or any(labelled.contains(part.name) for part in parts)
    if has_objects or any(part.mesh is None for part in parts):
        return labelled
    _log.warning(
        "%s shows none of %s: validating on renders, as with data.image_sets.val=null",
        labelled.name,
        ", ".join(part.name for part in parts),
    )
    return held_out_renders(data, parts, split)


def _train_source(
    data: DataConfig, parts: Parts, seed: int, backgrounds: Backgrounds
) -> DescribedSource:
    """Mix labelled images, YCB-Video's synthetic images and renders in the configured shares."""
    real, synthetic = None, None
    if data.root is not None and data.real_fraction > 0:
        real = _real_frames(data, parts, seed)
    elif data.real_fraction == 1:
        raise UserError(
            f"data={data.name} without data.root",
            f"a folder in the format {data.format}, because only labelled images are used",
            "set data.root, or train on renders with data=virtual",
        )
    elif data.real_fraction > 0:
        _log.warning(
            "no real images (data.root is not set): training on renders of %s only",
            ", ".join(part.name for part in parts),
        )
    if data.synthetic_fraction > 0 and data.real_fraction < 1:
        synthetic = _synthetic_images(data, parts, seed, backgrounds)
    virtual = None if data.real_fraction == 1 else training_renders(data, parts, seed, backgrounds)
    share = data.real_fraction if real is not None else 0.0
    mix = (real, virtual, share, data.samples_per_epoch, seed, synthetic, data.synthetic_fraction)
    return HybridSource(*mix, name=data.name)


def _real_frames(data: DataConfig, parts: Parts, seed: int) -> DescribedSource:
    """Open the labelled training images, in random windows if ``virtual.camera`` is set."""
    frames, view = labelled_images(data, parts, seed, "train"), data.virtual.view
    if view is None:
        return with_cache(frames, data, data.cache, data.network_input)
    box = Letterbox.scaled(view.size, data.virtual.camera_scale or 1.0)
    image = box.width, box.height
    whole = with_cache(frames, data, data.cache, image)
    return WindowedSource(whole, image, data.network_input, seed)


def labelled_images(data: DataConfig, parts: Parts, seed: int, split: Split) -> DescribedSource:
    """Open the labelled images of a split in ``data.root``, with ``seed`` for random choices."""
    assert data.root is not None
    if data.format in FORMATS:
        return FORMATS[data.format](data, data.root, parts, seed, split)
    added = extensions.components("formats")
    if data.format not in added:
        formats, advice = ", ".join((*FORMATS, *added)), extensions.advice("formats", data.format)
        fix = f"set data.format to the format of the images, or {advice}"
        raise UserError(f"data.format={data.format}", formats, fix)
    opener: Opener = resolve_name(added[data.format])
    return opener(data, data.root, parts, seed, split)


def _synthetic_images(
    data: DataConfig, parts: Parts, seed: int, backgrounds: Backgrounds
) -> DescribedSource | None:
    """Open the synthetic images in YCB-Video's training list, over ``backgrounds``, if any."""
    image_set = data.image_sets["train"]
    if data.root is None or data.format != "ycb_video" or image_set is None:
        return None
    if not read_image_set(data.root, image_set, "synthetic"):
        return None
    options: Any = {"backgrounds": backgrounds, "seed": seed, "read_depth": False}
    return YcbVideoReader(data.root, parts, image_set, "synthetic", **options)


def share_of(image_sets: Mapping[str, str | None], split: Split) -> tuple[float, float]:
    """Return the range of a folder's images that a split uses, as two fractions of the folder.

    Splits of one folder divide it in the order training, validation, test. Training gets 80 %; the
    remaining splits get equal shares.
    """
    sharing = [name for name in ("train", "val", "test") if image_sets[name] == image_sets[split]]
    first = 0.8 if sharing[0] == "train" and len(sharing) > 1 else 1 / len(sharing)
    borders = [0.0, first]
    for number in range(1, len(sharing)):
        borders.append(first + (1 - first) * number / (len(sharing) - 1))
    position = sharing.index(split)
    return borders[position], borders[position + 1]


Opener = Callable[[DataConfig, Path, Parts, int, Split], DescribedSource]
"""Function from data, root, parts, seed and split to the images of the split."""

FORMATS: Final[dict[str, Opener]] = {
    # The images are an image set, or the listed frames, which all splits share.
    "ycb_video": lambda data, root, parts, seed, split: YcbVideoReader(
        root,
        parts,
        data.image_set(split) if data.frames is None else data.frames,
        seed=seed,
        read_depth=split == "test",
    ),
    "bop": lambda data, root, parts, seed, split: BopReader(
        root,
        parts,
        data.image_set(split),
        part_of=share_of(data.image_sets, split),
        targets=data.targets if split == "test" else None,
        read_depth=split == "test",
    ),
    "ndds": lambda data, root, parts, seed, split: NddsReader(
        root / data.image_set(split),
        parts,
        part_of=share_of(data.image_sets, split),
        classes=data.classes,
        read_depth=split == "test",
    ),
    "webdataset": lambda data, root, parts, seed, split: WebdatasetReader(
        root,
        parts,
        data.image_set(split),
        part_of=share_of(data.image_sets, split),
        download_dir=data.download_dir,
        read_depth=split == "test",
    ),
}
"""Functions that open a split's labelled images, by name of the format."""


def note_on_shared_folder(data: DataConfig) -> str | None:
    """Return a remark if other splits use a share of the test images' folder, else None."""
    if data.is_rendered("test") or data.format not in ("bop", "ndds", "webdataset"):
        return None
    first, last = share_of(data.image_sets, "test")
    if last - first == 1:
        return None
    folder = data.image_sets["test"]
    sharing = [name for name in ("train", "val") if data.image_sets[name] == folder]
    overrides = " ".join(f"data.image_sets.{name}=none" for name in sharing)
    return (
        f"measuring the last {last - first:.0%} of the images in {folder}, which "
        f"is shared with {' and '.join(sharing)}; {overrides} measures the whole folder "
        "with its training images, and data.image_sets.test=FOLDER another folder"
    )
