"""Maps to peaks: batched local maxima with sub-cell positions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from dopepp.maps.encode import MapGeometry

WINDOW: Final = 2
"""Half-width of the neighbourhood a peak is fitted to, cells."""

FLOOR: Final = 1e-6
"""Belief below which a cell says nothing; a peak of σ = 0.5 on the border needs its third column,
which is as low as e⁻¹²·⁵ = 4e-6."""

TIE_BREAK: Final = 1e-11
"""Weight of the neighbourhood's sum (at most 25) among equal cells: less than the 2e-9 by which
float32 beliefs of the lowest useful threshold, 0.02, can differ."""

MARGIN: Final = 3.0
"""Squared cells by which a cell must be nearer to its peak than to another: both lie anywhere
within their own cells. Of 1 to 4, 3 gave the smallest errors on pairs of peaks 3σ to 4σ apart."""

_SPAN: Final = range(2 * WINDOW + 1)

PLATEAU: Final = 3
"""Cells as high as the peak's from which on its top is cut off; an exact tie of two is none."""


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

    A peak is a cell not below its eight neighbours. Of equal cells, as on the flat top of a clamped
    belief, it is the one with the highest neighbourhood, which is the middle one; if these are
    equal too, the first in raster order. Its position is that of the Gaussian fitted to its 5×5
    neighbourhood. There are as many slots as the fullest channel needs.
    """
    belief = belief.float()
    height, width = belief.shape[-2:]
    is_peak = _local_maxima(belief) & (belief > threshold) & torch.isfinite(belief)
    count = min(max_peaks, height * width, int(is_peak.sum((-2, -1)).max()))
    score, index = torch.where(is_peak, belief, -torch.inf).flatten(2).topk(count, dim=-1)
    row, column = index // width, index % width
    found = score > -torch.inf
    offset, spread = _fit_gaussian(belief, row, column, found, geometry.sigma)
    position = geometry.to_pixels(torch.stack([column, row], dim=-1) + offset)
    return Peaks(
        torch.where(found[..., None], position, torch.nan),
        torch.where(found, score, 0.0),
        spread * geometry.stride,
        found,
    )


def _local_maxima(
    belief: Float[Tensor, "batch channels height width"],
) -> Bool[Tensor, "batch channels height width"]:
    """Mark cells that are the highest of their 3×3 neighbourhood, one of every set of equals."""
    height, width = belief.shape[-2:]
    # A sum along one axis, then along the other: a fifth of `avg_pool2d`'s time.
    around = functional.pad(belief, (WINDOW,) * 4)
    around = sum((around[..., k : k + height, :] for k in _SPAN[1:]), around[..., :height, :])
    around = sum((around[..., k : k + width] for k in _SPAN[1:]), around[..., :width])
    # Both numbers fit into one float64 key, so that one comparison orders them lexicographically.
    key = belief.double() + TIE_BREAK * around.double()
    padded = functional.pad(key, (1, 1, 1, 1), value=-torch.inf)
    highest = torch.ones_like(belief, dtype=torch.bool)
    for dy, dx in ((-1, -1), (-1, 0), (-1, 1), (0, -1)):
        before = padded[..., 1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
        after = padded[..., 1 - dy : 1 - dy + height, 1 - dx : 1 - dx + width]
        highest &= (key > before) & (key >= after)
    return highest


def _fit_gaussian(
    belief: Float[Tensor, "batch channels height width"],
    row: Int[Tensor, "batch channels peaks"],
    column: Int[Tensor, "batch channels peaks"],
    found: Bool[Tensor, "batch channels peaks"],
    sigma: float,
) -> tuple[Float[Tensor, "batch channels peaks 2"], Float[Tensor, "batch channels peaks 2"]]:
    """Fit log b = c + p·x + q·y − r·x² − s·y² around each peak, weighted by b².

    The logarithm makes the fit linear and exact for a clean Gaussian, at the border too, where the
    neighbourhood is cut; the weight b² undoes the noise amplification of the logarithm (Guo, IEEE
    SPM 2011). Cells of a cut-off top say only "at least", and cells where another peak's Gaussian
    is higher say nothing about this one: both are left out. A fit that is not a peak within its own
    neighbourhood falls back to the middle of the highest cells.

    Returns:
        Offset from the peak's cell and standard deviation, (x, y) in cells.
    """
    height, width = belief.shape[-2:]
    span = torch.arange(-WINDOW, WINDOW + 1, device=belief.device)
    dy, dx = (grid.flatten() for grid in torch.meshgrid(span, span, indexing="ij"))
    y, x = row[..., None] + dy, column[..., None] + dx
    inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
    cells = (y.clamp(0, height - 1) * width + x.clamp(0, width - 1)).flatten(2)
    value = torch.where(inside, belief.flatten(2).gather(2, cells).view_as(inside), 0.0)
    top = value[..., len(span) * WINDOW + WINDOW, None]

    highest = inside & (value == top)
    cut_off = highest & (highest.sum(-1, keepdim=True) >= PLATEAU)
    own = _dominated(x, y, row, column, torch.where(found, top[..., 0], 0.0), sigma)
    value = torch.where(own & ~cut_off & (value > FLOOR), value / top, 0.0)

    design = torch.stack([torch.ones_like(dx), dx, dy, -(dx**2), -(dy**2)], -1).double()
    weight = value.double() ** 2
    logarithm = torch.where(value > 0, value.double(), 1.0).log()
    weighted = weight[..., None] * design
    normal = weighted.transpose(-1, -2) @ design
    # The ridge only decides directions in which no neighbour is above the floor; `solve_ex` leaves
    # a system that is singular in spite of it to the check below.
    normal = normal + 1e-14 * torch.eye(5, dtype=torch.float64, device=belief.device)
    right = (weighted * logarithm[..., None]).sum(-2)
    solution = torch.linalg.solve_ex(normal, right[..., None])[0][..., 0]
    slope, curvature = solution[..., 1:3], solution[..., 3:5]
    offset = slope / (2 * curvature)
    middle = (highest[..., None] * design[:, 1:3]).sum(-2) / highest.sum(-1, keepdim=True)
    good = (curvature > 1e-3) & ((offset - middle).abs() <= 1.0)
    offset = torch.where(good, offset, middle)
    spread = torch.where(good, (2 * curvature.clamp(min=1e-3)).rsqrt(), float(WINDOW))
    return offset.float(), spread.float()


def _dominated(
    x: Int[Tensor, "batch channels peaks cells"],
    y: Int[Tensor, "batch channels peaks cells"],
    row: Int[Tensor, "batch channels peaks"],
    column: Int[Tensor, "batch channels peaks"],
    score: Float[Tensor, "batch channels peaks"],
    sigma: float,
) -> Bool[Tensor, "batch channels peaks cells"]:
    """Mark the cells of each peak's neighbourhood that no other peak of its channel reaches more.

    Of Gaussians s·exp(−d²/2σ²), of which a belief map is the maximum, the highest in a cell is the
    one with the smallest d² − 2σ² log s.
    """
    squared = (x[..., None] - column[:, :, None, None]) ** 2
    squared = squared + (y[..., None] - row[:, :, None, None]) ** 2
    power = squared - 2 * sigma**2 * score.log()[:, :, None, None]
    own = power.diagonal(dim1=2, dim2=4).transpose(-1, -2)
    myself = torch.eye(row.shape[-1], dtype=torch.bool, device=row.device)[:, None]
    others = power.masked_fill(myself, torch.inf)
    return (own[..., None] + MARGIN < others).all(-1)
