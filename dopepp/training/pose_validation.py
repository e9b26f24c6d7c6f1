"""Pose metrics, early stopping and contact sheets of validations.

Poses are recovered from the maps, and ``PoseMetrics`` accumulates their errors as in evaluations.
To log another metric, add its field of :class:`~dopepp.metrics.row.PoseRow` to :data:`LOGGED`.
"""

from __future__ import annotations

import logging
import math
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, Final

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import EarlyStopping

from dopepp.core.files import write_png
from dopepp.data.batch import Batch
from dopepp.data.sample import Instance
from dopepp.drawing.curves import figure_image, save_accuracy_curves
from dopepp.drawing.overlay import GREEN, YELLOW, Wireframe, overlay
from dopepp.drawing.pictures import RGBImage
from dopepp.drawing.sheet import Tile, belief_tiles, contact_sheet
from dopepp.geometry.cuboid import NUM_KEYPOINTS
from dopepp.metrics.pose import MEAN, PoseMetrics
from dopepp.parts.part import Part
from dopepp.training.loggers import GuardedLogger
from dopepp.training.system import PoseSystem, ValidationOutput

_log = logging.getLogger(__name__)

LOGGED: Final = (
    "add_01d", "add_s_01d", "add_or_s_01d", "pass_5cm", "pass_10cm", "auc_10cm", "auc_s_10cm",
    "ar_mssd", "ar_mspd", "median_rotation_deg", "median_rotation_s_deg", "miss_rate",
)  # fmt: skip


class PoseMetricsCallback(Callback):
    """Logs the pose metrics of every validation as ``val/<metric>``, averaged over objects.

    ``val/selection``, which chooses the best checkpoint, is the mean over objects of the exact AUC
    of ADD up to 0.1 m, or of ADD-S for symmetric objects. Later callbacks can read :attr:`metrics`.
    """

    metrics: PoseMetrics

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Create empty pose metrics for the parts of the system."""
        assert isinstance(pl_module, PoseSystem)
        self.metrics = PoseMetrics(pl_module.parts)

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Reset the pose metrics and move them to the device that gathers them across processes."""
        self.metrics.to(pl_module.device).reset()

    def on_validation_batch_end(  # type: ignore[override]
        self, trainer: Trainer, system: PoseSystem, outputs: ValidationOutput, batch: Batch, *_: Any
    ) -> None:
        """Recover poses from the maps of the batch and compare them with the labelled instances."""
        detections, truths = system.recover(outputs, batch), batch_instances(batch, system.parts)
        width = batch.images.shape[-1]
        cameras = batch.K.double().cpu().numpy()
        for image in zip(detections, truths, cameras, strict=True):
            self.metrics.update(*image, width)

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log means over objects; undefined means are NaN, undefined rotation errors omitted."""
        mean = self.metrics.compute()[MEAN]
        values = {name: getattr(mean, name) for name in LOGGED}
        values["selection"] = mean.auc_or_s_10cm
        on_bar = "add_or_s_01d" if mean.num_symmetries > 1 else "add_01d"
        for name, value in values.items():
            if value is None and name.startswith("median_rotation"):
                continue  # undefined without matches
            # ModelCheckpoint needs a value even if the validation images have no objects.
            number = math.nan if value is None else float(value)
            pl_module.log(f"val/{name}", number, prog_bar=name == on_bar, rank_zero_only=False)


def batch_instances(batch: Batch, parts: tuple[Part, ...]) -> Iterator[list[Instance]]:
    """Yield a list of labelled instances per image; ``parts`` are in channel order."""
    index = batch.object_index.cpu().numpy()
    poses, keypoints = batch.T_cam_obj.double().cpu().numpy(), batch.keypoints.cpu().numpy()
    visible = batch.visible_fraction.cpu().numpy()
    for row in range(len(batch)):
        yield [
            Instance(parts[c].name, poses[row, n], keypoints[row, n], float(visible[row, n]))
            for n, c in enumerate(index[row])
            if c >= 0
        ]


class EarlyStop(EarlyStopping):
    """Lightning's early stopping, whose patience in a resumed run comes from the current config."""

    @property
    def impatient(self) -> bool:
        """Whether the number of validations without improvement has reached the patience."""
        return bool(self.wait_count >= self.patience)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the best value and the validations since then, but not the patience."""
        super().load_state_dict({**state_dict, "patience": self.patience})

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Stop a resumed run whose validations without improvement have reached the patience."""
        if self.impatient:
            trainer.should_stop = True


