"""Pictures of every validation, as files in the run folder and in the loggers that take pictures.

To draw another sheet of the first validation images, a subclass of :class:`ValidationSheet` with a
``name`` and :meth:`~ValidationSheet.tiles`, a line in
``dopepp/experiment/assembly/registries.py`` and
an entry in ``conf/callbacks``.
"""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from dopepp.core.files import write_png
from dopepp.data.batch import Batch
from dopepp.drawing.curves import figure_image, save_accuracy_curves
from dopepp.drawing.overlay import GREEN, YELLOW, Wireframe, overlay
from dopepp.drawing.pictures import Picture
from dopepp.drawing.sheet import Tile, belief_tiles, contact_sheet
from dopepp.geometry.cuboid import NUM_KEYPOINTS
from dopepp.training.callbacks.pose_metrics import PoseMetricsCallback
from dopepp.training.loggers import GuardedLogger
from dopepp.training.system import PoseSystem, ValidationOutput

_log = logging.getLogger(__name__)


class AUCCurves(Callback):
    """Writes ``val_auc.png`` and ``val_auc.csv`` after every validation and logs the picture.

    Must stand after :class:`PoseMetricsCallback`, whose errors it draws.
    """

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw one curve per object; every process takes part in gathering the errors."""
        listed: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        metrics = next(one.metrics for one in listed if isinstance(one, PoseMetricsCallback))
        curves = {name: metrics.errors(name) for name in metrics.parts}
        if trainer.sanity_checking or not trainer.is_global_zero:
            return
        title = f"validation, epoch {trainer.current_epoch}"
        folder = Path(trainer.default_root_dir)
        with best_effort(f"{folder}/val_auc"):
            figure = save_accuracy_curves(folder / "val_auc", curves, title=title)
            log_picture(trainer, "val/auc", figure_image(figure))


class ValidationSheet(Callback):
    """A contact sheet of the first validation images, ``val_NAME.png``, logged as ``val/NAME``."""

    name: ClassVar[str]

    def __init__(self, num_images: int = 12) -> None:
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
        self, trainer: Trainer, system: PoseSystem, outputs: ValidationOutput, batch: Batch, *_: Any
    ) -> None:
        """Draw the batch's first images until the sheet is full."""
        num = min(self.num_images - self._num_drawn, len(batch))
        if num <= 0 or not trainer.is_global_zero or trainer.sanity_checking:
            return
        first = ValidationOutput(outputs.loss, outputs.belief[:num], outputs.field[:num])
        self._tiles += self.tiles(system, first, batch.rows(torch.arange(num)))
        self._num_drawn += num

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write and log the sheet."""
        if not self._tiles:
            return
        sheet = contact_sheet(self._tiles)
        path = Path(trainer.default_root_dir) / f"val_{self.name}.png"
        with best_effort(str(path)):
            write_png(path, sheet)
        log_picture(trainer, f"val/{self.name}", sheet)


class Overlays(ValidationSheet):
    """Wireframes, the predicted ones yellow and the true ones green: ``val_overlay.png``."""

    name: ClassVar[str] = "overlay"

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


class BeliefMaps(ValidationSheet):
    """The images under the network's belief maps: ``val_belief.png``.

    Each image is there twice, with the maxima: the strongest belief of any corner, and of the
    centroid, over all objects.
    """

    name: ClassVar[str] = "belief"

    def __init__(self, num_images: int = 6) -> None:
        super().__init__(num_images)

    def tiles(self, system: PoseSystem, outputs: ValidationOutput, batch: Batch) -> Sequence[Tile]:
        """Return each image twice, under its corners' and under its centroid's beliefs."""
        images = batch.images.permute(0, 2, 3, 1).cpu().numpy()
        shape = (len(images), -1, NUM_KEYPOINTS, *outputs.belief.shape[-2:])
        beliefs = outputs.belief.reshape(shape).amax(dim=1).cpu().numpy()
        tiles: list[Tile] = []
        for image, belief, key in zip(images, beliefs, batch.keys, strict=True):
            tiles += belief_tiles(image, belief, system.geometry.stride, key)
        return tiles


def log_picture(trainer: Trainer, name: str, image: Picture) -> None:
    """Hand an RGB picture to TensorBoard and Weights & Biases where they are on."""
    for logger in trainer.loggers:
        if isinstance(logger, GuardedLogger):
            logger.log_picture(name, image, trainer.global_step)


@contextmanager
def best_effort(what: str) -> Iterator[None]:
    """Report it in a line where a file cannot be written, and go on."""
    try:
        yield
    except OSError as error:
        _log.warning("cannot write %s: %s", what, error.strerror or error)
