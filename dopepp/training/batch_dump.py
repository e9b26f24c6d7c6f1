"""A batch on disk, to compute with and to look at."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Final

from torch import Tensor

from dopepp.data.batch import Batch
from dopepp.drawing.overlay import GREEN, Wireframe, overlay
from dopepp.drawing.png import write_png
from dopepp.drawing.sheet import Tile, contact_sheet
from dopepp.models.storage import write_atomic

_log = logging.getLogger(__name__)

_MAX_TILES: Final = 64


def dump_batch(path: Path, batch: Batch, facts: Mapping[str, Any]) -> None:
    """Write ``path.pt`` and ``path.png``; a disk that takes neither is reported, not raised.

    Args:
        path: Where, without suffix.
        batch: The images and their poses.
        facts: Plain values stored with them. The file is a mapping of these and of the batch's
            fields, and loads under ``weights_only=True``.
    """
    plain = {entry.name: getattr(batch, entry.name) for entry in fields(batch)}
    content = {
        name: value.detach().cpu() if isinstance(value, Tensor) else value
        for name, value in plain.items()
    }
    try:
        write_atomic({**facts, **content}, path.with_name(f"{path.name}.pt"))
        write_png(path.with_name(f"{path.name}.png"), contact_sheet(_tiles(batch)))
    except OSError as error:
        _log.warning("the batch could not be written to %s: %s", path.parent, error)


def _tiles(batch: Batch) -> list[Tile]:
    images = batch.images[:_MAX_TILES].permute(0, 2, 3, 1).cpu().numpy()
    return [
        Tile(overlay(image, [Wireframe(points, GREEN, "true") for points in truths]), key)
        for image, truths, key in zip(
            images, batch.keypoints.cpu().numpy(), batch.keys, strict=False
        )
    ]
