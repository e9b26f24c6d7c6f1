"""A contact sheet of validation images with predicted (yellow) and true (green) wireframes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from dopepp.data.batch import Batch
from dopepp.drawing.overlay import GREEN, YELLOW, Wireframe, overlay
from dopepp.drawing.sheet import Tile
from dopepp.training.system import PoseSystem, ValidationOutput
from dopepp.training.validation_sheet import ValidationSheet


class Overlays(ValidationSheet):
    """Writes ``val_overlay.png`` after every validation and logs it as ``val/overlay``.

    Args:
        num_images: Images on the sheet, the first ones of the validation set.
    """

    name: ClassVar[str] = "overlay"

    def __init__(self, num_images: int = 12) -> None:
        super().__init__(num_images)

    def tiles(self, system: PoseSystem, outputs: ValidationOutput, batch: Batch) -> Sequence[Tile]:
        """Return each image with its wireframes."""
        images = batch.images.permute(0, 2, 3, 1).cpu().numpy()
        truths = batch.keypoints.cpu().numpy()
        tiles = []
        for row, detections in enumerate(system.recover(outputs, batch)):
            wireframes = [Wireframe(points, GREEN, "true") for points in truths[row]]
            wireframes += [Wireframe(one.keypoints, YELLOW, "predicted") for one in detections]
            tiles.append(Tile(overlay(images[row], wireframes), batch.keys[row]))
        return tiles
