"""Level of the log odds at which a pose has the score 0.5, measured on photos without the part.

The best of many start poses can fit an ordinary edge well, and a plain part fits more edges than an
intricate part. A few photos that ship with the package are therefore searched for the part. The
level is the mean of the photos' largest log odds of ``Detection.probability``, plus ``MARGIN``
standard deviations. The user's cache folder stores the level.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from importlib.resources import files
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from dopepp.core.json import cached
from dopepp.drawing.pictures import RGBImage, read_rgb
from dopepp.geometry.camera import CameraMatrix, camera_matrix
from dopepp.parts.part import Part

logger = logging.getLogger(__name__)

NUM_PHOTOS: Final = 8
SIZE: Final = (480, 360)  # of a photo, pixels
PART_PX: Final = 120.0  # diameter of the part at the geometric mean of its distances, pixels
MARGIN: Final = 2.5  # distance of the level from the photos' mean, standard deviations
LOWEST: Final = 0.0  # lower bound of the level, log odds
VERSION: Final = 13  # part of the cache's key; increase it when search or verification change

Measure = Callable[[Iterable[RGBImage], CameraMatrix], list[float]]
"""Function that returns the largest log odds of the verified poses on each image."""


def background_log_odds(
    part: Part, distances: tuple[float, float], tilt: float, measure: Measure
) -> float:
    """Return the log odds that verified poses on images without the part rarely exceed.

    Args:
        part: Part to search.
        distances: Nearest and farthest depth, metres.
        tilt: Largest angle between the part's z axis and the direction to the camera, degrees.
        measure: Searches images for the part; called if the cache has no level of the part.
    """
    symmetries = [part.symmetries_discrete, part.symmetries_continuous]
    key = (VERSION, MARGIN, part.mesh_hash, part.diameter, distances, tilt, symmetries)
    focal = PART_PX * float(np.sqrt(distances[0] * distances[1])) / part.diameter
    K = camera_matrix(focal, focal, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)

    def make() -> float:
        logger.info("%s: measuring false detections on photos; the result is cached", part.name)
        levels = measure(_photos(), K)
        return max(LOWEST, float(np.mean(levels) + MARGIN * np.std(levels)))

    return cached("templates", key, float, make)


def _photos() -> Iterator[RGBImage]:
    """Yield photos that ship with the package, resized and cropped to SIZE."""
    folder = Path(str(files("dopepp").joinpath("virtual", "backgrounds", "photos")))
    paths = sorted(folder.glob("*.jpg"))
    for path in paths[:: max(1, len(paths) // NUM_PHOTOS)][:NUM_PHOTOS]:
        photo = read_rgb(path)
        scale = max(SIZE[0] / photo.shape[1], SIZE[1] / photo.shape[0])
        size = [max(SIZE[i], round(scale * photo.shape[1 - i])) for i in range(2)]
        photo = np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA), np.uint8)
        left, top = (size[0] - SIZE[0]) // 2, (size[1] - SIZE[1]) // 2
        yield np.ascontiguousarray(photo[top : top + SIZE[1], left : left + SIZE[0]])
