"""Encode keypoints as belief maps and vector fields, and find peaks in maps (DOPE).

:func:`encode` computes the maps of a batch on the device of its keypoints. :func:`find_peaks` runs
compiled code on the CPU: copying an image's maps, a few hundred kilobytes, is faster than many
small operations on a GPU.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dopepp.core.compiled import Array, compiled
from dopepp.geometry.cuboid import CENTROID, NUM_CORNERS, NUM_KEYPOINTS
from dopepp.maps.gaussian import fit_peaks, mean_vectors

Beliefs = Float[Tensor, "batch beliefs height width"]
Fields = Float[Tensor, "batch fields height width"]

REACH: Final = 2.5
"""Half-width of the fitted neighbourhood over the standard deviation of a target peak. It contains
the flanks of a peak whose top is clamped to 1; cells outside add more noise than information."""

HALF_WIDTHS: Final = (2, 4)
"""Limits of the neighbourhood's half-width, cells: a fit needs 5×5 cells; 9×9 always suffice."""

TIE_BREAK: Final = 1e-11
"""Weight of the 5×5 sum in :func:`_tie_break`, so small that the sum's float32 rounding errors do
not change the float64 rank."""


@dataclass(frozen=True)
class MapGeometry:
    """Geometry of maps relative to the network's input."""

    # Input pixels per cell. Cell i covers pixels ``stride·i … stride·i + stride − 1``, so its
    # centre is pixel ``stride·i + (stride − 1)/2``.
    stride: int = 8
    sigma: float = 1.0  # Standard deviation of a target's belief peak, cells
    # Radius of the disc around a corner in which the field is defined, cells.
    field_radius: float = 2.0

    def to_cells(self, pixels: Tensor) -> Tensor:
        """Convert pixels of the network's input to cell coordinates (integer at cell centres)."""
        return (pixels - (self.stride - 1) / 2) / self.stride


def encode(
    keypoints: Float[Tensor, "batch instances 9 2"],
    object_index: Int[Tensor, "batch instances"],
    num_objects: int,
    map_size: tuple[int, int],
    geometry: MapGeometry,
) -> tuple[Beliefs, Fields]:
    """Return the target maps of a batch: 9·C belief and 16·C field channels.

    Beliefs are Gaussians of peak 1, combined over instances by their maximum. Keypoints outside the
    map or not finite are ignored. In the disc around a corner, the field (x, y) is the unit vector
    from this corner to its instance's centroid; where discs overlap, the nearest corner counts.

    ``keypoints`` are corners 0–7 and the centroid, (x, y) in pixels of the network's input. An
    ``object_index`` of −1 marks padding. ``map_size`` is (height, width), cells.
    """
    height, width = map_size
    cells = geometry.to_cells(keypoints.float())
    on_map = ((cells > -0.5) & (cells < cells.new_tensor([width - 0.5, height - 0.5]))).all(-1)
    drawn = on_map & (object_index >= 0)[..., None]
    # In a window of a heap, most instances have no keypoint on the map.
    has_keypoint = drawn.any(-1)
    instances = max(has_keypoint.sum(-1).tolist(), default=0)
    order = has_keypoint.int().argsort(dim=-1, descending=True, stable=True)[:, :instances]
    rows = torch.arange(len(cells), device=cells.device)
    cells, drawn = cells[rows[:, None], order], drawn[rows[:, None], order]
    object_index = object_index.gather(1, order)
    x = torch.arange(width, device=cells.device) - cells[..., 0, None]
    y = torch.arange(height, device=cells.device) - cells[..., 1, None]

    toward = cells[:, :, CENTROID, None] - cells[:, :, :NUM_CORNERS]
    vectors = torch.nn.functional.normalize(toward, dim=-1)
    has_vector = drawn[..., :NUM_CORNERS] & torch.isfinite(vectors).all(-1)

    belief = cells.new_zeros(len(cells), num_objects, NUM_KEYPOINTS, height, width)
    field = cells.new_zeros(len(cells), num_objects, NUM_CORNERS, 2, height, width)
    nearest = cells.new_full(
        (len(cells), num_objects, NUM_CORNERS, height, width), geometry.field_radius**2
    )
    for n in range(instances):
        slot = (rows, object_index[:, n].clamp(min=0))
        squared = y[:, n, :, :, None] ** 2 + x[:, n, :, None, :] ** 2
        peak = torch.exp(-squared / (2 * geometry.sigma**2))
        peak = torch.where(drawn[:, n, :, None, None], peak, 0.0)
        belief[slot] = torch.maximum(belief[slot], peak)

        squared = squared[:, :NUM_CORNERS]
        closer = has_vector[:, n, :, None, None] & (squared <= nearest[slot])
        nearest[slot] = torch.where(closer, squared, nearest[slot])
        vector = vectors[:, n, :, :, None, None]
        field[slot] = torch.where(closer[:, :, None], vector, field[slot])
    return belief.flatten(1, 2), field.flatten(1, 3)


@dataclass(frozen=True)
class Peaks:
    """The highest local maxima of every belief channel, by descending belief."""

    # (x, y) in pixels of the network's input; NaN in an empty slot.
    position: Float[np.ndarray, "batch channels peaks 2"]
    # Belief at the peak's cell; 0 in an empty slot.
    score: Float[np.ndarray, "batch channels peaks"]
    # Covariance of the position, pixels²: the excess variance of the peak over a target peak, plus
    # the variance of the fit. A network trained with a proper loss returns the target Gaussian
    # blurred by its own uncertainty, so variances subtract.
    covariance_px: Float[np.ndarray, "batch channels peaks 2 2"]
    # Weighted mean (x, y) of the unit vectors of the field around a corner's peak; the more they
    # differ, the shorter it is. Zero for a centroid.
    toward: Float[np.ndarray, "batch channels peaks 2"]


