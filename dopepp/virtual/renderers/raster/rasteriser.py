"""The rasteriser: a scene becomes an image, its depth, its instances and visible fractions.

The picture: fragments summed up in their pixels, samples over the background, and labels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from dopepp.core.compiled import Array
from dopepp.virtual.renderers.raster.coverage import Silhouette, fractions_of, silhouette
from dopepp.virtual.renderers.raster.picture import composite
from dopepp.virtual.renderers.raster.plane import (
    clear_to_plane,
    darken_plane,
    inverse_depth_of,
    plane_depth,
)
from dopepp.virtual.renderers.raster.projection import Projected, project_object
from dopepp.virtual.renderers.raster.shading import ambient_row, shade_object
from dopepp.virtual.renderers.raster.shadow import shadow_maps
from dopepp.virtual.renderers.raster.visibility import (
    CENTRE_SAMPLE,
    PIXEL_SAMPLES,
    rasterise,
    scratch,
)
from dopepp.virtual.scene import NEAR, Rendered, Scene

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
