"""When a network says nothing at all: the diagnosis of belief maps that stay empty.

A network whose maps are empty gives no pose, and then every metric of poses is zero whatever the
reason; so the reason is looked for in what is known of the run. To add one, a method like
:meth:`EmptyMaps._rate` and a line in :meth:`EmptyMaps._causes`.
"""

from __future__ import annotations

import logging
import math
from typing import Any, Final

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from dopepp.core.checks import check_integer
from dopepp.data.batch import PADDING, Batch
from dopepp.geometry.cuboid import CENTROID, NUM_KEYPOINTS
from dopepp.metrics.pose import MIN_VISIBLE_FRACTION
from dopepp.models.losses import MapMSE
from dopepp.training.system import PoseSystem, ValidationOutput

_log = logging.getLogger(__name__)

_MOST: Final = 10**6
_MIN_INSIDE: Final = 0.5
"""With fewer keypoints than this inside the images, poses or camera are probably wrong."""
_MIN_CELLS: Final = 3.0
"""Objects narrower than this on the maps have their nine keypoints in one place."""
_FALL: Final = 0.95
"""A validation loss above this share of its first value has not fallen."""


class EmptyMaps(Callback):
    """Warns once when nothing can be found because no belief is high enough, and says why.

    Empty are maps none of whose centroid's, or none of whose corners' beliefs reach the threshold
    of the recovery on any validation image. After ``patience`` such validations in a row (a network
    of few steps is rightly silent), or of a training that ends before, one warning names the three
    usual causes, the likely ones first, each with what the run shows of it and what to try.
    """

    def __init__(self, patience: int = 3) -> None:
        self.patience = check_integer("patience", patience, 1, _MOST)
        self._num_empty, self._told = 0, False
        self._first_loss = self._loss = math.nan
        self._highest = torch.zeros(2)
        self._inside: list[torch.Tensor] = []
        self._sizes: list[torch.Tensor] = []

    def state_dict(self) -> dict[str, Any]:
        """Return what has been seen, for a run that goes on."""
        return {"empty": self._num_empty, "told": self._told, "first_loss": self._first_loss}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on counting."""
        self._num_empty, self._told = int(state_dict["empty"]), bool(state_dict["told"])
        self._first_loss = float(state_dict["first_loss"])

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Forget the validation before."""
        self._highest = torch.zeros(2, device=pl_module.device)
        self._inside, self._sizes = [], []

    def on_validation_batch_end(  # type: ignore[override]
        self, trainer: Trainer, system: PoseSystem, outputs: ValidationOutput, batch: Batch, *_: Any
    ) -> None:
        """Keep the highest beliefs, and where the labels are."""
        belief = outputs.belief.reshape(len(batch), -1, NUM_KEYPOINTS, *outputs.belief.shape[-2:])
        highest = torch.stack([belief[:, :, :CENTROID].max(), belief[:, :, CENTROID].max()])
        self._highest = torch.fmax(self._highest, highest)
        height, width = batch.images.shape[-2:]
        seen = batch.visible_fraction >= MIN_VISIBLE_FRACTION
        keypoints = batch.keypoints[seen & (batch.object_index != PADDING)]
        limit = keypoints.new_tensor([width, height])
        self._inside.append(((keypoints >= 0) & (keypoints < limit)).all(dim=-1).float().flatten())
        extent = keypoints.amax(dim=1) - keypoints.amin(dim=1)
        self._sizes.append(extent.amax(dim=-1) / system.geometry.stride)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Count, and say so when there have been enough."""
        assert isinstance(pl_module, PoseSystem)
        if trainer.world_size > 1:
            torch.distributed.all_reduce(self._highest, torch.distributed.ReduceOp.MAX)
        self._loss = float(trainer.callback_metrics.get("val/loss", math.nan))
        if math.isnan(self._first_loss):
            self._first_loss = self._loss
        corners, centroid = self._highest.tolist()
        options = pl_module.recovery
        if corners >= options.peak_threshold and centroid >= options.centroid_threshold:
            self._num_empty = 0
        else:
            self._num_empty += 1
        if self._num_empty >= self.patience:
            self._tell(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Say it of a training with fewer validations."""
        assert isinstance(pl_module, PoseSystem)
        if self._num_empty:
            self._tell(trainer, pl_module)

    def _tell(self, trainer: Trainer, system: PoseSystem) -> None:
        if self._told or not trainer.is_global_zero:
            return
        self._told = True
        corners, centroid = self._highest.tolist()
        options = system.recovery
        causes = sorted(self._causes(trainer, system), key=lambda cause: not cause[0])
        lines = [
            f"all belief maps are empty, no pose can be found (validations so far: "
            f"{self._num_empty}): the highest belief of a corner is {corners:.2g} "
            f"(recovery.peak_threshold={options.peak_threshold:g}), of a centroid {centroid:.2g} "
            f"(recovery.centroid_threshold={options.centroid_threshold:g}). The usual causes:",
            *(
                f"  {number}. {what}{' (likely here)' if likely else ''}: {text}"
                for number, (likely, what, text) in enumerate(causes, start=1)
            ),
        ]
        _log.warning("\n".join(lines))

    def _causes(self, trainer: Trainer, system: PoseSystem) -> list[tuple[bool, str, str]]:
        """Return of each cause whether it is likely, its name, and what to look at and try."""
        rate, labels = self._rate(trainer), self._labels()
        early = (
            f"step {trainer.global_step:,} of {trainer.estimated_stepping_batches:,}; wait, or "
            "train longer (trainer.max_epochs)"
        )
        if isinstance(system.loss, MapMSE):
            early += (
                "; to the squared error of model/loss=mse, whose peaks are a few cells of a map, "
                "empty maps are a good answer for long: model/loss=spatial_ce learns from the "
                "first step on"
            )
        return [
            (not rate[0] and not labels[0], "too little training so far", early),
            (rate[0], "a learning rate that is too high or too low", rate[1]),
            (labels[0], "labels or units that do not fit the images", labels[1]),
        ]

    def _rate(self, trainer: Trainer) -> tuple[bool, str]:
        """Judge the learning rate by the validation loss."""
        first, last = self._first_loss, self._loss
        flat = self._num_empty > 1 and not last < _FALL * first
        rates = [group["lr"] for one in trainer.optimizers for group in one.param_groups]
        present = f"{max(rates):.2g}" if rates else "unknown"
        return flat, (
            f"the validation loss went from {first:.4g} to {last:.4g}, the rate is {present} now; "
            "job=lr_finder looks for one, optimizer.lr=… sets it"
        )

    def _labels(self) -> tuple[bool, str]:
        """Judge the labels by where they are in the images."""
        inside, sizes = torch.cat(self._inside), torch.cat(self._sizes)
        look = "look at val_overlay.png, whose truth is green, and run dopepp check on the data"
        if not len(inside):
            return True, f"no object in the validation images is visible enough to count; {look}"
        share, cells = float(inside.mean()), float(sizes.nanmedian())
        wrong = share < _MIN_INSIDE or not cells >= _MIN_CELLS
        return wrong, (
            f"{100 * share:.0f} % of the keypoints are inside the images and an object is "
            f"{cells:.1f} cells of the maps wide; {look}; a part's unit is data.unit; small "
            "objects need a larger data.input_size, narrow peaks a larger maps.sigma"
        )
