"""The rasteriser: a scene becomes an image, its depth, its instances and visible fractions.

The picture: fragments summed up in their pixels, samples over the background, and labels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from dopepp.core.compiled import Array, compiled
from dopepp.virtual.renderers.raster.coverage import Silhouette, fractions_of, silhouette
from dopepp.virtual.renderers.raster.plane import (
    clear_to_plane,
    darken_plane,
    inverse_depth_of,
    plane_depth,
)
from dopepp.virtual.renderers.raster.shading import ambient_row, shade_object
from dopepp.virtual.renderers.raster.shadow import shadow_maps
from dopepp.virtual.renderers.raster.visibility import (
    CENTRE_SAMPLE,
    NUM_COLOUR_SAMPLES,
    PIXEL_SAMPLES,
    Projected,
    project_object,
    rasterise,
    scratch,
)
from dopepp.virtual.scene import NEAR, Rendered, Scene


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


__all__ = ["Silhouette", "render", "silhouette", "visible_fractions"]


def render(scene: Scene) -> Rendered:
    """Render a scene with 2×2 anti-aliasing; one without objects is its background."""
    width, height = scene.size
    image = scene.background.copy()
    depth = np.zeros((height, width), np.float32)
    instances = np.full((height, width), -1, np.int16)
    if scene.plane is not None:
        plane_depth(inverse_depth_of(scene.plane, scene.K), NEAR, depth)
    projected = [project_object(item, scene.K) for item in scene.objects]
    boxes = [box for item in projected if (box := item.box(scene.size)) is not None]
    lights = shadow_maps(scene, projected) if scene.objects else []
    left = min((box[0] for box in boxes), default=0)
    top = min((box[1] for box in boxes), default=0)
    right = max((box[2] for box in boxes), default=0)
    bottom = max((box[3] for box in boxes), default=0)
    inverse_depth, ids = _draw(scene, projected, (left, top, right, bottom), PIXEL_SAMPLES)
    if scene.plane is not None:
        darken_plane(scene, scene.plane, lights, ambient_row(scene), (left, top), ids, image)
    colour = scratch("colour", (*ids.shape[:2], 3), np.float32)
    colour.fill(0.0)
    first_ids = _first_ids(scene)
    for item, seen, first in zip(scene.objects, projected, first_ids, strict=True):
        box = seen.box(scene.size)
        if box is not None:
            own = (box[0] - left, box[1] - top, box[2] - left, box[3] - top)
            shade_object(
                item, seen, scene, lights, own, (left, top), ids, inverse_depth, int(first), colour
            )
    composite((left, top), ids, inverse_depth, colour, first_ids, image, depth, instances)
    return Rendered(image, depth, instances, fractions_of(scene, projected, instances), scene)


def visible_fractions(scene: Scene) -> Float[np.ndarray, "objects"]:
    """Return the visible fractions that :func:`render` reports, without shading anything."""
    projected = [project_object(item, scene.K) for item in scene.objects]
    ids = _draw(scene, projected, (0, 0, *scene.size), CENTRE_SAMPLE)[1]
    owners = np.searchsorted(_first_ids(scene), ids[..., 0], side="right") - 1
    return fractions_of(scene, projected, owners.astype(np.int16))


def _draw(
    scene: Scene,
    projected: Sequence[Projected],
    window: tuple[int, int, int, int],
    samples: Array,
) -> tuple[Array, Array]:
    """Return the inverse depth and the triangle ids of a window's samples."""
    left, top, right, bottom = window
    shape = (bottom - top, right - left, len(samples))
    inverse_depth = scratch("inverse_depth", shape, np.float32)
    ids = scratch("ids", shape, np.int32)
    ids.fill(-1)
    if scene.plane is None:
        inverse_depth.fill(0.0)
    else:
        inverse = inverse_depth_of(scene.plane, scene.K)
        clear_to_plane(inverse, (left, top), samples, NEAR, inverse_depth)
    for item, seen, first in zip(scene.objects, projected, _first_ids(scene), strict=True):
        surface = item.surface
        rasterise(
            seen.hom, surface.faces, surface.closed, NEAR, (left, top), samples, inverse_depth,
            ids, first,
        )  # fmt: skip
    return inverse_depth, ids


def _first_ids(scene: Scene) -> Array:
    counts = [len(item.surface.faces) for item in scene.objects]
    return np.concatenate([[0], np.cumsum(counts)])[: len(counts)].astype(np.int64)
