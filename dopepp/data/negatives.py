"""Sources of frames without objects to learn: photos, renders of other parts, and mixes of both.

Every sample is a whole frame without instances; its ``source`` is the name of its kind of frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from dopepp.data.sample import Purpose, Sample, SampleSource, item_rng
from dopepp.drawing.pictures import Size
from dopepp.geometry.camera import CameraMatrix
from dopepp.virtual.backgrounds import PhotoBackgrounds


class PhotoFrames:
    """Photos as frames of a camera ``K`` of a (width, height) ``size``, pixels.

    Photos are scaled to cover the frame and cropped at the centre; photos of the frame's size stay
    unchanged. If there are more frames than photos (default: as many), they are used again: every
    second pass is mirrored, and from the third pass on, frames show random regions of the photos.
    """

    def __init__(
        self,
        images: PhotoBackgrounds,
        K: CameraMatrix,
        size: Size,
        num_frames: int | None = None,
        name: str = "pictures",
        seed: int = 0,
    ) -> None:
        self.images, self.K, self.size, self.name = images, K, size, name
        self._length = len(images.paths) if num_frames is None else num_frames
        self._seed = seed
        self._order = item_rng(seed, Purpose.SHUFFLE, 0).permutation(len(images.paths))

    def __len__(self) -> int:
        return self._length

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Return frame ``index``; the epoch is ignored."""
        round_number, number = divmod(index, len(self._order))
        rng = item_rng(self._seed, Purpose.WINDOW, round_number, number)
        share = 1.0 if round_number < 2 else rng.uniform(0.5, 1.0)
        is_mirrored = round_number % 2 == 1
        image, path = self.images.frame(
            rng, int(self._order[number]), self.size, share, is_mirrored
        )
        key = f"{path.relative_to(self.images.folder).as_posix()}/{round_number}"
        return Sample(image, self.K.copy(), [], None, self.name, key)


class FrameMix:
    """Mix of n sources: frame i is frame ⌊i / n⌋ of source i mod n, without labels and depth.

    The objects of rendered frames must not be detected either.
    """

    def __init__(self, sources: Sequence[SampleSource], num_frames: int) -> None:
        self.sources, self.name, self._length = tuple(sources), "negatives", num_frames

    def __len__(self) -> int:
        return self._length

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Return frame ``index``."""
        item, source = divmod(index, len(self.sources))
        return replace(self.sources[source].sample(item, epoch), instances=[], depth=None)
