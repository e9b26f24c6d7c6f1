"""Bring a sample into the network's input size: resize, then pad on the right and at the bottom.

The image, K, keypoints, masks and depth all follow the one resize rule of
:class:`dopepp.geometry.camera.Letterbox`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dopepp.data.sample import Instance, Sample
from dopepp.drawing.pictures import Size
from dopepp.geometry.camera import Letterbox


def nearest(image: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    """Resize by exact nearest: target pixel j takes the source pixel that holds its centre.

    The centre of target pixel j lies at (j + ½) / s − ½, inside source pixel ⌊(j + ½) / s⌋; integer
    arithmetic keeps the rule exact (``cv2.INTER_NEAREST`` takes ⌊j / s⌋, half a pixel off).
    """
    rows = (2 * np.arange(height) + 1) * image.shape[0] // (2 * height)
    columns = (2 * np.arange(width) + 1) * image.shape[1] // (2 * width)
    return np.asarray(image[rows[:, None], columns])


def resize_sample(sample: Sample, input_size: Size) -> Sample:
    """Scale a sample by one factor so that it just fits into ``input_size``, without padding."""
    box = Letterbox.fit(sample.size, input_size)
    if (box.width, box.height) == sample.size:
        return sample
    return replace(
        sample,
        image=box.image(sample.image),
        K=box.camera(sample.K),
        depth=None if sample.depth is None else nearest(sample.depth, box.width, box.height),
        instances=[_resize_instance(instance, box) for instance in sample.instances],
    )


def _resize_instance(instance: Instance, box: Letterbox) -> Instance:
    mask = instance.mask
    return replace(
        instance,
        keypoints=box.points(instance.keypoints),
        mask=None if mask is None else nearest(mask, box.width, box.height),
    )


def pad_sample(sample: Sample, input_size: Size) -> Sample:
    """Pad with zeros on the right and at the bottom; K and keypoints stay as they are.

    Raises:
        ValueError: The sample is larger than ``input_size``.
    """
    width, height = sample.size
    if (width, height) == tuple(input_size):
        return sample
    if width > input_size[0] or height > input_size[1]:
        raise ValueError(f"a {width}×{height} sample does not fit into {input_size}")

    def pad(array: NDArray[Any]) -> NDArray[Any]:
        padded = np.zeros((input_size[1], input_size[0], *array.shape[2:]), array.dtype)
        padded[:height, :width] = array
        return padded

    instances = [
        replace(one, mask=None if one.mask is None else pad(one.mask)) for one in sample.instances
    ]
    depth = None if sample.depth is None else pad(sample.depth)
    return replace(sample, image=pad(sample.image), depth=depth, instances=instances)


def letterbox_sample(sample: Sample, input_size: Size) -> Sample:
    """Resize and pad a sample to exactly ``input_size`` (width, height)."""
    return pad_sample(resize_sample(sample, input_size), input_size)
