"""Windows of real frames: what a network that learns on windows of renders sees of photographs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dopepp.data.sample import (
    DescribedSource,
    Instance,
    Purpose,
    Sample,
    SourceInfo,
    hull_areas,
    item_rng,
    pad_sample,
    resize_sample,
)
from dopepp.drawing.pictures import Size
from dopepp.geometry.camera import crop_camera
from dopepp.geometry.cuboid import CENTROID


class WindowedSource:
    """Another source's images, scaled, and of each a window with the centre of an object in it.

    The object is drawn anew every epoch, and so is the window, among all that lie in the picture
    and hold the centre; an image without objects gives a window from anywhere. In a direction in
    which the picture is smaller than the window, it is padded, as for prediction.

    Args:
        source: Whose images.
        picture: (width, height) that they are resized to fit, pixels.
        window: (width, height) of the windows, pixels.
        seed: Of the windows.
    """

    def __init__(self, source: DescribedSource, picture: Size, window: Size, seed: int) -> None:
        self._source, self.name = source, source.name
        self._picture, self._window, self._seed = picture, window, seed

    def __len__(self) -> int:
        return len(self._source)

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Return a window of item ``index``."""
        sample = resize_sample(self._source.sample(index, epoch), self._picture)
        rng = item_rng(self._seed, Purpose.WINDOW, epoch, index)
        size = np.minimum(self._window, sample.size)
        centres = np.array([one.keypoints[CENTROID] for one in sample.instances]).reshape(-1, 2)
        shown = centres[((centres >= 0) & (centres < sample.size)).all(axis=1)]
        middle = rng.uniform(0, 1, 2) * sample.size - 0.5
        if len(shown):
            middle = shown[rng.integers(len(shown))]
        first = np.maximum(np.ceil(middle - size + 0.5), 0)
        last = np.minimum(np.floor(middle + 0.5), np.array(sample.size) - size)
        left, top = np.floor(first + rng.uniform(0, 1, 2) * (last - first + 1)).astype(int).tolist()
        window = cropped(sample, left, top, (int(size[0]), int(size[1])))
        return pad_sample(window, self._window)

    def contains(self, label: str) -> bool:
        """Tell what the whole images tell."""
        return self._source.contains(label)

    def describe(self) -> list[SourceInfo]:
        """Return what the images are, and the sizes."""
        sizes = {"picture": list(self._picture), "window": list(self._window)}
        return [
            replace(info, identity={**info.identity, **sizes}) for info in self._source.describe()
        ]


def cropped(sample: Sample, left: int, top: int, size: Size) -> Sample:
    """Cut (width, height) pixels out of an image, from (left, top) on.

    Of the objects, visible fractions become smaller by what lies outside: of the mask's pixels, or,
    where there is no mask, of the area of the cuboid's outline.
    """
    width, height = size

    def cut(pixels: NDArray[Any]) -> NDArray[Any]:
        return pixels[top : top + height, left : left + width]

    def in_window(one: Instance) -> Instance:
        keypoints = one.keypoints - (left, top)
        mask = None if one.mask is None else cut(one.mask)
        if one.mask is not None and mask is not None:
            inside, before = float(mask.sum()), float(one.mask.sum())
        else:
            inside = hull_areas(keypoints, (height, width))[0]
            before = hull_areas(one.keypoints, sample.image.shape)[0]
        share = min(inside / before, 1.0) if before else 0.0
        visible = one.visible_fraction * share
        return replace(one, keypoints=keypoints, mask=mask, visible_fraction=visible)

    return replace(
        sample,
        image=cut(sample.image),
        K=crop_camera(sample.K, left, top),
        depth=None if sample.depth is None else cut(sample.depth),
        instances=[in_window(one) for one in sample.instances],
    )
