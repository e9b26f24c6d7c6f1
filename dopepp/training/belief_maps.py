"""A contact sheet of validation images under the belief maps that the network gives."""

from __future__ import annotations

from pathlib import Path

from lightning.pytorch import Callback, LightningModule, Trainer

from dopepp.data.batch import Batch
from dopepp.drawing.maps import heat_picture
from dopepp.drawing.png import write_png
from dopepp.drawing.sheet import Tile, contact_sheet
from dopepp.geometry.cuboid import CENTROID, NUM_KEYPOINTS
from dopepp.training.pictures import dispensable, log_picture
from dopepp.training.system import PoseSystem, ValidationOutput


class BeliefMaps(Callback):
    """Writes ``val_belief.png`` after every validation and logs it as ``val/belief``.

    Two pictures per image, with their maxima: the strongest belief of any corner, and of the
    centroid, over all objects.

    Args:
        num_images: Images on the sheet, the first ones of the validation set.
    """

    def __init__(self, num_images: int = 6) -> None:
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
        missing = self.num_images - len(self._tiles) // 2
        if missing <= 0 or not trainer.is_global_zero or trainer.sanity_checking:
            return
        images = batch.images[:missing].permute(0, 2, 3, 1).cpu().numpy()
        shape = (len(images), -1, NUM_KEYPOINTS, *outputs.belief.shape[-2:])
        beliefs = outputs.belief[:missing].reshape(shape).amax(dim=1)
        for image, belief, key in zip(images, beliefs.cpu().numpy(), batch.keys, strict=False):
            maps = {"corners": belief[:CENTROID].max(axis=0), "centroid": belief[CENTROID]}
            for name, one in maps.items():
                picture = heat_picture(image, one, pl_module.geometry.stride)
                self._tiles.append(Tile(picture, f"{key} {name}, max {one.max():.2f}"))

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write and log the sheet."""
        if not self._tiles:
            return
        sheet = contact_sheet(self._tiles)
        path = Path(trainer.default_root_dir) / "val_belief.png"
        with dispensable(str(path)):
            write_png(path, sheet)
        log_picture(trainer, "val/belief", sheet)
