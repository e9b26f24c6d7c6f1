"""Maps to peaks: batched local maxima with sub-cell positions, their covariances and vectors.

Maxima are found where the maps are. Only they and the cells around them come to the host, in one
transfer, to be fitted there (:mod:`dopepp.maps.gaussian`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from dopepp.geometry.cuboid import NUM_CORNERS, NUM_KEYPOINTS
from dopepp.maps.encode import Fields, MapGeometry
from dopepp.maps.gaussian import fit_peaks

REACH: Final = 2.5
"""Half-width of the neighbourhood a peak is fitted to, in standard deviations of a perfect peak:
it shows the flanks of a clamped top; what lies beyond adds more noise than knowledge."""

HALF_WIDTHS: Final = (2, 4)
"""Least and greatest half-width, cells: a fit needs 5×5 cells, and 9×9 determine any."""

TIE_BREAK: Final = 1e-11
"""Weight of the neighbourhood's sum (at most 25) among equal cells: less than the 2e-9 by which
float32 beliefs of the lowest useful threshold, 0.02, can differ."""

_SPAN: Final = range(-2, 3)


@dataclass(frozen=True)
class Peaks:
    """The strongest local maxima of every channel, strongest first, on the host.

    Attributes:
        position: (x, y) in input pixels; NaN where there is none.
        score: Belief at the peak's cell; 0 where there is none.
        covariance_px: Of the position, pixels²: the variance by which the peak is wider than a
            perfect one, and that of the fit. A network trained with a proper loss returns the
            target Gaussian blurred by its own uncertainty, so variances subtract.
        toward: Mean of the field's vectors around a corner's peak; zeros for a centroid. A field
            trained with squared error is the mean of unit vectors, so the more they spread, the
            shorter it is.
        found: False where a channel has fewer peaks than slots.
    """

    position: Float[np.ndarray, "batch channels peaks 2"]
    score: Float[np.ndarray, "batch channels peaks"]
    covariance_px: Float[np.ndarray, "batch channels peaks 2 2"]
    toward: Float[np.ndarray, "batch channels peaks 2"]
    found: Bool[np.ndarray, "batch channels peaks"]


def find_peaks(
    belief: Float[Tensor, "batch channels height width"],
    geometry: MapGeometry,
    threshold: float = 0.05,
    max_peaks: int = 16,
    field: Fields | None = None,
) -> Peaks:
    """Find up to ``max_peaks`` local maxima above ``threshold`` in each channel.

    A peak is a cell not below its eight neighbours. Of equal cells, as on the flat top of a clamped
    belief, it is the one with the highest neighbourhood, which is the middle one; if these are
    equal too, the first in raster order. Its position is that of a Gaussian fitted around it.

    With a field, which has 16 channels of each object, the belief has nine of each; without it,
    peaks have no vectors.
    """
    belief = belief.detach().float()
    height, width = belief.shape[-2:]
    is_peak = _local_maxima(belief) & (belief > threshold) & torch.isfinite(belief)
    count = min(max_peaks, height * width)
    score, index = torch.where(is_peak, belief, -torch.inf).flatten(2).topk(count, dim=-1)
    half = min(max(math.ceil(REACH * geometry.sigma), HALF_WIDTHS[0]), HALF_WIDTHS[1])
    parts = [index[..., None].float(), score[..., None], _windows(belief, index, half)]
    if field is not None:
        disc = math.ceil(geometry.field_radius)
        parts.append(_field_windows(field.detach().float(), index, disc))
    # Indices are whole numbers below 2²⁴, which float32 holds.
    table = torch.cat(parts, -1).cpu().numpy()
    return _fit(table, width, half, geometry)


def _local_maxima(
    belief: Float[Tensor, "batch channels height width"],
) -> Bool[Tensor, "batch channels height width"]:
    """Mark cells that are the highest of their 3×3 neighbourhood, one of every set of equals."""
    height, width = belief.shape[-2:]
    # A sum along one axis, then along the other: a fifth of `avg_pool2d`'s time.
    around = functional.pad(belief, (2,) * 4)
    around = sum(
        (around[..., 2 + k : 2 + k + height, :] for k in _SPAN[1:]), around[..., :height, :]
    )
    around = sum((around[..., 2 + k : 2 + k + width] for k in _SPAN[1:]), around[..., :width])
    # Both numbers fit into one float64 key, so that one comparison orders them lexicographically.
    key = belief.double() + TIE_BREAK * around.double()
    padded = functional.pad(key, (1, 1, 1, 1), value=-torch.inf)
    highest = torch.ones_like(belief, dtype=torch.bool)
    for dy, dx in ((-1, -1), (-1, 0), (-1, 1), (0, -1)):
        before = padded[..., 1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
        after = padded[..., 1 - dy : 1 - dy + height, 1 - dx : 1 - dx + width]
        highest &= (key > before) & (key >= after)
    return highest


def _windows(
    maps: Float[Tensor, "*channels height width"], index: Int[Tensor, "*channels peaks"], half: int
) -> Float[Tensor, "*channels peaks cells"]:
    """Read the cells around each index, row by row; NaN outside of the map."""
    width = maps.shape[-1]
    wide = width + 2 * half
    padded = functional.pad(maps, (half,) * 4, value=torch.nan).flatten(-2)
    span = torch.arange(2 * half + 1, device=maps.device)
    around = (span[:, None] * wide + span).flatten()
    first = index.div(width, rounding_mode="floor") * wide + index % width
    cells = first[..., None] + around
    return padded.gather(-1, cells.flatten(-2)).view(cells.shape)


def _field_windows(
    field: Fields, index: Int[Tensor, "batch channels peaks"], half: int
) -> Float[Tensor, "batch channels peaks cells"]:
    """Read the vectors around each peak, all x before all y; zeros for a centroid."""
    batch, channels, count = index.shape
    corners = index.view(batch, -1, NUM_KEYPOINTS, 1, count)[:, :, :NUM_CORNERS]
    vectors = field.reshape(batch, -1, NUM_CORNERS, 2, *field.shape[-2:])
    read = _windows(vectors, corners.expand(-1, -1, -1, 2, -1), half)
    read = functional.pad(read.transpose(3, 4).flatten(-2), (0, 0, 0, 0, 0, 1))
    return read.reshape(batch, channels, count, -1)


def _fit(
    table: Float[np.ndarray, "batch channels peaks columns"],
    width: int,
    half: int,
    geometry: MapGeometry,
) -> Peaks:
    """Fit the peaks of every channel; see :func:`find_peaks` for the table's columns."""
    slots = table.shape[:3]
    found = table[..., 1] > -np.inf
    position, covariance = np.full((*slots, 2), np.nan), np.full((*slots, 2, 2), np.nan)
    toward = np.zeros((*slots, 2))
    fit_peaks(
        table.reshape(-1, *table.shape[2:]), width, half, geometry.sigma, geometry.field_radius,
        position.reshape(-1, slots[2], 2), covariance.reshape(-1, slots[2], 2, 2),
        toward.reshape(-1, slots[2], 2),
    )  # fmt: skip
    return Peaks(
        position * geometry.stride + (geometry.stride - 1) / 2,
        np.where(found, table[..., 1], 0.0).astype(np.float64),
        covariance * geometry.stride**2,
        toward,
        found,
    )
