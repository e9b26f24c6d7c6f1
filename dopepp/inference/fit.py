"""How well a posed part fits a depth image, and when that is too little to believe it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from dopepp.inference.depth_view import GATE, DepthView, lay_over
from dopepp.inference.outline import continues
from dopepp.inference.visible import SurfacePoints

LEAST_INLIERS: Final = 0.5
"""Of the points with depth that nothing stands before."""

LEAST_SEEN: Final = 0.25
"""Of the visible points that must have agreeing depth at all."""

MOST_RMS: Final = 2.0
"""Standard deviations of the depth: a right pose leaves about one."""

CLOSE: Final = 5.0
"""Spacings before a part up to which nothing else is expected."""

BESIDE: Final = 3.0
"""Spacings around the part in which its surface must not go on."""


@dataclass(frozen=True)
class Fit:
    """Agreement of a pose with depth.

    Attributes:
        inliers: Share that agrees among the points with depth that nothing stands before.
        seen: Share that agrees among all points that the part itself does not hide.
        rms: Of the agreeing points' offsets, in standard deviations of the depth.
        uncovered: Area beside the part that goes on as its surface does, over the part's own.
    """

    inliers: float
    seen: float
    rms: float
    uncovered: float

    @property
    def score(self) -> float:
        """One number to compare poses by."""
        return self.seen - (1.0 - self.inliers) - self.uncovered

    def doubt(self, before: Fit) -> str:
        """Say why not to believe this fit rather than the one before; empty where there is none."""
        if self.inliers < LEAST_INLIERS:
            return f"only {self.inliers:.0%} of the part agrees with the depth"
        if self.seen < LEAST_SEEN:
            return f"only {self.seen:.0%} of the part is measured and unobstructed"
        if self.rms > MOST_RMS:
            return f"a residual of {self.rms:.1f} standard deviations of the depth"
        if self.score <= before.score:
            return "the depth fits the given pose no worse"
        return ""


def fit_of(
    view: DepthView,
    surface: SurfacePoints,
    T_cam_obj: Float[np.ndarray, "4 4"],
    seen: Bool[np.ndarray, "points"],
) -> Fit:
    """Measure the agreement of a pose, and of the points it shows, with a depth view."""
    overlay = lay_over(view, surface, seen, T_cam_obj)
    if overlay is None:
        return Fit(0.0, 0.0, np.inf, 0.0)
    gate = GATE * view.noise
    offset = overlay.at_points
    agree = np.abs(offset) <= gate
    # What lies just before a part is more often the part itself, elsewhere, than something else.
    wrong = (offset > gate) | ((offset < -gate) & (offset > -CLOSE * surface.spacing))
    count = int(agree.sum())
    if count == 0:
        return Fit(0.0, 0.0, np.inf, 0.0)
    beside = continues(view, overlay, BESIDE).sum()
    return Fit(
        inliers=count / (count + int(wrong.sum())),
        seen=count / int(seen.sum()),
        rms=float(np.sqrt(np.mean(offset[agree] ** 2))) / view.noise,
        uncovered=float(beside / max(1, (overlay.distance <= 1.0).sum())),
    )
