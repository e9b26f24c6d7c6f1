"""Guards against optimiser steps that are not finite and against empty belief maps.

:class:`FiniteSteps` synchronises with the device once per optimiser step, as often as torch's own
gradient scaler. :class:`EmptyMaps` lists likely causes when a network detects nothing.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from jaxtyping import Bool
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor
from torch.optim import Optimizer

from dopepp.core.errors import RunError
from dopepp.core.files import write_png
from dopepp.core.validation import Range, check
from dopepp.data.batch import PADDING, Batch
from dopepp.drawing.overlay import GREEN, Wireframe, overlay
from dopepp.drawing.sheet import Tile, contact_sheet
from dopepp.geometry.cuboid import CENTROID, NUM_KEYPOINTS
from dopepp.metrics.pose import MIN_VISIBLE_FRACTION
from dopepp.models.losses import MapMSE
from dopepp.models.storage import write_atomic
from dopepp.training.system import PoseSystem, ValidationOutput, all_finite

_log = logging.getLogger(__name__)

FOLDER: Final = "nonfinite"  # Folder of the run with the batch that ended the run

_COUNTS: Final = Range(1, 10**6)
_CHECKED: Final = ("loss", "gradient", "batch norm's statistics")  # After every backward pass
_MIN_INSIDE: Final = 0.5  # Share of keypoints inside images below which labels are probably wrong
_MIN_CELLS: Final = 3.0  # Narrower objects have all keypoints in one peak of the maps


@dataclass
class _Pass:
    """A forward and backward pass; ``bad`` marks non-finite loss, gradient and statistics."""

    batch: Batch
    loss: Tensor
    bad: Bool[Tensor, "checked"]


class FiniteSteps(Callback):
    """Skips optimiser steps whose loss or gradient is not finite on any process.

    A skipped step changes neither weights nor optimiser states nor batch norm's statistics, but
    counts for the schedule. With gradient accumulation, the whole step is skipped. Overflows due to
    the scaling of mixed precision do not count. After ``max_in_a_row`` skipped steps in a row, the
    run ends with the last batch in its folder ``nonfinite/``.
    """

    def __init__(self, max_in_a_row: int = 10) -> None:
        self.max_in_a_row = check("max_in_a_row", max_in_a_row, int, _COUNTS)
        self.skipped = self.in_a_row = 0
        self._passes: list[_Pass] = []
        self._buffers: list[Tensor] = []
        self._saved_buffers: list[Tensor] = []

    def state_dict(self) -> dict[str, Any]:
        """Return the number of skipped steps."""
        return {"skipped": self.skipped}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the number of skipped steps."""
        self.skipped = int(state_dict["skipped"])

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Collect the buffers that a forward pass changes: batch norm's statistics."""
        self._passes = []
        self._buffers = list(pl_module.buffers())
        self._saved_buffers = [buffer.clone() for buffer in self._buffers]

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Batch, batch_idx: int
    ) -> None:
        """Copy batch norm's statistics before the first batch of an optimiser step."""
        self._batch = batch
        if not self._passes and self._buffers:
            torch._foreach_copy_(self._saved_buffers, self._buffers)

    def on_before_backward(
        self, trainer: Trainer, pl_module: LightningModule, loss: Tensor
    ) -> None:
        """Store the loss, which the gradient scaler of mixed precision may have scaled."""
        self._loss = loss.detach()

    def on_after_backward(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Record whether loss and gradients are finite, without synchronising with the device."""
        gradients = [p.grad for p in pl_module.parameters() if p.grad is not None]
        statistics = [buffer for buffer in self._buffers if buffer.is_floating_point()]
        norms = [
            torch.nn.utils.get_total_norm(tensors).to(self._loss)
            for tensors in (gradients, statistics)
        ]
        bad = ~torch.stack([self._loss, *norms]).isfinite()
        self._passes.append(_Pass(self._batch, self._loss, bad))

    def on_before_optimizer_step(
        self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer
    ) -> None:
        """Skip a step that is not finite on any process; end the run after too many in a row."""
        passes, self._passes = self._passes, []
        bad = torch.stack([item.bad for item in passes]).sum(dim=0)
        if trainer.world_size > 1:
            torch.distributed.all_reduce(bad)
        names = [name for name, count in zip(_CHECKED, bad.tolist(), strict=True) if count > 0]
        if not names:
            self.in_a_row = 0
            return
        scaler = getattr(trainer.precision_plugin, "scaler", None)
        if scaler is not None and names == ["gradient"] and scaler.get_scale() >= 1:
            return
        if self._buffers:
            torch._foreach_copy_(self._buffers, self._saved_buffers)
        # A scaler skips steps with non-finite gradients itself.
        if scaler is None or "gradient" not in names:
            optimizer.zero_grad(set_to_none=True)
        self.skipped += 1
        self.in_a_row += 1
        message = f"{' and '.join(names)} not finite in step {trainer.global_step}"
        broken = not all_finite(pl_module.parameters())
        if self.in_a_row >= self.max_in_a_row or broken:
            folder = self._dump(trainer, passes, names)
            reason = "the weights are not finite" if broken else f"{self.in_a_row} steps in a row"
            raise RunError(f"{message} ({reason}): the run ends; its batch is in {folder}")
        if trainer.is_global_zero:
            counts = f"{self.in_a_row} in a row; at {self.max_in_a_row} the run ends"
            _log.warning("%s: skipping the step (%s)", message, counts)

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Log the number of skipped steps."""
        pl_module.log("train/skipped_steps", float(self.skipped), rank_zero_only=False)

    def _dump(self, trainer: Trainer, passes: list[_Pass], names: list[str]) -> Path:
        """Write the first batch with non-finite values, if this process has one; return the folder.

        Gradients are summed over processes: only the loss shows which process has the batch.
        """
        folder = Path(trainer.default_root_dir) / FOLDER
        mine = (item for item in passes if (item.bad[0] if "loss" in names else item.bad.any()))
        if (item := next(mine, None)) is not None:
            step, epoch = trainer.global_step, trainer.current_epoch
            facts = {"step": step, "epoch": epoch, "not_finite": names, "loss": float(item.loss)}
            _dump_batch(folder / f"step_{step}_rank_{trainer.global_rank}", item.batch, facts)
        return folder


def _dump_batch(path: Path, batch: Batch, facts: Mapping[str, Any]) -> None:
    """Write ``PATH.pt`` (batch, ``facts``) and ``PATH.png`` (first images); warn on a failure."""
    shown = batch.rows(torch.arange(min(len(batch), 64))).to("cpu")
    images, truths = shown.images.permute(0, 2, 3, 1).numpy(), shown.keypoints.numpy()
    tiles = [
        Tile(overlay(image, [Wireframe(points, GREEN, "true") for points in keypoints]), key)
        for image, keypoints, key in zip(images, truths, shown.keys, strict=True)
    ]
    try:
        write_atomic({**facts, **vars(batch.to("cpu"))}, path.with_name(f"{path.name}.pt"))
        write_png(path.with_name(f"{path.name}.png"), contact_sheet(tiles))
    except OSError as error:
        _log.warning("the batch could not be written to %s: %s", path.parent, error)


class EmptyMaps(Callback):
    """Warns once, with likely causes, if all beliefs are too low for detections.

    Maps are empty if no belief of a centroid, or none of a corner, reaches the threshold of the
    recovery on any validation image. The warning follows ``patience`` consecutive validations with
    empty maps, or the end of a shorter training.
    """

    def __init__(self, patience: int = 3) -> None:
        self.patience = check("patience", patience, int, _COUNTS)
        self._num_empty, self._warned = 0, False
        self._first_loss = self._loss = math.nan
        self._highest = torch.zeros(2)
        self._inside: list[Tensor] = []
        self._sizes: list[Tensor] = []

    def state_dict(self) -> dict[str, Any]:
        """Return number of empty validations, first loss and whether the warning was logged."""
        return {"empty": self._num_empty, "warned": self._warned, "first_loss": self._first_loss}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the values of :meth:`state_dict`."""
        self._num_empty, self._warned = int(state_dict["empty"]), bool(state_dict["warned"])
        self._first_loss = float(state_dict["first_loss"])

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Reset the highest beliefs and the statistics of labels."""
        self._highest = torch.zeros(2, device=pl_module.device)
        self._inside, self._sizes = [], []

    def on_validation_batch_end(  # type: ignore[override]
        self, trainer: Trainer, system: PoseSystem, outputs: ValidationOutput, batch: Batch, *_: Any
    ) -> None:
        """Update the highest beliefs, and the positions and sizes of the visible labels."""
        belief = outputs.belief.reshape(len(batch), -1, NUM_KEYPOINTS, *outputs.belief.shape[-2:])
        highest = torch.stack([belief[:, :, :CENTROID].max(), belief[:, :, CENTROID].max()])
        self._highest = torch.fmax(self._highest, highest)
        height, width = batch.images.shape[-2:]
        visible = batch.visible_fraction >= MIN_VISIBLE_FRACTION
        keypoints = batch.keypoints[visible & (batch.object_index != PADDING)]
        limit = keypoints.new_tensor([width, height])
        self._inside.append(((keypoints >= 0) & (keypoints < limit)).all(dim=-1).float().flatten())
        extent = keypoints.amax(dim=1) - keypoints.amin(dim=1)
        self._sizes.append(extent.amax(dim=-1) / system.geometry.stride)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Warn after ``patience`` consecutive validations without peaks above the thresholds."""
        assert isinstance(pl_module, PoseSystem)
        if trainer.world_size > 1:
            torch.distributed.all_reduce(self._highest, torch.distributed.ReduceOp.MAX)
        self._loss = float(trainer.callback_metrics.get("val/loss", math.nan))
        if math.isnan(self._first_loss):
            self._first_loss = self._loss
        corners, centroid = self._highest.tolist()
        options = pl_module.recovery
        enough = corners >= options.peak_threshold and centroid >= options.centroid_threshold
        self._num_empty = 0 if enough else self._num_empty + 1
        if self._num_empty >= self.patience:
            self._warn(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Warn if the last validation had empty maps and the warning was not logged before.

        A resumed training that ends without a validation has no values to report.
        """
        assert isinstance(pl_module, PoseSystem)
        if self._num_empty and self._inside:
            self._warn(trainer, pl_module)

    def _warn(self, trainer: Trainer, system: PoseSystem) -> None:
        """Log once that all maps are empty, with the likely causes first."""
        if self._warned or not trainer.is_global_zero:
            return
        self._warned = True
        corners, centroid = self._highest.tolist()
        options = system.recovery
        lines = [
            f"all belief maps are empty, so no pose can be detected (validations so far: "
            f"{self._num_empty}): the highest belief of a corner is {corners:.2g} "
            f"(recovery.peak_threshold={options.peak_threshold:g}), of a centroid {centroid:.2g} "
            f"(recovery.centroid_threshold={options.centroid_threshold:g}). The usual causes:"
        ]
        bad_rate, about_rate = self._rate(trainer)
        bad_labels, about_labels = self._labels()
        steps = (
            f"step {trainer.global_step:,} of {trainer.estimated_stepping_batches:,}; wait, or "
            "train longer (trainer.max_epochs)"
        )
        if isinstance(system.loss, MapMSE):
            steps += (
                "; with model/loss=mse, empty maps have a small squared error because peaks cover "
                "few cells; model/loss=spatial_ce has no such plateau"
            )
        causes = [
            (not bad_rate and not bad_labels, f"too few training steps{{}}: {steps}"),
            (bad_rate, f"a learning rate that is too high or too low{{}}: {about_rate}"),
            (bad_labels, f"labels or units that contradict the images{{}}: {about_labels}"),
        ]
        likely_first = sorted(causes, key=lambda cause: not cause[0])
        for number, (is_likely, text) in enumerate(likely_first, start=1):
            lines.append(f"  {number}. {text.format(' (likely here)' if is_likely else '')}")
        _log.warning("\n".join(lines))

    def _rate(self, trainer: Trainer) -> tuple[bool, str]:
        """Return whether the validation loss has not decreased by 5 %, and advice on the rate."""
        first, last = self._first_loss, self._loss
        flat = self._num_empty > 1 and not last < 0.95 * first
        rate = max(group["lr"] for group in trainer.optimizers[0].param_groups)
        return flat, (
            f"the validation loss went from {first:.4g} to {last:.4g}, the rate is {rate:.2g} now; "
            "find a rate with job=lr_finder, set it with optimizer.lr=…"
        )

    def _labels(self) -> tuple[bool, str]:
        """Return whether labels are mostly outside the images or too small, with advice."""
        inside, sizes = torch.cat(self._inside), torch.cat(self._sizes)
        advice = "check the green labels in val_overlay.png, and run dopepp check on the data"
        if not len(inside):
            return True, f"no object in the validation images is visible enough; {advice}"
        share, cells = float(inside.mean()), float(sizes.nanmedian())
        wrong = share < _MIN_INSIDE or not cells >= _MIN_CELLS
        return wrong, (
            f"{100 * share:.0f} % of the keypoints are inside the images and an object is "
            f"{cells:.1f} cells of the maps wide; {advice}; a part's unit is data.unit; small "
            "objects need a larger data.input_size, narrow peaks a larger maps.sigma"
        )
