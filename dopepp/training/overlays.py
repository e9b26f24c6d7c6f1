"""A contact sheet of validation images with predicted (yellow) and true (green) wireframes."""

from __future__ import annotations

from pathlib import Path

from lightning.pytorch import Callback, LightningModule, Trainer

from dopepp.data.batch import Batch
from dopepp.drawing.overlay import GREEN, YELLOW, Wireframe, overlay
from dopepp.drawing.png import write_png
from dopepp.drawing.sheet import Tile, contact_sheet
from dopepp.training.pictures import dispensable, log_picture
from dopepp.training.system import PoseSystem, ValidationOutput


class Overlays(Callback):
    """Writes ``val_overlay.png`` after every validation and logs it.

    Args:
        num_images: Images on the sheet, the first ones of the validation set.
    """

    def __init__(self, num_images: int = 12) -> None:
        self.num_images = num_images
        self._tiles: list[Tile] = []

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start a new sheet."""
        self._tiles = []

    def on_validation_batch_end(  # type: ignore[override]
        self,
        trainer: Trainer,
        pl_module: PoseSystem,
        outputs: ValidationOutput,
        batch: Batch,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Draw the batch's first images until the sheet is full."""
        missing = self.num_images - len(self._tiles)
        if missing <= 0 or not trainer.is_global_zero or trainer.sanity_checking:
            return
        images = batch.images[:missing].permute(0, 2, 3, 1).cpu().numpy()
        truths = batch.keypoints.cpu().numpy()
        for row, detections in enumerate(pl_module.recover(outputs, batch)[:missing]):
            wireframes = [Wireframe(points, GREEN, "true") for points in truths[row]]
            wireframes += [Wireframe(one.keypoints, YELLOW, "predicted") for one in detections]
            self._tiles.append(Tile(overlay(images[row], wireframes), batch.keys[row]))

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write and log the sheet."""
        if not self._tiles:
            return
        sheet = contact_sheet(self._tiles)
        path = Path(trainer.default_root_dir) / "val_overlay.png"
        with dispensable(str(path)):
            write_png(path, sheet)
        log_picture(trainer, "val/overlay", sheet)
