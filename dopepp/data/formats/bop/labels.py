"""What BOP stores of an image, from a sample: camera, poses, silhouettes, boxes, pixel counts.

The definitions of ``scene_gt_info.json`` are those of BOP's own toolkit: a box is (x, y, width,
height) with width and height the differences of the outermost pixels' coordinates (a single pixel
has width 0), −1 for an object of which no pixel is visible, and the silhouette counts beyond the
image's border.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt16

from dopepp.data.formats.bop.images import depth_units
from dopepp.data.formats.bop.records import MM
from dopepp.data.formats.tolerances import Box
from dopepp.data.sample import Instance, Sample
from dopepp.parts.part import Part
from dopepp.virtual.renderers.raster.rasteriser import Silhouette, silhouette
from dopepp.virtual.scene import SceneObject
from dopepp.virtual.surface import Surface

Record = dict[str, Any]
NO_BOX = [-1, -1, -1, -1]


@dataclass(frozen=True)
class Labels:
    """An image's annotation as BOP's JSON and images hold it.

    Attributes:
        camera: ``cam_K`` and ``depth_scale``.
        truths: One ``scene_gt`` record per instance.
        infos: One ``scene_gt_info`` record per instance.
        depth: Units of ``depth_scale`` mm, 0 where unknown.
        masks: Whole silhouettes within the image.
        visible_masks: Visible pixels.
    """

    camera: Record
    truths: list[Record]
    infos: list[Record]
    depth: UInt16[np.ndarray, "height width"]
    masks: list[Bool[np.ndarray, "height width"]]
    visible_masks: list[Bool[np.ndarray, "height width"]]


def make_labels(
    sample: Sample, object_ids: Mapping[str, int], parts: Mapping[str, tuple[Part, Surface]]
) -> Labels:
    """Annotate a sample.

    Args:
        sample: An image with depth and masks.
        object_ids: BOP's object number by label.
        parts: Part and surface by label.

    Raises:
        ValueError: The sample has no depth, an instance has no mask, or a label is unknown.
    """
    unknown = sorted({item.label for item in sample.instances} - object_ids.keys())
    if unknown:
        raise ValueError(f"instances of {unknown}, parts {sorted(object_ids)}")
    if sample.depth is None:
        raise ValueError(f"a sample without depth: {sample.key}")
    visible = [_mask(item) for item in sample.instances]
    covered = np.zeros(sample.depth.shape, bool)
    for mask in visible:
        covered |= mask
    depth, scale = depth_units(sample.depth, covered)
    wholes = [
        silhouette(_posed(item, *parts[item.label]), sample.K, sample.size)
        for item in sample.instances
    ]
    infos = [
        _info(item, mask, whole, depth)
        for item, mask, whole in zip(sample.instances, visible, wholes, strict=True)
    ]
    return Labels(
        {"cam_K": np.asarray(sample.K, np.float64).ravel().tolist(), "depth_scale": scale},
        [_truth(item, object_ids[item.label]) for item in sample.instances],
        infos,
        depth,
        [whole.mask for whole in wholes],
        visible,
    )


def _mask(instance: Instance) -> Bool[np.ndarray, "height width"]:
    if instance.mask is None:
        raise ValueError(f"an instance of {instance.label} without a mask")
    return instance.mask


def _posed(instance: Instance, part: Part, surface: Surface) -> SceneObject:
    return SceneObject(surface, instance.T_cam_obj, part=part)


def _truth(instance: Instance, object_id: int) -> Record:
    T: Float[np.ndarray, "4 4"] = np.asarray(instance.T_cam_obj, np.float64)
    return {
        "cam_R_m2c": T[:3, :3].ravel().tolist(),
        "cam_t_m2c": (T[:3, 3] * MM).tolist(),
        "obj_id": object_id,
    }


def _info(
    instance: Instance,
    visible: Bool[np.ndarray, "height width"],
    whole: Silhouette,
    depth: UInt16[np.ndarray, "height width"],
) -> Record:
    seen, inside = Box.of_mask(visible), Box.of_mask(whole.mask)
    return {
        "bbox_obj": NO_BOX if seen is None else _bop_box(_beyond_the_border(inside, whole)),
        "bbox_visib": _bop_box(seen),
        # A silhouette around the camera has no finite size: its pixels within the image stand.
        "px_count_all": int(whole.num_px if math.isfinite(whole.num_px) else whole.mask.sum()),
        "px_count_valid": int(np.count_nonzero(depth[whole.mask])),
        "px_count_visib": int(np.count_nonzero(visible)),
        "visib_fract": float(instance.visible_fraction),
    }


def _bop_box(box: Box | None) -> list[int]:
    """Return BOP's (x, y, width, height)."""
    if box is None:
        return NO_BOX
    return [int(n) for n in (box.left, box.top, box.right - box.left, box.bottom - box.top)]


def _beyond_the_border(inside: Box | None, whole: Silhouette) -> Box | None:
    """Return the outermost pixels of a silhouette, those beyond the image included.

    Its box bounds the vertices; where no vertex lies beyond the border, the pixels are exact.
    """
    if inside is None or whole.box is None:
        return inside
    height, width = whole.mask.shape
    left, top, right, bottom = whole.box[0], whole.box[1], whole.box[2] - 1, whole.box[3] - 1
    return Box(
        left if left < 0 else inside.left,
        top if top < 0 else inside.top,
        right if right >= width else inside.right,
        bottom if bottom >= height else inside.bottom,
    )
