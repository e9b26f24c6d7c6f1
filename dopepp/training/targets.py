"""Target maps: what the network is asked to give for a batch."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from dopepp.data.batch import PADDING, Batch
from dopepp.maps.encode import Beliefs, Fields, MapGeometry, encode
from dopepp.metrics.pose import MIN_VISIBLE_FRACTION
from dopepp.models.heads import Stage
from dopepp.models.losses import MapLoss
from dopepp.training.symmetry import SymmetryHandling

Keypoints = Float[Tensor, "batch instances 9 2"]
Targets = tuple[Beliefs, Fields]
"""Belief maps and vector fields as the network should give them."""


def draw_maps(
    batch: Batch, keypoints: Keypoints, num_objects: int, geometry: MapGeometry
) -> Targets:
    """Draw the maps of the instances that are visible enough for a metric to count them.

    Their keypoints, pixels, are those of the batch, or of poses that look alike.
    """
    height, width = batch.images.shape[-2:]
    map_size = height // geometry.stride, width // geometry.stride
    seen = batch.visible_fraction >= MIN_VISIBLE_FRACTION
    index = torch.where(seen, batch.object_index, PADDING)
    return encode(keypoints, index, num_objects, map_size, geometry)


def choose_keypoints(
    batch: Batch,
    stages: Sequence[Stage] | None,
    symmetry: SymmetryHandling,
    loss: MapLoss,
    geometry: MapGeometry,
) -> Keypoints:
    """Return each instance's keypoints in the one of its look-alike poses that is to be learnt.

    That is the pose nearest the reference orientation. Where another one is as good, it is the one
    whose maps the network's answer (``stages``) has the lower loss to; one instance is decided
    after the other. Without an answer it is always the nearest.
    """
    found = symmetry.equivalents(batch)
    keypoints = found.keypoints[:, :, 0].clone()
    if stages is None:
        return keypoints
    for slot, choice in found.allowed[:, :, 1:].any(dim=0).nonzero().tolist():
        # Only the images on which this instance may take this choice are drawn, twice.
        rows = found.allowed[:, slot, 1 + choice].nonzero()[:, 0]
        some = batch.rows(rows)
        answer = [(logits[rows].detach(), field[rows].detach()) for logits, field in stages]
        other = keypoints[rows]
        other[:, slot] = found.keypoints[rows, slot, 1 + choice]
        present_loss, other_loss = (
            loss.per_image(answer, *draw_maps(some, points, symmetry.num_objects, geometry))
            for points in (keypoints[rows], other)
        )
        better = other_loss < present_loss
        keypoints[rows] = torch.where(better[:, None, None, None], other, keypoints[rows])
    return keypoints
