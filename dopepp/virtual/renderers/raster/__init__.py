"""The rasteriser: renders a scene's image, depth, instances and visible fractions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, Int16

from dopepp.core.compiled import Array, compiled
from dopepp.drawing.pictures import Mask, Size
from dopepp.geometry.camera import resize_camera
from dopepp.virtual.renderers.raster.plane import darken_plane
from dopepp.virtual.renderers.raster.shading import shade_object
from dopepp.virtual.renderers.raster.visibility import (
    Box,
    Projection,
    Samples,
    backdrop,
    box_around,
    centres_within,
    draw_alone,
    draw_samples,
    first_ids,
    project_object,
    shadow_maps,
)
from dopepp.virtual.scene import NEAR, Rendered, Scene, SceneObject
from dopepp.virtual.triangles import (
    CENTRE_SAMPLE,
    NUM_COLOUR_SAMPLES,
    PIXEL_SAMPLES,
    bounds,
    scratch,
)

_MAX_PX: Final = 1_000_000  # a whole silhouette in a larger box is counted at a reduced scale


def render(scene: Scene) -> Rendered:
    """Render a scene with 2×2 anti-aliasing; return the background of a scene without objects."""
    image, depth, instances = backdrop(scene)
    projections = [project_object(item, scene.K) for item in scene.objects]
    window = box_around(projection.box(scene.size) for projection in projections) or (0, 0, 0, 0)
    lights = shadow_maps(scene, projections) if scene.objects else []
    samples = draw_samples(scene, projections, window, PIXEL_SAMPLES)
    if scene.plane is not None:
        darken_plane(scene, scene.plane, lights, samples, image)
    colour = scratch("colour", (*samples.ids.shape[:2], 3), np.float32)
    colour.fill(0.0)
    firsts = first_ids(scene)
    for item, projection, first in zip(scene.objects, projections, firsts, strict=True):
        shade_object(item, projection, scene, lights, samples, int(first), colour)
    _composite(samples, colour, firsts, image, depth, instances)
    return Rendered(image, depth, instances, _fractions(scene, projections, instances), scene)


@dataclass(frozen=True, eq=False)
class Silhouette:
    """The pixels of an unoccluded object."""

    mask: Mask  # Whether each image pixel shows the object
    # Number of pixels on an unbounded canvas; infinite if the object reaches the camera.
    num_px: float
    # Bounds of the pixels, possibly beyond the image; None if it is behind the camera.
    box: Box | None


def silhouette(item: SceneObject, K: Array, size: Size) -> Silhouette:
    """Return the silhouette of an object without occluders, which e.g. BOP stores as ``mask``."""
    projection = project_object(item, K)
    mask = draw_alone(item, projection.hom, (0, 0, *size))[0] > 0
    left, _, right, _ = projection.extent
    if left > right:
        return Silhouette(mask, 0.0, None)
    if not math.isfinite(left):
        return Silhouette(mask, math.inf, (0, 0, *size))
    whole = float(mask.sum()) if projection.inside(size) else _count_whole_px(item, projection, K)
    return Silhouette(mask, whole, centres_within(projection.extent))


def visible_fractions(scene: Scene) -> Float[np.ndarray, "objects"]:
    """Return each object's visible fraction as in :func:`render`, without computing colours."""
    projections = [project_object(item, scene.K) for item in scene.objects]
    samples = draw_samples(scene, projections, (0, 0, *scene.size), CENTRE_SAMPLE)
    owners = np.searchsorted(first_ids(scene), samples.ids[..., 0], side="right") - 1
    return _fractions(scene, projections, owners.astype(np.int16))


def _fractions(
    scene: Scene, projections: Sequence[Projection], instances: Int16[np.ndarray, "height width"]
) -> Float[np.ndarray, "objects"]:
    """Return the visible share of each object's whole silhouette."""
    visible = np.bincount(instances.reshape(-1) + 1, minlength=len(projections) + 1)[1:]
    fractions = np.zeros(len(projections))
    for index in np.flatnonzero(visible).tolist():
        item, projection = scene.objects[index], projections[index]
        if projection.inside(scene.size):
            # Pixels can be hidden only where another object may be in front.
            left, top, right, bottom = _occluder_box(scene, projections, index) or (0, 0, 0, 0)
            covered = draw_alone(item, projection.hom, (left, top, right, bottom))[0] > 0
            hidden = int((covered & (instances[top:bottom, left:right] != index)).sum())
            fractions[index] = visible[index] / (visible[index] + hidden)
        else:
            whole = _count_whole_px(item, projection, scene.K)
            fractions[index] = min(visible[index] / whole, 1.0) if whole else 1.0
    return fractions


def _occluder_box(scene: Scene, projections: Sequence[Projection], index: int) -> Box | None:
    """Return the box in which other objects or the plane may hide an object, or None."""
    item, whole = scene.objects[index], projections[index].box(scene.size)
    if whole is None:
        return None
    if scene.plane is not None:
        normal = np.array(scene.plane.normal) @ item.T_cam_obj[:3, :3]
        offset = scene.plane.offset - float(np.dot(scene.plane.normal, item.T_cam_obj[:3, 3]))
        if (item.surface.hull @ normal).min() < offset:  # the object extends below the plane
            return whole
    # An object hides nothing if its nearest point lies behind the farthest point of this object.
    depths = [_depths(other) for other in scene.objects]
    boxes = []
    for number, projection in enumerate(projections):
        box = projection.box(scene.size) if depths[number][0] < depths[index][1] else None
        if number != index and box is not None:
            left, top = max(whole[0], box[0]), max(whole[1], box[1])
            right, bottom = min(whole[2], box[2]), min(whole[3], box[3])
            boxes.append((left, top, right, bottom) if left < right and top < bottom else None)
    return box_around(boxes)


def _depths(item: SceneObject) -> tuple[float, float]:
    """Return the smallest and largest depth of an object, metres, with 2 % of margin each."""
    depth = item.surface.hull @ item.T_cam_obj[2, :3] + item.T_cam_obj[2, 3]
    least, most = float(depth.min()), float(depth.max())
    # The hull's extreme points miss a little of a round object.
    slack = 0.02 * (most - least)
    return least - slack, most + slack


def _count_whole_px(item: SceneObject, projection: Projection, K: Array) -> float:
    """Count an unoccluded object's pixels on an unbounded canvas; inf if it is at the camera."""
    left, top, right, bottom = projection.extent
    if not math.isfinite(left):
        return math.inf  # the object reaches the camera
    hom, scale, extent = projection.hom, 1.0, projection.extent
    if (right - left + 2) * (bottom - top + 2) > _MAX_PX:
        scale = math.sqrt(_MAX_PX / ((right - left + 2) * (bottom - top + 2)))
        hom = projection.cam @ resize_camera(K, scale, scale).T
        extent = bounds(hom, NEAR)
    return float(np.count_nonzero(draw_alone(item, hom, centres_within(extent))[0])) / scale**2


@compiled()
def _composite(
    samples: Samples, colour: Array, first_ids: Array, image: Array, depth: Array, instances: Array
) -> None:
    """Composite ``colour``, sums of sRGB samples, over ``image``; write depth and instances."""
    origin, inverse_depth, ids = samples
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
