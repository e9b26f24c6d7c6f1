"""PoseSystem: a network, a loss and an optimiser as a LightningModule.

All exchangeable components are passed as objects. To add a callback, write a class in
:mod:`dopepp.training`, and add a line to ``dopepp/experiment/assembly/build_system.py`` and an
entry to ``conf/callbacks``.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from lightning.pytorch import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from dopepp.core.errors import RunError
from dopepp.data.batch import Batch
from dopepp.maps.codec import Beliefs, Fields, MapGeometry
from dopepp.models.heads import Stage
from dopepp.models.losses import MapLoss
from dopepp.models.network import PoseNetwork
from dopepp.parts.part import Part
from dopepp.recovery.detection import Detection, RecoveryOptions
from dopepp.recovery.recover import recover_batch
from dopepp.training.loggers import MetricsTable
from dopepp.training.optimizers import restore_trained_weights
from dopepp.training.targets import (
    SymmetryHandling,
    SymmetryOptions,
    Targets,
    choose_keypoints,
    draw_maps,
)

OptimizerFactory = Callable[[Iterable[nn.Parameter]], Optimizer]
SchedulerFactory = Callable[[Optimizer, int], LRScheduler]

_SCHEDULE_PROGRESS: Final = ("last_epoch", "_step_count", "_last_lr")
"""Entries of a scheduler's state that count steps; the other entries are its settings."""


@dataclass
class ValidationOutput:
    """Loss of a validation batch, with activated belief maps and vector field of the last stage."""

    loss: Float[Tensor, ""]
    belief: Beliefs
    field: Fields


