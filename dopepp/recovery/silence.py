"""Why nothing was found: what recovery left out of a picture, and how far it got.

To tell a further reason, name its kind in :data:`KINDS`, where the way from maps to poses has it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dopepp.geometry.cuboid import CENTROID
from dopepp.recovery.association import KeypointGroup
from dopepp.recovery.calibration import RecoveryOptions
from dopepp.recovery.detection import Detection

Kind = Literal["empty", "centroid", "small", "pose", "score", "refined"]

KINDS: Final[dict[Kind, str]] = {
    "empty": "with empty maps (best belief {best:.2g})",
    "centroid": "without a centroid (best belief {best:.2g})",
    "small": "with too small a part (best belief {best:.2g})",
    "pose": "without a pose that fits (best belief {best:.2g})",
    "score": "below the threshold (best score {best:.3g})",
    "refined": "below the threshold once refined (best score {best:.3g})",
}
"""What ends the way from maps to poses, in its order, as a summary says it."""

LEAST_CELLS: Final = 3.0
"""Extent of an object's keypoints below which its maps are one blot, cells."""


@dataclass(frozen=True)
class Reason:
    """Why an object, or one candidate of it, is no detection.

    Attributes:
        object: The part's name.
        kind: What ended it.
        best: The belief or the score that it reached.
        text: In words, with the threshold.
    """

    object: str
    kind: Kind
    best: float
    text: str

    def __str__(self) -> str:
        return f"{self.object}: {self.text}"


def no_centroid(
    beliefs: Float[Tensor, "9 height width"], name: str, options: RecoveryOptions
) -> Reason:
    """Say how close an object without any centroid came to one."""
    best = torch.nan_to_num(beliefs.detach().float()).flatten(1).amax(1)
    if float(best.max()) <= options.peak_threshold:
        text = f"its maps are empty, no belief above {float(best.max()):.2g}"
        return Reason(name, "empty", float(best.max()), text)
    centroid, least = float(best[CENTROID]), options.centroid_threshold
    text = f"best belief of a centroid {centroid:.2g}, {least:g} is the least"
    return Reason(name, "centroid", centroid, text)


def no_pose(group: KeypointGroup, why: str, name: str, where: str, stride: int) -> Reason:
    """Say why a group of keypoints has no pose."""
    best = float(np.nan_to_num(group.score[CENTROID]))
    return _candidate(name, "pose", best, f"{where}: {why}", group.position, stride)


def low_score(one: Detection, least: float, where: str, stride: int) -> Reason:
    """Say by how much a detection's score is too low."""
    text = f"{where}: score {one.score:.3f} below {least:g}"
    return _candidate(one.object, "score", one.score, text, one.keypoints, stride)


def rejected_refined(one: Detection, least: float) -> Reason:
    """Say why a refined detection was dropped."""
    text = f"once refined, score {one.score:.3f} below {least:g}"
    return Reason(one.object, "refined", one.score, f"{text} ({one.kept})" if one.kept else text)


def _candidate(
    name: str, kind: Kind, best: float, text: str, points: Float[np.ndarray, "9 2"], stride: int
) -> Reason:
    """Tell a part that is too small for the maps from one that is not."""
    points = points[np.isfinite(points).all(1)]
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if len(points) < 2 or extent >= LEAST_CELLS * stride:
        return Reason(name, kind, best, text)
    cell = f"{extent:.0f} px across, where a cell of the maps has {stride}"
    return Reason(name, "small", best, f"{text} (too small: {cell})")


def furthest(reasons: Sequence[Reason]) -> list[Reason]:
    """Return of every object the reason that ended its best candidate, the best one last."""
    order = list(KINDS)
    best: dict[str, Reason] = {}
    for one in sorted(reasons, key=lambda one: (order.index(one.kind), one.best)):
        best.pop(one.object, None)
        best[one.object] = one
    return list(best.values())


def explained(reasons: Sequence[Reason]) -> str:
    """Return one line on a picture where nothing was found."""
    number = Counter(one.object for one in reasons)
    lines = []
    for one in reversed(furthest(reasons)):
        several = number[one.object] > 1
        lines.append(f"{one}" + f" (the best of {number[one.object]})" * several)
    return "; ".join(lines)


def summary(silent: Sequence[Reason], num_images: int) -> str:
    """Return one line on the pictures of many where nothing was found: a reason of each."""
    groups = []
    for kind, words in KINDS.items():
        own = [one.best for one in silent if one.kind == kind]
        if own:
            groups.append(f"{len(own)} {words.format(best=max(own))}")
    return f"{len(silent)} of {num_images} images silent: {', '.join(groups)}"
