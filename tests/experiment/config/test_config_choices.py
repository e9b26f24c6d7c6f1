"""Every file in conf/ composes and names only what a gate allows."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from hydra.experimental.callback import Callback
from hydra.utils import get_class

from dopepp.experiment.build.registries import (
    AUGMENTATIONS,
    CALLBACKS,
    LOGGERS,
    MASKINGS,
    OPTIMIZERS,
    SCHEDULERS,
)
from dopepp.experiment.build.sources import build_parts
from dopepp.experiment.build.system import build_system, build_trainer
from dopepp.experiment.config.run import RunConfig
from dopepp.models.registry import Registry
from dopepp.models.spec import ATTENTIONS, BACKBONES, HEADS, LOSSES

CONF = Path(__file__).parents[3] / "conf"
GATES: dict[str, Registry[Any]] = {
    "model/backbone": BACKBONES,
    "model/attention": ATTENTIONS,
    "model/head": HEADS,
    "model/loss": LOSSES,
    "data/masking": MASKINGS,
    "data/augment": AUGMENTATIONS,
    "optimizer": OPTIMIZERS,
    "scheduler": SCHEDULERS,
    "callbacks": CALLBACKS,
    "logger": LOGGERS,
}
FILES = sorted(CONF.rglob("*.yaml"))
OF_HYDRA = ("hydra/launcher", "hydra/sweeper")
"""Plugins: Hydra itself allows classes of `hydra_plugins` alone."""
CHOICES = [
    (str(path.parent.relative_to(CONF)), path.stem)
    for path in FILES
    # A search composes within a multirun alone, see test_search_study.py.
    if path.parent != CONF and path.parent.name != "search"
]


def targets(node: object) -> Iterator[str]:
    """Yield every ``_target_`` below a node."""
    if isinstance(node, dict):
        if node.get("_target_") is not None:
            yield node["_target_"]
        for value in node.values():
            yield from targets(value)


def test_there_are_choices_to_check():
    assert len(CHOICES) > 25
    assert set(GATES) <= {group for group, _ in CHOICES}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(CONF)))
def test_a_file_names_only_allowed_targets(path):
    group = str(path.parent.relative_to(CONF))
    found = list(targets(yaml.safe_load(path.read_text()) or {}))
    if path.name == "train.yaml" and group == ".":
        assert [issubclass(get_class(one), Callback) for one in found] == [True, True]
        return
    if group in OF_HYDRA:
        assert [one.startswith("hydra_plugins.dopepp_plugins.") for one in found] == [True]
        return
    group = "callbacks" if group == "search" else group
    assert not found or group in GATES, f"{path} builds {found}, which no gate guards"
    for target in found:
        GATES[group].resolve(target)


@pytest.mark.parametrize(("group", "name"), CHOICES, ids=lambda text: str(text))
def test_every_choice_composes(group, name, composed):
    config = composed(f"{group}={name}")
    RunConfig.of(config)
    node: Any = config
    for key in group.split("/"):
        # Overlays (`# @package _global_`) leave no key of their own.
        node = node.get(key, {}) if group not in ("experiment", "debug") else {}
    written = yaml.safe_load((CONF / group / f"{name}.yaml").read_text()) or {}
    for key, value in written.items():
        if node and key != "defaults" and not isinstance(value, (dict, str)):
            assert node[key] == value


@pytest.mark.parametrize("group", ["data", None])
def test_evaluation_composes(group, composed):
    overrides = ["ckpt_path=x.ckpt", *([f"{group}=virtual"] if group else [])]
    config = composed(*overrides, config="evaluate")
    assert (config.get("data") is not None) == (group is not None)


MODEL_CHOICES = [
    f"{group}={name}"
    for group, name in CHOICES
    if group in ("model", "model/backbone", "model/attention", "model/head", "model/loss")
]


@pytest.mark.parametrize("choice", MODEL_CHOICES)
def test_every_model_choice_trains_one_step(choice, tiny):
    config = tiny(choice, "data.parts=[pivconnector,servoholder]")
    system = build_system(config, build_parts(config.data), "")
    stages = system(torch.randint(0, 256, (1, 3, 64, 64), dtype=torch.uint8))
    belief, field = stages[-1]
    assert belief.shape == (1, 18, 8, 8)
    assert field.shape == (1, 32, 8, 8)
    loss, _ = system.loss(stages, torch.zeros_like(belief), torch.zeros_like(field))
    loss.backward()
    optimizer = system.make_optimizer(system.network.parameters())
    optimizer.step()


@pytest.mark.parametrize("name", ["adam", "adamw", "sgd"])
@pytest.mark.parametrize("schedule", ["constant", "cosine", "onecycle"])
def test_every_optimizer_takes_every_schedule_to_its_end(name, schedule, tiny):
    config = tiny(f"optimizer={name}", f"scheduler={schedule}", "optimizer.lr=0.01")
    system = build_system(config, build_parts(config.data), "")
    optimizer = system.make_optimizer(system.network.parameters())
    if schedule == "constant":
        assert system.make_scheduler is None
        return
    assert system.make_scheduler is not None
    scheduler = system.make_scheduler(optimizer, 20)
    rates = []
    for _ in range(20):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        if len(rates) < 20:
            scheduler.step()
    assert max(rates) == pytest.approx(0.01, rel=0.02)
    assert rates[-1] < 1e-3


@pytest.mark.parametrize("name", ["auto", "cpu", "ddp"])
def test_trainers_are_built(name, tiny, tmp_path):
    config = tiny(f"trainer={name}", "trainer.accelerator=cpu", "trainer.precision=32-true")
    trainer = build_trainer(config, tmp_path)
    assert trainer.world_size == (2 if name == "ddp" else 1)
    assert len(trainer.loggers) == 1