class AUCCurves(Callback):
    """Draws accuracy–threshold curves of ADD; must follow :class:`PoseMetricsCallback`."""

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw a curve per object, from the errors of all processes, as ``val_auc``."""
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        (metrics,) = (item.metrics for item in callbacks if isinstance(item, PoseMetricsCallback))
        curves = {name: metrics.errors(name) for name in metrics.parts}
        if trainer.sanity_checking or not trainer.is_global_zero:
            return
        title = f"validation, epoch {trainer.current_epoch}"
        folder = Path(trainer.default_root_dir)
        with best_effort(f"{folder}/val_auc"):
            figure = save_accuracy_curves(folder / "val_auc", curves, title=title)
            _log_image(trainer, "val/auc", figure_image(figure))


class ValidationSheet(Callback):
    """A contact sheet of the first validation images, ``val_NAME.png``, logged as ``val/NAME``."""

    name: ClassVar[str]

    def __init__(self, num_images: int = 12) -> None:
        self.num_images = num_images
        self._tiles: list[Tile] = []
        self._num_drawn = 0

    @abstractmethod
    def tiles(self, system: PoseSystem, outputs: ValidationOutput, batch: Batch) -> Sequence[Tile]:
        """Return the captioned pictures to show for a batch, in the order of its images."""

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Discard the tiles of the last validation."""
        self._tiles, self._num_drawn = [], 0

    def on_validation_batch_end(  # type: ignore[override]
        self, trainer: Trainer, system: PoseSystem, outputs: ValidationOutput, batch: Batch, *_: Any
    ) -> None:
        """Add the tiles of the first images, until ``num_images`` images are on the sheet."""
        num = min(self.num_images - self._num_drawn, len(batch))
        if num <= 0 or not trainer.is_global_zero or trainer.sanity_checking:
            return
        first = ValidationOutput(outputs.loss, outputs.belief[:num], outputs.field[:num])
        self._tiles += self.tiles(system, first, batch.rows(torch.arange(num)))
        self._num_drawn += num

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the sheet to the run folder and log it as an image."""
        if not self._tiles:
            return
        sheet = contact_sheet(self._tiles)
        path = Path(trainer.default_root_dir) / f"val_{self.name}.png"
        with best_effort(str(path)):
            write_png(path, sheet)
        _log_image(trainer, f"val/{self.name}", sheet)


class Overlays(ValidationSheet):
    """Images with predicted (yellow) and true (green) wireframes: ``val_overlay.png``."""

    name: ClassVar[str] = "overlay"

    def tiles(self, system: PoseSystem, outputs: ValidationOutput, batch: Batch) -> Sequence[Tile]:
        """Return each image with the wireframes of the labels and of the recovered poses."""
        images = batch.images.permute(0, 2, 3, 1).cpu().numpy()
        truths = batch.keypoints.cpu().numpy()
        tiles = []
        for row, detections in enumerate(system.recover(outputs, batch)):
            wireframes = [Wireframe(points, GREEN, "true") for points in truths[row]]
            wireframes += [Wireframe(item.keypoints, YELLOW, "predicted") for item in detections]
            tiles.append(Tile(overlay(images[row], wireframes), batch.keys[row]))
        return tiles


class BeliefMaps(ValidationSheet):
    """Images overlaid with the belief maps of corners and centroid: ``val_belief.png``."""

    name: ClassVar[str] = "belief"

    def __init__(self, num_images: int = 6) -> None:
        super().__init__(num_images)

    def tiles(self, system: PoseSystem, outputs: ValidationOutput, batch: Batch) -> Sequence[Tile]:
        """Return each image twice: overlaid with the belief maps of corners and of the centroid."""
        images = batch.images.permute(0, 2, 3, 1).cpu().numpy()
        shape = (len(images), -1, NUM_KEYPOINTS, *outputs.belief.shape[-2:])
        beliefs = outputs.belief.reshape(shape).amax(dim=1).cpu().numpy()
        tiles: list[Tile] = []
        for image, belief, key in zip(images, beliefs, batch.keys, strict=True):
            tiles += belief_tiles(image, belief, system.geometry.stride, key)
        return tiles


def _log_image(trainer: Trainer, name: str, image: RGBImage) -> None:
    for logger in trainer.loggers:
        if isinstance(logger, GuardedLogger):
            logger.log_image(name, image, trainer.global_step)


@contextmanager
def best_effort(name: str) -> Iterator[None]:
    """Catch an ``OSError`` in the context and log that the file ``name`` cannot be written."""
    try:
        yield
    except OSError as error:
        _log.warning("cannot write %s: %s", name, error.strerror or error)
