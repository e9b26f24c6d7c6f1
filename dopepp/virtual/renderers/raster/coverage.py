"""Coverage: whole silhouettes of objects, and the share of them that can be seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int16

from dopepp.core.compiled import Array
from dopepp.geometry.camera import resize_camera
from dopepp.virtual.renderers.raster.projection import Box, Projected, project_object
from dopepp.virtual.renderers.raster.visibility import CENTRE_SAMPLE, bounds, rasterise
from dopepp.virtual.scene import NEAR, Plane, Scene, SceneObject

_MOST_PX: Final = 1_000_000
"""A full silhouette whose box is larger than this is counted at a reduced scale."""

_HULL_SLACK: Final = 0.02
"""Share of an object's depth by which its hull's points may fall short of its vertices."""


@dataclass(frozen=True, eq=False)
class Silhouette:
    """What an object would cover if nothing stood before it.

    Attributes:
        mask: Its pixels within the image.
        num_px: Its pixels on a canvas without borders; infinite around the camera.
        box: (left, top, right, bottom) of those pixels' bounds, pixels, right and bottom excluded;
            it may reach beyond the image. None behind the camera.
    """

    mask: Bool[np.ndarray, "height width"]
    num_px: float
    box: Box | None


def silhouette(item: SceneObject, K: Array, size: tuple[int, int]) -> Silhouette:
    """Return an object's whole silhouette, for formats that store it (BOP's ``mask``)."""
    seen = project_object(item, K)
    mask = _drawn(item, seen.hom, (0, 0, *size)) > 0
    left, top, right, bottom = seen.extent
    if left > right:
        return Silhouette(mask, 0.0, None)
    if not math.isfinite(left):
        return Silhouette(mask, math.inf, (0, 0, *size))
    box = (math.ceil(left), math.ceil(top), math.floor(right) + 1, math.floor(bottom) + 1)
    whole = float(mask.sum()) if seen.inside(size) else _whole_px(item, seen, K)
    return Silhouette(mask, whole, box)


def fractions_of(
    scene: Scene,
    projected: Sequence[Projected],
    instances: Int16[np.ndarray, "height width"],
) -> Float[np.ndarray, "objects"]:
    """Divide every object's visible pixels by those of its whole silhouette."""
    visible = np.bincount(instances.reshape(-1) + 1, minlength=len(projected) + 1)[1:]
    fractions = np.zeros(len(projected))
    for index, (item, seen) in enumerate(zip(scene.objects, projected, strict=True)):
        if not visible[index]:
            continue
        if seen.inside(scene.size):
            # Only where something else may be before it can a pixel of it be missing.
            box = _rivals(scene, projected, index)
            hidden = 0
            if box is not None:
                left, top, right, bottom = box
                covered = _drawn(item, seen.hom, box) > 0
                hidden = int((covered & (instances[top:bottom, left:right] != index)).sum())
            fractions[index] = visible[index] / (visible[index] + hidden)
        else:
            whole = _whole_px(item, seen, scene.K)
            fractions[index] = min(visible[index] / whole, 1.0) if whole else 1.0
    return fractions


def _rivals(scene: Scene, projected: Sequence[Projected], index: int) -> Box | None:
    """Return the part of an object's box in which other objects or the plane may hide it."""
    own = projected[index].box(scene.size)
    if own is None:
        return None
    if scene.plane is not None and _reaches_below(scene.plane, scene.objects[index]):
        return own
    # Nothing that begins behind its end can hide it.
    farthest = _depths(scene.objects[index])[1]
    boxes = [
        seen.box(scene.size)
        for number, seen in enumerate(projected)
        if number != index and _depths(scene.objects[number])[0] < farthest
    ]
    shared = [
        (max(own[0], box[0]), max(own[1], box[1]), min(own[2], box[2]), min(own[3], box[3]))
        for box in boxes
        if box is not None
    ]
    shared = [box for box in shared if box[0] < box[2] and box[1] < box[3]]
    if not shared:
        return None
    columns = np.array(shared)
    low, high = columns[:, :2].min(axis=0), columns[:, 2:].max(axis=0)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _depths(item: SceneObject) -> tuple[float, float]:
    """Return about the smallest and largest depth of an object, metres; the first too small."""
    depth = item.surface.hull @ item.T_cam_obj[2, :3] + item.T_cam_obj[2, 3]
    least, most = float(depth.min()), float(depth.max())
    # The hull's extreme points miss a little of a round object.
    slack = _HULL_SLACK * (most - least)
    return least - slack, most + slack


def _reaches_below(plane: Plane, item: SceneObject) -> bool:
    """Tell whether some of an object lies on or below the plane."""
    normal = np.array(plane.normal) @ item.T_cam_obj[:3, :3]
    offset = plane.offset - float(np.dot(plane.normal, item.T_cam_obj[:3, 3]))
    return bool((item.surface.hull @ normal).min() < offset)


def _drawn(item: SceneObject, hom: Array, box: Box) -> Array:
    """Return the inverse depth of an object alone at the pixel centres of a box."""
    left, top, right, bottom = box
    canvas = np.zeros((bottom - top, right - left, 1), np.float32)
    ids = np.empty(canvas.shape, np.int32)
    surface = item.surface
    rasterise(hom, surface.faces, surface.closed, NEAR, (left, top), CENTRE_SAMPLE, canvas, ids, 0)
    return canvas[..., 0]


def _whole_px(item: SceneObject, seen: Projected, K: Array) -> float:
    """Count the pixel centres an object covers alone on a canvas as large as it needs."""
    left, top, right, bottom = seen.extent
    if not math.isfinite(left):
        # It surrounds the camera: the whole silhouette is a hemisphere, of no finite size.
        return math.inf
    hom, scale = seen.hom, 1.0
    if (right - left + 2) * (bottom - top + 2) > _MOST_PX:
        scale = math.sqrt(_MOST_PX / ((right - left + 2) * (bottom - top + 2)))
        hom = seen.cam @ resize_camera(K, scale, scale).T
        left, top, right, bottom = bounds(hom, NEAR)
    box = (math.ceil(left), math.ceil(top), math.floor(right) + 1, math.floor(bottom) + 1)
    if box[0] >= box[2] or box[1] >= box[3]:
        return 0.0
    return float(np.count_nonzero(_drawn(item, hom, box))) / scale**2
