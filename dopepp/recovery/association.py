"""From the peaks of one object's maps to groups of keypoints, one group per instance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from dopepp.geometry.cuboid import CENTROID, NUM_CORNERS, NUM_KEYPOINTS


@dataclass(frozen=True)
class ChannelPeaks:
    """The peaks of one keypoint's channel.

    Attributes:
        position: (x, y), input pixels.
        score: Belief at the peak.
        spread_px: Standard deviation of the fitted Gaussian, x and y, pixels.
        toward: The field's vector at the peak, pointing to the centroid; zeros for a centroid.
    """

    position: Float[np.ndarray, "peaks 2"]
    score: Float[np.ndarray, "peaks"]
    spread_px: Float[np.ndarray, "peaks 2"]
    toward: Float[np.ndarray, "peaks 2"]


@dataclass(frozen=True)
class KeypointGroup:
    """The keypoints of one instance; NaN positions and zero scores where a corner is missing."""

    position: Float[np.ndarray, "9 2"]
    score: Float[np.ndarray, "9"]
    spread_px: Float[np.ndarray, "9 2"]


def associate(
    channels: list[ChannelPeaks], max_angle: float, coincident_px: float
) -> list[KeypointGroup]:
    """Group the peaks of one object's nine channels into instances, one per centroid peak.

    Per corner, peaks are assigned to centroids one-to-one by the smallest total of squared angle
    between the field's vector and the direction to the centroid, in units of ``max_angle``, minus
    the logarithm of the belief: the negative log-likelihood of peak and direction together.

    Args:
        channels: Peaks of corners 0–7 and the centroid, in this order.
        max_angle: Largest angle at which a corner may belong to a centroid, radians.
        coincident_px: A corner this close to the centroid has no direction; any angle will do.
    """
    centroids = channels[CENTROID]
    count = len(centroids.score)
    position = np.full((count, NUM_KEYPOINTS, 2), np.nan)
    spread = np.full((count, NUM_KEYPOINTS, 2), np.nan)
    score = np.zeros((count, NUM_KEYPOINTS))
    position[:, CENTROID] = centroids.position
    spread[:, CENTROID] = centroids.spread_px
    score[:, CENTROID] = centroids.score
    for k in range(NUM_CORNERS):
        for peak, instance in _assign(channels[k], centroids, max_angle, coincident_px):
            position[instance, k] = channels[k].position[peak]
            spread[instance, k] = channels[k].spread_px[peak]
            score[instance, k] = channels[k].score[peak]
    return [KeypointGroup(*group) for group in zip(position, score, spread, strict=True)]


def _assign(
    corners: ChannelPeaks, centroids: ChannelPeaks, max_angle: float, coincident_px: float
) -> list[tuple[int, int]]:
    """Pair one corner's peaks with centroids; (peak, centroid) indices."""
    if not len(corners.score) or not len(centroids.score):
        return []
    offset = centroids.position[None] - corners.position[:, None]
    distance = np.linalg.norm(offset, axis=-1)
    cross = (
        offset[..., 0] * corners.toward[:, None, 1] - offset[..., 1] * corners.toward[:, None, 0]
    )
    along = (offset * corners.toward[:, None]).sum(-1)
    angle = np.abs(np.arctan2(cross, along))
    # A vector that is no number, as of a network that diverged, points nowhere.
    angle = np.where(distance < coincident_px, 0.0, np.where(np.isfinite(angle), angle, np.pi))
    allowed = angle <= max_angle
    cost = (angle / max_angle) ** 2 - np.log(corners.score)[:, None]
    # A forbidden pair costs more than any set of allowed ones, so it never displaces one.
    forbidden = 1.0 + 2 * np.abs(cost).sum()
    pairs = zip(*linear_sum_assignment(np.where(allowed, cost, forbidden)), strict=True)
    return [(int(i), int(j)) for i, j in pairs if allowed[i, j]]
