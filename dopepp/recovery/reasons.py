"""Reasons why objects, and candidates of objects, are not detected.

To add a reason, add its kind to :data:`KINDS`, in the order of the steps of the recovery.
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
from dopepp.geometry.pnp import PnPResult
from dopepp.recovery.association import KeypointGroup
from dopepp.recovery.detection import Detection, RecoveryOptions

Kind = Literal["empty", "centroid", "small", "pose", "score", "refined"]

KINDS: Final[dict[Kind, str]] = {
    "empty": "with empty maps (best belief {best:.2g})",
    "centroid": "without a centroid (best belief {best:.2g})",
    "small": "with too small a part (best belief {best:.2g})",
    "pose": "without a pose that fits (best belief {best:.2g})",
    "score": "below the threshold (best score {best:.3g})",
    "refined": "below the threshold once refined (best score {best:.3g})",
}
"""Kinds of reasons, in the order of the steps, each with its text in :func:`summary`."""

MIN_CELLS: Final = 3.0  # The peaks of a part that extends over fewer cells overlap


@dataclass(frozen=True)
class Reason:
    """Why an object, or one candidate of it, is not detected.

    Attributes:
        object: Name of the object.
        kind: Step that rejected the candidate, a key of :data:`KINDS`.
        best: Score of the candidate; without a pose, its centroid's belief; without a candidate,
            the highest belief of the object's centroid map or, if all nine are empty, of all nine.
        text: Explanation in words.
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
    """Return the reason for an object without a peak above ``options.centroid_threshold``."""
    best = torch.nan_to_num(beliefs.detach().float()).flatten(1).amax(1)
    highest, centroid = float(best.max()), float(best[CENTROID])
    if highest <= options.peak_threshold:
        return Reason(name, "empty", highest, f"its maps are empty, no belief above {highest:.2g}")
    threshold = max(options.centroid_threshold, options.peak_threshold)
    text = f"best belief of a centroid {centroid:.2g} below {threshold:g}"
    return Reason(name, "centroid", centroid, text)


def rejected(
    name: str,
    group: KeypointGroup,
    result: PnPResult,
    detection: Detection | None,
    options: RecoveryOptions,
    cells: tuple[int, int],
    stride: int,
) -> Reason:
    """Return the reason for rejecting a candidate; ``cells`` is the (width, height) of the maps."""
    kind: Kind = "pose"
    best, text, points = float(np.nan_to_num(group.score[CENTROID])), result.reason, group.position
    if detection is not None:
        kind, best, points = "score", detection.score, detection.keypoints
        text = f"score {best:.3f} below {options.min_score:.3g}"
    points = points[np.isfinite(points).all(1)]
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if len(points) >= 2 and extent < MIN_CELLS * stride:
        kind = "small"
        text += f" (too small: {extent:.0f} px across, a cell of the maps has {stride} px)"
    x, y = group.position[CENTROID]
    size = f"{stride * cells[0]}×{stride * cells[1]}"  # size of the network's input
    return Reason(name, kind, best, f"at pixel ({x:.0f}, {y:.0f}) of {size}: {text}")


def refined_reason(detection: Detection, min_score: float) -> Reason:
    """Return the reason for dropping a refined detection whose score is below ``min_score``."""
    text = f"once refined, score {detection.score:.3f} below {min_score:.3g}"
    text += f" ({detection.kept})" if detection.kept else ""
    return Reason(detection.object, "refined", detection.score, text)


def main_reasons(reasons: Sequence[Reason]) -> list[Reason]:
    """Return each object's reason of the latest step and highest ``best``, latest step last."""
    order = list(KINDS)
    best: dict[str, Reason] = {}
    for reason in sorted(reasons, key=lambda reason: (order.index(reason.kind), reason.best)):
        best.pop(reason.object, None)
        best[reason.object] = reason
    return list(best.values())


def format_reasons(reasons: Sequence[Reason]) -> str:
    """Return the main reason of each object on one image as a line of text, latest step first."""
    counts = Counter(reason.object for reason in reasons)
    lines = []
    for reason in reversed(main_reasons(reasons)):
        count = counts[reason.object]
        lines.append(f"{reason} (the best of {count})" if count > 1 else str(reason))
    return "; ".join(lines)


def summary(silent: Sequence[Reason], num_images: int) -> str:
    """Return a line of text with the number of reasons of each kind and their highest ``best``.

    Args:
        silent: The main reason of each image without detections.
        num_images: Number of all images.
    """
    groups = []
    for kind, words in KINDS.items():
        values = [reason.best for reason in silent if reason.kind == kind]
        if values:
            groups.append(f"{len(values)} {words.format(best=max(values))}")
    return f"{len(silent)} of {num_images} images without detections: {', '.join(groups)}"
