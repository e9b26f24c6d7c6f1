"""Combine sources: mix real, rendered and synthetic frames, and crop windows of frames.

``real_fraction`` counts real camera frames only (paper Table 1: real versus hybrid). Synthetic
frames of a data set, e.g. YCB-Video's ``data_syn``, count as virtual.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import lru_cache
from typing import Final

import numpy as np
from jaxtyping import Int

from dopepp.data.sample import (
    DescribedSource,
    Purpose,
    Sample,
    SourceInfo,
    WrappedSource,
    crop_sample,
    item_rng,
    pad_sample,
    resize_sample,
)
from dopepp.drawing.pictures import Size
from dopepp.geometry.cuboid import CENTROID

_log = logging.getLogger(__name__)

REAL, VIRTUAL, SYNTHETIC = range(3)
_ROLES: Final = ("real", "virtual", "synthetic")

Order = Int[np.ndarray, " items"]


class HybridSource:
    """Mix of real, virtual and synthetic frames with exact shares.

    An epoch holds round(share × samples_per_epoch) real items, the same share of synthetic items
    among the remaining ones, and virtual items, in a random order. Each
    source is traversed in its own shuffled order across epochs, so that its items are used equally
    often; the number of the traversal is the epoch of the source. A missing source gives its share
    to the other sources, of which there must be one.

    Args:
        real: Real camera frames; None for a real share of 0.
        real_fraction: Share of ``real`` in the items of an epoch, in [0, 1].
        synthetic_fraction: Share of ``synthetic`` in the remaining items, in [0, 1].
    """

    def __init__(
        self,
        real: DescribedSource | None,
        virtual: DescribedSource | None,
        real_fraction: float,
        samples_per_epoch: int,
        seed: int,
        synthetic: DescribedSource | None = None,
        synthetic_fraction: float = 0.0,
        name: str = "hybrid",
    ) -> None:
        if real is None:
            real_fraction = 0.0
        elif virtual is None and synthetic is None and real_fraction != 1:
            _log.warning("there are no virtual images: the real share is 1, not %g", real_fraction)
            real_fraction = 1.0
        num_real = round(real_fraction * samples_per_epoch)
        num_synthetic = round(synthetic_fraction * (samples_per_epoch - num_real))
        if synthetic is None or virtual is None:
            num_synthetic = 0 if synthetic is None else samples_per_epoch - num_real
        self.counts = (num_real, samples_per_epoch - num_real - num_synthetic, num_synthetic)
        sources = enumerate((real, virtual, synthetic))
        self._sources = {
            role: source for role, source in sources if source is not None and self.counts[role]
        }
        self.name, self._seed, self._length = name, seed, samples_per_epoch
        self._plan = lru_cache(1)(self._make_plan)
        # An epoch may straddle two cycles of a source; older cycles are not needed again.
        self._order = lru_cache(2 * len(_ROLES))(self._make_order)

    def __len__(self) -> int:
        return self._length

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Return item ``index`` of ``epoch`` from the source of :meth:`locate`."""
        role, cycle, item = self.locate(index, epoch)
        return self._sources[role].sample(item, cycle)

    def locate(self, index: int, epoch: int) -> tuple[int, int, int]:
        """Return an item's source (``REAL``, …), and the item's epoch and index in this source."""
        roles, ranks = self._plan(epoch)
        role = int(roles[index])
        position = epoch * self.counts[role] + int(ranks[index])
        cycle, rank = divmod(position, len(self._sources[role]))
        return role, cycle, int(self._order(role, cycle)[rank])

    def _make_order(self, role: int, cycle: int) -> Order:
        rng = item_rng(self._seed, Purpose.CYCLE, cycle, role)
        return rng.permutation(len(self._sources[role]))

    def _make_plan(self, epoch: int) -> tuple[Order, Order]:
        """Return each item's source and its rank from 0 among the epoch's items of that source."""
        roles = np.repeat(np.arange(len(_ROLES)), self.counts)
        roles = item_rng(self._seed, Purpose.MIX, epoch).permutation(roles)
        ranks = np.empty_like(roles)
        for role, count in enumerate(self.counts):
            ranks[roles == role] = np.arange(count)
        return roles, ranks

    def contains(self, label: str) -> bool:
        """Return whether any source with a share above 0 can show the object named ``label``."""
        return any(source.contains(label) for source in self._sources.values())

    def describe(self) -> list[SourceInfo]:
        """Return the descriptions of all sources with a share above 0."""
        mix = {"seed": self._seed, "samples_per_epoch": self._length}
        entries = []
        for role, source in self._sources.items():
            count = self.counts[role]
            share = {**mix, "role": _ROLES[role], "count": count}
            for info in source.describe():
                identity = {**info.identity, "hybrid": share}
                entries.append(replace(info, identity=identity, num_per_epoch=count))
        return entries


class WindowedSource(WrappedSource):
    """Random windows, each containing an object's centre, of another source's resized images.

    Networks that train on windows of renders need windows of photographs too. Each epoch samples
    object and window again, uniformly among the windows that contain the object's centre, or among
    all windows without an object. Smaller images are padded. ``image`` and ``window`` are
    (width, height) in pixels: the size that images are resized to fit, and that of the windows.
    """

    def __init__(self, source: DescribedSource, image: Size, window: Size, seed: int) -> None:
        super().__init__(source, picture=list(image), window=list(window))
        self._image, self._window, self._seed = image, window, seed

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Return a random window of item ``index``, padded to the window size."""
        sample = resize_sample(self._source.sample(index, epoch), self._image)
        rng = item_rng(self._seed, Purpose.WINDOW, epoch, index)
        size = np.minimum(self._window, sample.size)
        points = [instance.keypoints[CENTROID] for instance in sample.instances]
        centres = [point for point in points if ((point >= 0) & (point < sample.size)).all()]
        centre = rng.uniform(0, 1, 2) * sample.size - 0.5
        if centres:
            centre = centres[rng.integers(len(centres))]
        first = np.maximum(np.ceil(centre - size + 0.5), 0)
        last = np.minimum(np.floor(centre + 0.5), np.array(sample.size) - size)
        left, top = np.floor(first + rng.uniform(0, 1, 2) * (last - first + 1)).astype(int).tolist()
        window = crop_sample(sample, left, top, (int(size[0]), int(size[1])))
        return pad_sample(window, self._window)
