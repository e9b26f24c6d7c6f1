"""What a config may name besides the network's own parts.

To allow a class of your own, ``CALLBACKS.register("my_package.my_module.MyCallback")`` before the
run starts, or list it here.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from lightning.pytorch import Callback
from lightning.pytorch.loggers import Logger
from torch import nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from dopepp.models.registry import TARGET, Registry
from dopepp.training.system import OptimizerFactory, SchedulerFactory

T = TypeVar("T")

OPTIMIZERS: Registry[Optimizer] = Registry(
    "optimizer",
    Optimizer,
    (
        "dopepp.training.optimizers.Muon",
        *(f"torch.optim.{name}" for name in ("Adam", "AdamW", "RMSprop", "SGD")),
    ),
)
SCHEDULERS: Registry[LRScheduler] = Registry(
    "scheduler",
    LRScheduler,
    (f"torch.optim.lr_scheduler.{name}LR" for name in ("CosineAnnealing", "Linear", "OneCycle")),
)
CALLBACKS: Registry[Callback] = Registry(
    "callback",
    Callback,
    (
        "dopepp.training.pose_validation.AUCCurves",
        "dopepp.training.pose_validation.BeliefMaps",
        "dopepp.training.pose_validation.EarlyStop",
        "dopepp.training.guards.EmptyMaps",
        "dopepp.training.guards.FiniteSteps",
        "dopepp.training.last_checkpoint.LastCheckpoint",
        "dopepp.training.pose_validation.Overlays",
        "dopepp.training.pose_validation.PoseMetricsCallback",
        "dopepp.training.throughput.Throughput",
        "dopepp.training.pruning.TrialReport",
        "lightning.pytorch.callbacks.EarlyStopping",
        "lightning.pytorch.callbacks.LearningRateMonitor",
        "lightning.pytorch.callbacks.ModelCheckpoint",
        "lightning.pytorch.callbacks.Timer",
    ),
)
LOGGERS: Registry[Logger] = Registry(
    "logger",
    Logger,  # type: ignore[type-abstract]
    ("lightning.pytorch.loggers.TensorBoardLogger", "lightning.pytorch.loggers.WandbLogger"),
)

_TOTAL_STEPS = ("total_steps", "T_max", "total_iters")
"""What torch's schedulers call the number of steps of a run."""


def optimizer_factory(node: Mapping[str, Any]) -> OptimizerFactory:
    """Return a function from parameters to the optimiser that a node describes.

    The node is checked at once, on a parameter of its own, so that a mistake shows at the start.
    """

    def make(parameters: Iterable[nn.Parameter]) -> Optimizer:
        return OPTIMIZERS.build(node, params=list(parameters))

    make([nn.Parameter()])
    return make


def scheduler_factory(node: Mapping[str, Any]) -> SchedulerFactory | None:
    """Return a function from (optimiser, number of steps) to the schedule; None for a constant."""
    if node.get(TARGET) is None:
        return None
    parameters = inspect.signature(SCHEDULERS.resolve(node[TARGET])).parameters
    total = next(name for name in _TOTAL_STEPS if name in parameters)

    def make(optimizer: Optimizer, num_steps: int) -> LRScheduler:
        try:
            return SCHEDULERS.build(node, optimizer=optimizer, **{total: max(1, num_steps)})
        except ZeroDivisionError:  # OneCycleLR whose warm-up is exactly one step long
            return SCHEDULERS.build(node, optimizer=optimizer, **{total: num_steps + 1})

    return make


def build_optional(kind: str, base: type[T], node: Mapping[str, Any]) -> T | None:
    """Build the object of a node that may name one class; None where its choice is ``none``."""
    registry = Registry(kind, base, [f"{base.__module__}.{base.__qualname__}"])
    return None if node.get(TARGET) is None else registry.build(node)
