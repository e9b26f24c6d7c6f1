"""A contact sheet of the first validation images, drawn anew in every validation.

To draw another one, a subclass with a ``name`` and :meth:`ValidationSheet.tiles`, and an entry in
``conf/callbacks``.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from dopepp.data.batch import Batch
from dopepp.drawing.png import write_png
from dopepp.drawing.sheet import Tile, contact_sheet
from dopepp.training.pictures import dispensable, log_picture
from dopepp.training.system import PoseSystem, ValidationOutput


class ValidationSheet(Callback):
    """Writes ``val_NAME.png`` after every validation and logs it as ``val/NAME``.

    Args:
        num_images: Images on the sheet, the first ones of the validation set.
    """

    name: ClassVar[str]

    def __init__(self, num_images: int) -> None:
        self.num_images = num_images
        self._tiles: list[Tile] = []
        self._num_drawn = 0

    @abstractmethod
    def tiles(self, system: PoseSystem, outputs: ValidationOutput, batch: Batch) -> Sequence[Tile]:
        """Return the pictures of all images of a batch, in order."""

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start a new sheet."""
        self._tiles, self._num_drawn = [], 0

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
        num = min(self.num_images - self._num_drawn, len(batch))
        if num <= 0 or not trainer.is_global_zero or trainer.sanity_checking:
            return
        first = ValidationOutput(outputs.loss, outputs.belief[:num], outputs.field[:num])
        self._tiles += self.tiles(pl_module, first, batch.rows(torch.arange(num)))
        self._num_drawn += num

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write and log the sheet."""
        if not self._tiles:
            return
        sheet = contact_sheet(self._tiles)
        path = Path(trainer.default_root_dir) / f"val_{self.name}.png"
        with dispensable(str(path)):
            write_png(path, sheet)
        log_picture(trainer, f"val/{self.name}", sheet)
