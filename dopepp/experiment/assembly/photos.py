"""Divide the user's photos: backgrounds for training, other photos for the detection threshold.

Training shows photos behind rendered parts, and the network learns to ignore these photos. Its
threshold is therefore tuned and tested on other photos.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Final, Literal

from dopepp.core.errors import UserError
from dopepp.experiment.config.data_config import DataConfig
from dopepp.virtual.backgrounds import (
    Backgrounds,
    MixedBackgrounds,
    PhotoBackgrounds,
    find_backgrounds,
    shipped_photos,
)
from dopepp.virtual.backgrounds.photo_backgrounds import MIN_PHOTOS, PhotoSplit

_log = logging.getLogger(__name__)

_OWN_SHARE: Final = 0.25  # share of the user's images in the training backgrounds
_NEEDED: Final = f"at least {3 * MIN_PHOTOS} different photos"


def training_backgrounds(data: DataConfig) -> Backgrounds:
    """Return the training backgrounds: ``virtual.backgrounds``, and ``negative_photos`` if set."""
    backgrounds = find_backgrounds(data.virtual.backgrounds, "train")
    if isinstance(backgrounds, PhotoBackgrounds) and not backgrounds.is_divided:
        _log.warning(
            "virtual.backgrounds=%s has fewer than %d different photos: training, validation and "
            "test use all of them, and tune=true is not possible",
            data.virtual.backgrounds,
            3 * MIN_PHOTOS,
        )
    user_photos = negative_photos(data, "train")
    return (
        backgrounds
        if user_photos is None
        else MixedBackgrounds(backgrounds, user_photos, _OWN_SHARE)
    )


def held_out_photos(data: DataConfig, split: Literal["val", "test"]) -> PhotoBackgrounds:
    """Return held-out photos of ``virtual.backgrounds``; the package's if those are procedural."""
    photos = find_backgrounds(data.virtual.backgrounds, split)
    if not isinstance(photos, PhotoBackgrounds):
        return shipped_photos(split)
    if photos.is_divided:
        return photos
    raise UserError(
        f"virtual.backgrounds={data.virtual.backgrounds} with {len(photos.paths)} photos, too few "
        "to reserve some for tuning",
        _NEEDED,
        "add photos, leave out virtual.backgrounds (procedural backgrounds), or set tune=false",
    )


def negative_photos(data: DataConfig, split: PhotoSplit) -> PhotoBackgrounds | None:
    """Return a split of the images in ``virtual.negative_photos``; None without that folder."""
    folder = data.virtual.negative_photos
    if folder is None:
        return None
    photos = PhotoBackgrounds(Path(folder)).part(split)
    if photos.is_divided:
        return photos
    raise UserError(
        f"virtual.negative_photos={folder} with {len(photos.paths)} images",
        _NEEDED,
        "take more images of the workplace without the part",
    )
