"""A config cannot make a run call anything but what the gates allow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from dopepp.core.errors import UserError
from dopepp.experiment.build.registries import (
    AUGMENTATIONS,
    CALLBACKS,
    LOGGERS,
    MASKINGS,
    OPTIMIZERS,
    SCHEDULERS,
    optimizer_factory,
    scheduler_factory,
)
from dopepp.experiment.build.sources import build_datamodule, build_parts
from dopepp.experiment.build.system import build_system, build_trainer
from dopepp.experiment.config.run import RunConfig
from dopepp.experiment.runs.tracking import tracked
from dopepp.models.registry import Registry
from dopepp.models.spec import ATTENTIONS, BACKBONES, HEADS, LOSSES

HOSTILE = (
    "os.system",
    "subprocess.Popen",
    "builtins.eval",
    "dopepp.experiment.build.system.torch.hub.load",
    "dopepp.models.spec.build_network",
    "dopepp.training.system.PoseSystem",
    "not_a_module.Thing",
    "torch.utils.collect_env.run",  # these three pass Hydra's own list of forbidden names
    "sympy.sympify",
    "torch.load",
    "torch.optim",
    "",
)
PLACES = (
    "model.backbone",
    "model.attention",
    "model.head",
    "model.loss",
    "optimizer",
    "scheduler",
    "data.masking",
    "data.augment",
    "callbacks.checkpoint",
    "logger.extra",
)


def build_all(config: RunConfig, run_dir: Path) -> None:
    parts = build_parts(config.data)
    build_datamodule(config.data, parts, seed=0)
    build_system(config, parts, "")
    with tracked(config, run_dir) as trackers:
        build_trainer(config, run_dir, trackers=trackers)


@pytest.mark.parametrize(
    ("place", "target"),
    [(place, HOSTILE[number % len(HOSTILE)]) for number, place in enumerate(PLACES)],
)
def test_a_hostile_target_is_refused(place, target, tiny, tmp_path):
    config = tiny(f"++{place}._target_='{target}'")
    with pytest.raises(UserError, match="_target_") as error:
        build_all(config, tmp_path)
    assert repr(target) in error.value.got
    assert "\n" not in str(error.value)


GATES: tuple[Registry[Any], ...] = (
    OPTIMIZERS, SCHEDULERS, CALLBACKS, LOGGERS, MASKINGS, AUGMENTATIONS,
    BACKBONES, ATTENTIONS, HEADS, LOSSES,
)  # fmt: skip


@pytest.mark.parametrize("target", HOSTILE)
def test_no_gate_lets_a_hostile_target_through(target):
    for gate in GATES:
        with pytest.raises(UserError, match="_target_"):
            gate.build({"_target_": target})


@pytest.mark.parametrize("place", ["optimizer", "callbacks.checkpoint", "data.masking"])
def test_nested_targets_are_refused(place, tiny, tmp_path):
    argument = {"optimizer": "lr", "data.masking": "probability"}.get(place, "filename")
    override = f"++{place}.{argument}={{_target_: os.system, command: true}}"
    # Where the optimiser's rate is one, the schedule's copy of it is one too.
    config = tiny(override, "scheduler=constant")
    with pytest.raises(UserError, match="_target_"):
        build_all(config, tmp_path)


def test_an_unknown_argument_is_named():
    with pytest.raises(UserError, match=r"argument 'speed' of torch\.optim\.Adam"):
        optimizer_factory({"_target_": "torch.optim.Adam", "speed": 1})


def test_a_refused_value_shows_at_once():
    with pytest.raises(UserError, match="learning rate"):
        optimizer_factory({"_target_": "torch.optim.Adam", "lr": -1.0})


def test_a_constant_rate_has_no_schedule():
    assert scheduler_factory({"_target_": None}) is None


@pytest.mark.parametrize("num_steps", [0, 1, 2, 9, 10, 11, 20])
def test_a_cycle_may_be_as_short_as_it_likes(num_steps):
    node = {"_target_": "torch.optim.lr_scheduler.OneCycleLR", "max_lr": 0.1, "pct_start": 0.1}
    factory = scheduler_factory(node)
    assert factory is not None
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=0.1)
    schedule = factory(optimizer, num_steps)
    for _ in range(num_steps):
        assert 0 <= optimizer.param_groups[0]["lr"] <= 0.1
        optimizer.step()
        schedule.step()


@pytest.mark.parametrize("gate", [OPTIMIZERS, SCHEDULERS, CALLBACKS, LOGGERS])
def test_what_a_gate_lists_it_resolves(gate):
    for target in gate.targets:
        assert issubclass(gate.resolve(target), gate.base)


def test_every_scheduler_learns_the_number_of_steps():
    for target in SCHEDULERS.targets:
        node = {"_target_": target} | ({"max_lr": 0.1} if "OneCycle" in target else {})
        factory = scheduler_factory(node)
        assert factory is not None
        optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=0.1, momentum=0.9)
        state = factory(optimizer, 17).state_dict()
        assert 17 in [state.get(name) for name in ("total_steps", "T_max", "total_iters")]
