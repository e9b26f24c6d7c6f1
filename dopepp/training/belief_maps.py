"""A contact sheet of validation images under the belief maps that the network gives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from dopepp.data.batch import Batch
from dopepp.drawing.sheet import Tile
from dopepp.geometry.cuboid import CENTROID, NUM_KEYPOINTS
from dopepp.training.system import PoseSystem, ValidationOutput
from dopepp.training.validation_sheet import ValidationSheet


class BeliefMaps(ValidationSheet):
    """Writes ``val_belief.png`` after every validation and logs it as ``val/belief``.

    Two pictures per image, with their maxima: the strongest belief of any corner, and of the
    centroid, over all objects.

    Args:
        num_images: Images on the sheet, the first ones of the validation set.
    """

    name: ClassVar[str] = "belief"

    def __init__(self, num_images: int = 6) -> None:
        super().__init__(num_images)

    def tiles(self, system: PoseSystem, outputs: ValidationOutput, batch: Batch) -> Sequence[Tile]:
        """Return each image twice, under its corners' and under its centroid's beliefs."""
        images = batch.images.permute(0, 2, 3, 1).cpu().numpy()
        shape = (len(images), -1, NUM_KEYPOINTS, *outputs.belief.shape[-2:])
        beliefs = outputs.belief.reshape(shape).amax(dim=1).cpu().numpy()
        tiles = []
        for image, belief, key in zip(images, beliefs, batch.keys, strict=True):
            maps = {"corners": belief[:CENTROID].max(axis=0), "centroid": belief[CENTROID]}
            for name, one in maps.items():
                picture = heat_picture(image, one, system.geometry.stride)
                tiles.append(Tile(picture, f"{key} {name}, max {one.max():.2f}"))
        return tiles


def heat_picture(
    image: UInt8[np.ndarray, "height width 3"],
    channel: Float[np.ndarray, "map_height map_width"],
    stride: int = 8,
) -> UInt8[np.ndarray, "height width 3"]:
    """Blend one map into the dimmed image, the more opaque the stronger the belief.

    Args:
        image: RGB, at the network's input scale.
        channel: A map that covers it; values are clipped to [0, 1].
        stride: Pixels of the image per cell.
    """
    # cv2's resize keeps pixel centres: cell i lands on pixel stride·i + (stride − 1)/2.
    large = cv2.resize(channel, None, fx=stride, fy=stride, interpolation=cv2.INTER_LINEAR)
    share = np.clip(large[: image.shape[0], : image.shape[1]], 0.0, 1.0)
    heat = cv2.applyColorMap(np.rint(255 * share).astype(np.uint8), cv2.COLORMAP_JET)
    weight = (0.8 * share)[..., None]
    # The picture is dimmed, so that a faint belief is not lost in a bright background.
    blended = (1 - weight) * 0.6 * image + weight * heat[..., ::-1]
    return np.asarray(np.rint(blended), np.uint8)
