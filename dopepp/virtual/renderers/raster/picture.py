"""The picture: fragments summed up in their pixels, samples over the background, and labels."""

from __future__ import annotations

import numpy as np

from dopepp.core.compiled import Array, compiled
from dopepp.virtual.renderers.raster.visibility import (
    NUM_COLOUR_SAMPLES,
)


@compiled(fastmath=True)
def add_colour(
    pixel: Array, weight: Array, radiance: Array, curve: Array, limit: float, steps: int,
    colour: Array,
) -> None:  # fmt: skip
    """Add fragments to the sums of their pixels' sRGB values.

    Light is encoded before samples are averaged, so a highlight's edge stays smooth.

    Args:
        pixel: Index of every fragment's pixel, shape (n,).
        weight: Number of samples it stands for, shape (n,).
        radiance: Linear RGB, shape (3, n).
        curve: sRGB value per step of radiance.
        limit: Radiance at which the curve ends.
        steps: Steps of the curve per unit.
        colour: Sums, float32, shape (pixels, 3), updated in place.
    """
    for p in range(pixel.shape[0]):
        for c in range(3):
            step = int(min(max(radiance[c, p], 0.0), limit) * steps + 0.5)
            colour[pixel[p], c] += weight[p] * curve[step]


@compiled()
def composite(
    origin: tuple[int, int],
    ids: Array,
    inverse_depth: Array,
    colour: Array,
    first_ids: Array,
    image: Array,
    depth: Array,
    instances: Array,
) -> None:
    """Put a window of samples over the background and read its centre samples as labels.

    Args:
        origin: Image pixel (x, y) of the window's first element.
        ids: Triangle ids per sample; the last sample is the pixel's centre.
        inverse_depth: 1/m per sample.
        colour: Sum of the covered samples' sRGB values.
        first_ids: First triangle id of every object, ascending.
        image: Background on entry, result on return, uint8.
        depth: Metres at pixel centres, float32.
        instances: Object index at pixel centres, int16.
    """
    height, width, num_samples = ids.shape
    centre = num_samples - 1
    for j in range(height):
        y = origin[1] + j
        for i in range(width):
            x = origin[0] + i
            empty = 0
            for s in range(NUM_COLOUR_SAMPLES):
                if ids[j, i, s] < 0:
                    empty += 1
            if empty < NUM_COLOUR_SAMPLES:
                for c in range(3):
                    level = (colour[j, i, c] + empty * image[y, x, c]) / NUM_COLOUR_SAMPLES
                    image[y, x, c] = np.uint8(level + 0.5)
            triangle = ids[j, i, centre]
            if triangle >= 0:
                depth[y, x] = np.float32(1.0 / inverse_depth[j, i, centre])
                owner = first_ids.shape[0] - 1
                while first_ids[owner] > triangle:
                    owner -= 1
                instances[y, x] = owner
