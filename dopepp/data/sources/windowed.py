"""Windows of real frames: what a network that learns on windows of renders sees of photographs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dopepp.data.sample import (
    DescribedSource,
    Purpose,
    Sample,
    SourceInfo,
    crop_sample,
    item_rng,
    pad_sample,
    resize_sample,
)
from dopepp.drawing.pictures import Size
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
        window = crop_sample(sample, left, top, (int(size[0]), int(size[1])))
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