def find_peaks(
    belief: Float[Tensor, "batch channels height width"],
    geometry: MapGeometry,
    threshold: float = 0.05,
    max_peaks: int = 64,
    field: Fields | None = None,
) -> Peaks:
    """Find up to ``max_peaks`` local maxima above ``threshold`` in each channel.

    A peak is a cell not below its eight neighbours. Among equal cells, as on a top that is clamped
    to 1, the peak is the cell with the highest sum of the 5×5 cells around it (usually the central
    cell of the top), or else the first cell in raster order. A Gaussian fit to the neighbourhood
    gives the position.

    Objects have nine belief channels and 16 field channels; without ``field``, ``toward`` is zero.
    """
    maps = _on_host(belief)
    height, width = maps.shape[2:]
    slots = (*maps.shape[:2], min(max_peaks, height * width))
    position, covariance = np.full((*slots, 2), np.nan), np.full((*slots, 2, 2), np.nan)
    score, toward = np.zeros(slots), np.zeros((*slots, 2))
    vectors = np.zeros((0, 1, 1), np.float32)
    if field is not None:
        vectors = _on_host(field).reshape(-1, height, width)
    half = min(max(math.ceil(REACH * geometry.sigma), HALF_WIDTHS[0]), HALF_WIDTHS[1])
    # The views by channel share the memory of the arrays, so filling the views fills the arrays.
    outputs = (
        array.reshape(-1, *array.shape[2:]) for array in (score, position, covariance, toward)
    )
    _find(
        maps.reshape(-1, height, width),
        vectors,
        float(np.float32(threshold)),  # rounded like the beliefs
        half,
        geometry.sigma,
        geometry.field_radius,
        *outputs,
    )
    pixels = position * geometry.stride + (geometry.stride - 1) / 2
    return Peaks(pixels, score, covariance * geometry.stride**2, toward)


def _on_host(maps: Tensor) -> Float[np.ndarray, "batch channels height width"]:
    """Return maps as a contiguous float32 array in CPU memory."""
    return np.ascontiguousarray(maps.detach().float().cpu().numpy())


@compiled()
def _find(
    belief: Array,
    field: Array,
    threshold: float,
    half: int,
    sigma: float,
    radius: float,
    score: Array,
    position: Array,
    covariance: Array,
    toward: Array,
) -> None:
    """Write the peaks of all channels to the last four arrays, in cells; see :class:`Peaks`."""
    cells = np.empty((score.shape[1], 2), np.int64)
    for channel in range(len(belief)):
        count = _strongest(belief[channel], threshold, score[channel], cells)
        if not count:
            continue
        centres = position[channel, :count]
        fit_peaks(belief[channel], cells[:count], half, sigma, centres, covariance[channel, :count])
        number, corner = channel // NUM_KEYPOINTS, channel % NUM_KEYPOINTS
        if len(field) and corner < NUM_CORNERS:
            first = 2 * (number * NUM_CORNERS + corner)
            mean_vectors(field[first : first + 2], cells[:count], centres, radius, toward[channel])


@compiled()
def _strongest(belief: Array, threshold: float, score: Array, cells: Array) -> int:
    """Write the highest local maxima above ``threshold``, by descending belief.

    Args:
        belief: Belief map of a channel, (height, width).
        threshold: Belief that a maximum exceeds.
        score: Filled with the beliefs of the maxima, (peaks,).
        cells: Filled with (column, row) of the maxima, (peaks, 2).

    Returns:
        The number of maxima, at most the length of ``score``.
    """
    count = 0
    for y in range(belief.shape[0]):
        for x in range(belief.shape[1]):
            value = belief[y, x]
            if not (value > threshold and value < math.inf and _is_highest(belief, y, x)):
                continue
            if count < len(score):
                count += 1
            elif not value > score[count - 1]:
                continue
            k = count - 1
            while k > 0 and score[k - 1] < value:
                score[k] = score[k - 1]
                cells[k, 0], cells[k, 1] = cells[k - 1, 0], cells[k - 1, 1]
                k -= 1
            score[k], cells[k, 0], cells[k, 1] = value, x, y
    return count


@compiled()
def _is_highest(belief: Array, y: int, x: int) -> bool:
    """Return whether a cell is a 3×3 maximum; ``_tie_break``, then raster order, resolves ties."""
    value = belief[y, x]
    for v in range(max(y - 1, 0), min(y + 2, belief.shape[0])):
        for u in range(max(x - 1, 0), min(x + 2, belief.shape[1])):
            other = belief[v, u]
            if value > other or (v == y and u == x):
                continue
            if value != other:  # higher, or NaN
                return False
            rank, other_rank = _tie_break(belief, y, x), _tie_break(belief, v, u)
            if not (rank > other_rank or (rank == other_rank and (v > y or (v == y and u > x)))):
                return False
    return True


@compiled()
def _tie_break(belief: Array, y: int, x: int) -> float:
    """Return a cell's belief plus :data:`TIE_BREAK` times the sum of the 5×5 cells around it."""
    total = np.float32(0.0)
    for u in range(max(x - 2, 0), min(x + 3, belief.shape[1])):
        column = np.float32(0.0)
        for v in range(max(y - 2, 0), min(y + 3, belief.shape[0])):
            column += belief[v, u]
        total += column
    return np.float64(belief[y, x]) + TIE_BREAK * np.float64(total)
