"""Score of a part's poses, from what templates find on photos without the part.

The best of many start poses can fit an ordinary edge well, and a plain part fits more edges than an
intricate part. Therefore the verification of the best pose on each of a few photos, which ship with
the package, sets the level that a pose must exceed. The level is kept in the user's cache folder.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Iterable, Iterator
from importlib.resources import files
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from dopepp.core.errors import UserError
from dopepp.core.files import cache_folder, write_whole
from dopepp.core.json import read_json
from dopepp.drawing.pictures import Picture, read_rgb
from dopepp.geometry.camera import CameraMatrix, camera_matrix
from dopepp.parts.part import Part

logger = logging.getLogger(__name__)

NUM_PHOTOS: Final = 8
SIZE: Final = (480, 360)  # of a photo, pixels
PART_PX: Final = 120.0  # diameter of the part at the middle of its distances
MARGIN: Final = 2.0  # standard deviations of the photos' levels above their mean
LOWEST: Final = 0.0  # log odds
VERSION: Final = 5  # changes when the search or the verification does

Loudest = Callable[[Iterable[Picture], CameraMatrix], list[float]]
"""Returns the largest log odds of the verified poses on each picture."""


def silent_level(
    part: Part, distances: tuple[float, float], tilt: float, loudest: Loudest
) -> float:
    """Return the log odds of verification that poses on pictures without the part hardly reach.

    Args:
        part: Part.
        distances: Nearest and farthest depth, metres.
        tilt: Largest angle of the part's z axis to the camera, degrees.
        loudest: Measurement of pictures; called if the cache has no level of the part.
    """
    symmetries = [part.symmetries_discrete, part.symmetries_continuous]
    key = repr((VERSION, MARGIN, part.mesh_hash, part.diameter, distances, tilt, symmetries))
    path = cache_folder() / "templates" / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.json"
    try:
        level = read_json(path)
        if isinstance(level, float):
            return level
    except (OSError, UserError):
        pass  # not measured yet, or damaged
    logger.info("%s: measuring what resembles the part on photos, once", part.name)
    focal = PART_PX * float(np.sqrt(distances[0] * distances[1])) / part.diameter
    K = camera_matrix(focal, focal, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
    levels = loudest(_photos(), K)
    level = max(LOWEST, float(np.mean(levels) + MARGIN * np.std(levels)))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, json.dumps(level).encode())
    except OSError as error:
        logger.warning("the level of %s is not kept: %s", part.name, error)
    return level


def _photos() -> Iterator[Picture]:
    """Yield photos of the package, cut to the same size."""
    folder = Path(str(files("dopepp").joinpath("virtual", "backgrounds", "photos")))
    paths = sorted(folder.glob("*.jpg"))
    for path in paths[:: max(1, len(paths) // NUM_PHOTOS)][:NUM_PHOTOS]:
        photo = read_rgb(path)
        scale = max(SIZE[0] / photo.shape[1], SIZE[1] / photo.shape[0])
        size = [max(SIZE[i], round(scale * photo.shape[1 - i])) for i in range(2)]
        photo = np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA), np.uint8)
        left, top = (size[0] - SIZE[0]) // 2, (size[1] - SIZE[1]) // 2
        yield np.ascontiguousarray(photo[top : top + SIZE[1], left : left + SIZE[0]])
