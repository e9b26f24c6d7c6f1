"""Poses to maps: belief maps and vector fields, batched, on the device the keypoints live on."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dopepp.geometry.cuboid import CENTROID, NUM_CORNERS, NUM_KEYPOINTS

Beliefs = Float[Tensor, "batch beliefs height width"]
Fields = Float[Tensor, "batch fields height width"]


@dataclass(frozen=True)
class MapGeometry:
    """How maps relate to the network's input.

    Attributes:
        stride: Input pixels per cell. Cell i covers pixels ``stride·i … stride·i + stride − 1``,
            so its centre is pixel ``stride·i + (stride − 1)/2``.
        sigma: Standard deviation of a belief peak, cells.
        field_radius: Radius of the disc around a corner that carries its vector, cells.
    """

    stride: int = 8
    sigma: float = 1.0
    field_radius: float = 2.0

    def to_cells(self, pixels: Tensor) -> Tensor:
        """Turn input pixels into cell coordinates (cell centres are whole numbers)."""
        return (pixels - (self.stride - 1) / 2) / self.stride


def encode(
    keypoints: Float[Tensor, "batch instances 9 2"],
    object_index: Int[Tensor, "batch instances"],
    num_objects: int,
    map_size: tuple[int, int],
    geometry: MapGeometry,
) -> tuple[Beliefs, Fields]:
    """Draw the target maps of a batch: 9·C belief and 16·C field channels.

    Beliefs are Gaussians of peak 1, their maximum taken over instances. A keypoint off the map or
    not finite is absent. Fields are unit vectors from a corner to its instance's centroid; where
    discs overlap, the nearest corner's vector stands.

    Args:
        keypoints: Input pixels.
        object_index: Objects of the instances; −1 marks padding.
        num_objects: Number of objects C.
        map_size: (height, width) of the maps, cells.
        geometry: Relation of the maps to the input.
    """
    height, width = map_size
    batch, instances = object_index.shape
    cells = geometry.to_cells(keypoints.float())
    on_map = ((cells > -0.5) & (cells < cells.new_tensor([width - 0.5, height - 0.5]))).all(-1)
    drawn = on_map & (object_index >= 0)[..., None]
    x = torch.arange(width, device=cells.device) - cells[..., 0, None]
    y = torch.arange(height, device=cells.device) - cells[..., 1, None]

    toward = cells[:, :, CENTROID, None] - cells[:, :, :NUM_CORNERS]
    vectors = torch.nn.functional.normalize(toward, dim=-1)
    has_vector = drawn[..., :NUM_CORNERS] & torch.isfinite(vectors).all(-1)

    belief = cells.new_zeros(batch, num_objects, NUM_KEYPOINTS, height, width)
    field = cells.new_zeros(batch, num_objects, NUM_CORNERS, 2, height, width)
    nearest = cells.new_full(
        (batch, num_objects, NUM_CORNERS, height, width), geometry.field_radius**2
    )
    rows = torch.arange(batch, device=cells.device)
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
