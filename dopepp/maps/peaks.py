"""Maps to peaks: batched local maxima with sub-cell positions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from dopepp.maps.encode import MapGeometry

WINDOW: Final = 2
"""Half-width of the neighbourhood a peak is fitted to, cells."""

FLOOR: Final = 1e-6
"""Belief below which a cell says nothing; a peak of σ = 0.5 at the border needs its
third column."""


@dataclass(frozen=True)
class Peaks:
    """The strongest local maxima of every channel, strongest first.

    Attributes:
        position: (x, y) in input pixels.
        score: Belief at the peak's cell.
        spread_px: Standard deviation of the fitted Gaussian in x and y, input pixels.
        found: False where a channel has fewer peaks than slots.
    """

    position: Float[Tensor, "batch channels peaks 2"]
    score: Float[Tensor, "batch channels peaks"]
    spread_px: Float[Tensor, "batch channels peaks 2"]
    found: Bool[Tensor, "batch channels peaks"]


def find_peaks(
    belief: Float[Tensor, "batch channels height width"],
    geometry: MapGeometry,
    threshold: float = 0.05,
    max_peaks: int = 16,
) -> Peaks:
    """Find up to ``max_peaks`` local maxima above ``threshold`` in each channel.

    A peak is a cell not below its eight neighbours (of equal ones the first in raster order). Its
    position is that of the Gaussian fitted to its 5×5 neighbourhood.
    """
    belief = belief.float()
    height, width = belief.shape[-2:]
    padded = functional.pad(belief, (1, 1, 1, 1), value=-torch.inf)

    def neighbour(dy: int, dx: int) -> Tensor:
        return padded[..., 1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]

    is_peak = belief > threshold
    for dy, dx in ((-1, -1), (-1, 0), (-1, 1), (0, -1)):
        is_peak &= (belief > neighbour(dy, dx)) & (belief >= neighbour(-dy, -dx))

    count = min(max_peaks, height * width)
    score, index = torch.where(is_peak, belief, -1.0).flatten(2).topk(count, dim=-1)
    row, column = index // width, index % width
    offset, spread = _fit_gaussian(belief, row, column)
    position = torch.stack([column, row], dim=-1) + offset
    found = score > threshold
    return Peaks(
        torch.where(found[..., None], geometry.to_pixels(position), torch.nan),
        torch.where(found, score, 0.0),
        spread * geometry.stride,
        found,
    )


def _fit_gaussian(
    belief: Float[Tensor, "batch channels height width"],
    row: Tensor,
    column: Tensor,
) -> tuple[Float[Tensor, "batch channels peaks 2"], Float[Tensor, "batch channels peaks 2"]]:
    """Fit log b = c + p·x + q·y − r·x² − s·y² around each peak, weighted by b².

    The logarithm makes the fit linear and exact for a clean Gaussian, at the border too, where the
    neighbourhood is cut; the weight b² undoes the noise amplification of the logarithm (Guo, IEEE
    SPM 2011). A fit that is not a peak within its own neighbourhood keeps the cell centre.
    """
    height, width = belief.shape[-2:]
    span = torch.arange(-WINDOW, WINDOW + 1, device=belief.device)
    dy, dx = (grid.flatten() for grid in torch.meshgrid(span, span, indexing="ij"))
    y, x = row[..., None] + dy, column[..., None] + dx
    inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
    cells = (y.clamp(0, height - 1) * width + x.clamp(0, width - 1)).flatten(2)
    value = belief.flatten(2).gather(2, cells).view_as(inside)
    value = torch.where(inside & (value > FLOOR), value, 0.0)

    design = torch.stack([torch.ones_like(dx), dx, dy, -(dx**2), -(dy**2)], -1).double()
    weight = value.double() ** 2
    logarithm = torch.where(value > 0, value.double().clamp(min=FLOOR).log(), 0.0)
    weighted = weight[..., None] * design
    normal = weighted.transpose(-1, -2) @ design
    # The ridge only decides directions in which no neighbour is above the floor.
    normal = normal + 1e-14 * torch.eye(5, dtype=torch.float64, device=belief.device)
    solution = torch.linalg.solve(normal, (weighted * logarithm[..., None]).sum(-2))
    slope, curvature = solution[..., 1:3], solution[..., 3:5]
    offset = slope / (2 * curvature)
    good = (curvature > 1e-3) & (offset.abs() <= 1.0)
    offset = torch.where(good, offset, 0.0)
    spread = torch.where(good, (2 * curvature.clamp(min=1e-3)).rsqrt(), float(WINDOW))
    return offset.float(), spread.float()
