"""At which scales a network looks at a picture: it knows a part in a range of sizes only.

A part of diameter d at depth z is d·f/z pixels long in a picture of focal length f. The network has
seen it from ``smallest_px`` to ``largest_px`` long, so a picture is resized until the parts that
are looked for have such sizes; where their distances vary more than the network's did, several
times.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Literal

import numpy as np

from dopepp.core.checks import check_range
from dopepp.drawing.pictures import Picture, Size
from dopepp.geometry.camera import CameraMatrix, Letterbox, focal_length
from dopepp.models.checkpoint import Checkpoint
from dopepp.parts.size import Seen
from dopepp.recovery.detection import Detection

Distances = tuple[float, float] | Literal["any"]
"""Nearest and farthest depth, metres; ``any``: wherever the network can see a part."""

MAX_PIXELS: Final = 640 * 480
"""Of a resized picture: a part too small for that is not looked for."""

MARGIN: Final = 1.1
"""Factor on a size that makes no difference to a network."""


def letterboxes(
    checkpoint: Checkpoint, K: CameraMatrix, image: Picture, distances: Distances | None = None
) -> list[Letterbox]:
    """Return the sizes in which a network looks at an image, the smallest first.

    Without ``distances`` it looks where training had the parts, and at the whole image in the size
    of the training's, which shows parts that fill it; for the training's camera both are one. A
    checkpoint that does not know distances has the second look only. A :class:`UserError`: the
    distances are no range of metres.
    """
    size = image.shape[1], image.shape[0]
    learned = Letterbox.fit(size, checkpoint.input_size)
    scales: list[float] = []
    for part in checkpoint.parts:
        if part.name in checkpoint.seen:
            seen, reach = checkpoint.seen[part.name], part.diameter * focal_length(K)
            scales += _scales(seen, reach, _depths(seen, reach, size, distances))
    if not scales or distances is None:
        scales.append(learned.scale_x)
    boxes: list[Letterbox] = []
    for scale in sorted(scales):
        if boxes and scale < MARGIN * boxes[-1].scale_x:
            continue
        # The training's camera gets the training's size to the pixel.
        same = 1 / MARGIN < scale / learned.scale_x < MARGIN
        boxes.append(learned if same else Letterbox.scaled(size, scale))
    fitting = [one for one in boxes if one.width * one.height <= MAX_PIXELS]
    return fitting or [Letterbox.scaled(size, math.sqrt(MAX_PIXELS / (size[0] * size[1])))]


def merged(scales: Sequence[Sequence[Detection]]) -> list[Detection]:
    """Return the detections of all scales, the best one of each instance, best score first.

    Two of different scales are of one instance where their centres are nearer than half the larger
    one's extent.
    """
    ranked = [(one, number) for number, found in enumerate(scales) for one in found]
    ranked.sort(key=lambda pair: -pair[0].score)
    kept: list[tuple[Detection, int]] = []
    for one, number in ranked:
        others = (other for other, scale in kept if scale != number)
        if not any(_are_same(one, other) for other in others):
            kept.append((one, number))
    return [one for one, _ in kept]


def _depths(
    seen: Seen, reach: float, size: Size, distances: Distances | None
) -> tuple[float, float]:
    """Return the nearest and farthest depth to look at, metres.

    ``reach`` is how many pixels long the part is at one metre. Anywhere is from where it fills the
    picture to where it is as small as was learned, in the picture as it is or as MAX_PIXELS allow.
    """
    if distances is None:
        return seen.nearest, seen.farthest
    if distances == "any":
        scale = min(1.0, math.sqrt(MAX_PIXELS / (size[0] * size[1])))
        nearest = reach / min(size)
        return nearest, max(nearest, reach * scale / seen.smallest_px)
    check_range("distances", tuple(distances), 0.001, 1000.0, "metres")
    return distances


def _scales(seen: Seen, reach: float, depths: tuple[float, float]) -> Sequence[float]:
    """Return the fewest factors on a picture's sides that show a part in sizes that were learned.

    At the middle depth of its range each shows the part in the middle size.
    """
    near, far = depths
    learned = math.log(MARGIN**2 * seen.largest_px / seen.smallest_px)
    count = max(1, math.ceil(math.log(far / near) / learned))
    middles = near * (far / near) ** ((np.arange(count) + 0.5) / count)
    scales: list[float] = (math.sqrt(seen.smallest_px * seen.largest_px) * middles / reach).tolist()
    return scales


def _are_same(one: Detection, other: Detection) -> bool:
    apart = np.linalg.norm(one.keypoints[-1] - other.keypoints[-1])
    extent = max(np.ptp(each.keypoints[:-1], axis=0).max() for each in (one, other))
    return one.object == other.object and bool(apart < extent / 2)