class PoseSystem(LightningModule):
    """Trains a network on belief maps and vector fields, and recovers poses from its maps.

    Args:
        parts: The objects, in the order of the network's channels.
        make_scheduler: Builds a schedule, stepped every batch, from optimiser and number of steps.
        payload: Description of network and data, stored in every checkpoint under ``dopepp``.
    """

    def __init__(
        self,
        network: PoseNetwork,
        loss: MapLoss,
        parts: Sequence[Part],
        geometry: MapGeometry,
        recovery: RecoveryOptions,
        make_optimizer: OptimizerFactory,
        make_scheduler: SchedulerFactory | None = None,
        payload: Mapping[str, Any] | None = None,
        compile_network: bool = False,
        symmetry: SymmetryOptions | None = None,
    ) -> None:
        super().__init__()
        # Convolutions are faster in channels-last memory, on CPUs and tensor cores alike.
        self.network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.loss = loss
        self.parts = tuple(parts)
        self.cuboids = np.stack([part.cuboid for part in parts])
        self.geometry, self.recovery = geometry, recovery
        self.symmetry = SymmetryHandling(parts, symmetry or SymmetryOptions())
        self.make_optimizer, self.make_scheduler = make_optimizer, make_scheduler
        self.payload = dict(payload or {})
        self._resumed_schedules: list[dict[str, Any]] | None = None
        # The network is compiled in place, so that parameters keep their names.
        if compile_network:
            self.network.compile()

    def forward(self, images: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return belief logits and vector fields of each stage for images (B, 3, height, width)."""
        stages: list[tuple[Tensor, Tensor]] = self.network(
            images.contiguous(memory_format=torch.channels_last)
        )
        return stages

    def targets(self, batch: Batch, stages: Sequence[Stage] | None = None) -> Targets:
        """Return the target maps of a batch; ``stages`` may choose among equivalent poses."""
        keypoints = batch.keypoints
        if self.symmetry.active:
            keypoints = choose_keypoints(batch, stages, self.symmetry, self.loss, self.geometry)
        return draw_maps(batch, keypoints, len(self.parts), self.geometry)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Return the loss of the batch; log the loss and its terms."""
        stages = self(batch.images)
        loss, terms = self.loss(stages, *self.targets(batch, stages))
        size = len(batch)
        self.log("train/loss", loss.detach(), prog_bar=True, batch_size=size)
        self.log_dict({f"train/{name}": term for name, term in terms.items()}, batch_size=size)
        return loss  # type: ignore[no-any-return]

    def validation_step(self, batch: Batch, batch_idx: int) -> ValidationOutput:  # type: ignore[override]
        """Log the loss of the batch and return the maps for the callbacks."""
        stages = self(batch.images)
        loss, _ = self.loss(stages, *self.targets(batch, stages))
        self.log("val/loss", loss, prog_bar=True, batch_size=len(batch), sync_dist=True)
        logits, field = stages[-1]
        return ValidationOutput(loss, self.network.activate(logits.float()), field.float())

    def recover(self, output: ValidationOutput, batch: Batch) -> list[list[Detection]]:
        """Recover the detections on each image of a validation batch, without a minimum score."""
        cameras, names = batch.K.cpu().numpy(), [part.name for part in self.parts]
        maps = (output.belief, output.field, self.cuboids, cameras, self.geometry.stride)
        return recover_batch(*maps, names, **vars(replace(self.recovery, min_score=0.0)))

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Build the optimiser and its schedule over all steps of the run."""
        optimizer = self.make_optimizer(self.network.parameters())
        configured: OptimizerLRScheduler = optimizer
        if self.make_scheduler is not None:
            scheduler = self.make_scheduler(optimizer, int(self.trainer.estimated_stepping_batches))
            schedule: Any = {"scheduler": scheduler, "interval": "step"}
            configured = {"optimizer": optimizer, "lr_scheduler": schedule}
        # Settings are stored after the schedule has added its own settings.
        self._settings = [dict(group) for group in optimizer.param_groups]
        return configured

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the trained weights and the progress of schedules; settings may have changed."""
        restore_trained_weights(checkpoint)
        states = checkpoint["lr_schedulers"]
        self._resumed_schedules = [_without_progress(state) for state in states]
        checkpoint["lr_schedulers"] = [
            {name: value for name, value in state.items() if name in _SCHEDULE_PROGRESS}
            for state in states
        ]

    def on_train_start(self) -> None:
        """Continue the metrics table and the learning rate schedule at the resumed step."""
        for logger in self.loggers:
            if isinstance(logger, MetricsTable):
                logger.forget_after(self.global_step - 1)
        self._apply_settings()
        configs = self.trainer.lr_scheduler_configs
        present = [_without_progress(config.scheduler.state_dict()) for config in configs]
        if self._resumed_schedules in (None, present):
            return  # the optimiser's rates already equal the rates of this schedule
        for config in configs:
            with warnings.catch_warnings():
                # torch advises against a given step, but only a given step sets the rate in closed
                # form. A schedule that multiplies the last rate would stay at 0.
                warnings.simplefilter("ignore")
                config.scheduler.step(self.global_step)

    def _apply_settings(self) -> None:
        """Replace the optimiser settings of the checkpoint, except those that a schedule sets."""
        scheduled = {"lr"} if self.trainer.lr_scheduler_configs else set()
        for optimizer in self.trainer.optimizers:
            for group, settings in zip(optimizer.param_groups, self._settings, strict=True):
                unchanged = {"params", *scheduled}
                unchanged |= {"momentum", "betas"} if "max_momentum" in settings else set()
                group.update({k: v for k, v in settings.items() if k not in unchanged})

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Check the state and add :attr:`payload`, with which the file describes itself."""
        check_state(checkpoint)
        checkpoint["dopepp"] = self.payload


def _without_progress(state: Mapping[str, Any]) -> dict[str, Any]:
    """Return a scheduler's state without its counts of steps and the last rates."""
    return {name: value for name, value in state.items() if name not in _SCHEDULE_PROGRESS}


def all_finite(tensors: Iterable[Tensor]) -> bool:
    """Return whether all floating-point values are finite; synchronises once with each device."""
    flags: dict[torch.device, list[Tensor]] = {}  # an optimiser on a GPU counts steps on the CPU
    for tensor in tensors:
        if tensor.is_floating_point():
            flags.setdefault(tensor.device, []).append(tensor.isfinite().all())
    return all(bool(torch.stack(same).all()) for same in flags.values())


def check_state(checkpoint: Mapping[str, Any]) -> None:
    """Raise a RunError if weights or optimiser states of a checkpoint are not finite."""
    for name, text in (("state_dict", "weights"), ("optimizer_states", "optimiser's state")):
        if not all_finite(_tensors(checkpoint.get(name))):
            when = f"after step {checkpoint.get('global_step')}"
            verb = "are" if text == "weights" else "is"
            raise RunError(f"the {text} {verb} not finite {when}: nothing was saved, the run ends")


def _tensors(value: object) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, (Mapping, list, tuple)):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _tensors(item)
