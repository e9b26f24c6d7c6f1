"""Every file in conf/ composes and names only what a registry allows; nothing else is built."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from hydra import compose, initialize_config_dir
from hydra.experimental.callback import Callback
from hydra.utils import get_class

from dopepp.core.errors import UserError
from dopepp.data.transforms.augment import Photometric
from dopepp.data.transforms.jitter import CameraJitter
from dopepp.data.transforms.masking import RandomMask
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.build_sources import build_datamodule
from dopepp.experiment.assembly.build_system import (
    CALLBACKS,
    LOGGERS,
    OPTIMIZERS,
    SCHEDULERS,
    build_system,
    build_trainer,
    optimizer_factory,
    scheduler_factory,
)
from dopepp.experiment.config.run_config import RunConfig
from dopepp.experiment.run.tracking import open_trackers
from dopepp.models.network import ATTENTIONS, BACKBONES, HEADS, LOSSES
from dopepp.models.registry import Registry

CONF = Path(__file__).parents[3] / "conf"
TRANSFORMS = "dopepp.data.transforms"
REGISTRIES: dict[str, Registry[Any]] = {
    "model/backbone": BACKBONES, "model/attention": ATTENTIONS, "model/head": HEADS,
    "model/loss": LOSSES, "optimizer": OPTIMIZERS, "scheduler": SCHEDULERS,
    "callbacks": CALLBACKS, "logger": LOGGERS,
    "data/jitter": Registry("jitter", CameraJitter, [f"{TRANSFORMS}.jitter.CameraJitter"]),
    "data/masking": Registry("masking", RandomMask, [f"{TRANSFORMS}.masking.RandomMask"]),
    "data/augment": Registry("augmentation", Photometric, [f"{TRANSFORMS}.augment.Photometric"]),
}  # fmt: skip
FILES = sorted(CONF.rglob("*.yaml"))
OF_HYDRA = ("hydra/launcher", "hydra/sweeper")
"""Plugins: Hydra itself allows classes of `hydra_plugins` alone."""
CHOICES = [
    (str(path.parent.relative_to(CONF)), path.stem)
    for path in FILES
    # A search composes within a multirun alone, see test_search.py; a preset is read as it is.
    if path.parent != CONF and path.parent.name not in ("search", "preset")
]


def targets(node: object) -> Iterator[str]:
    """Yield every ``_target_`` below a node."""
    if isinstance(node, dict):
        if node.get("_target_") is not None:
            yield node["_target_"]
        for value in node.values():
            yield from targets(value)


def test_conf_has_choices():
    assert len(CHOICES) > 25
    assert set(REGISTRIES) <= {group for group, _ in CHOICES}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(CONF)))
def test_a_file_names_only_allowed_targets(path):
    group = str(path.parent.relative_to(CONF))
    result = list(targets(yaml.safe_load(path.read_text()) or {}))
    if path.parent == CONF:
        assert result
        assert all(issubclass(get_class(item), Callback) for item in result)
        return
    if group in OF_HYDRA:
        assert [target.startswith("hydra_plugins.dopepp_plugins.") for target in result] == [True]
        return
    group = "callbacks" if group == "search" else group
    assert not result or group in REGISTRIES, f"{path} builds {result}, which no registry guards"
    for target in result:
        REGISTRIES[group].resolve(target)


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


@pytest.mark.parametrize("choice", [
    "data=bop_renders", "experiment=dragon", "experiment=lmo_each", "experiment=ycb_objects",
    "experiment=table1_real_hybrid", "experiment=table7_ycbv",
])  # fmt: skip
def test_a_choice_that_needs_a_data_set_is_refused_without(choice, parsed):
    with pytest.raises(UserError, match=r"got data.* without data\.root"):
        build_parts(parsed(choice).data)


@pytest.mark.parametrize(
    "choice",
    [
        f"{group}={name}"
        for group, name in CHOICES
        if group in ("model", "model/backbone", "model/attention", "model/head", "model/loss")
    ],
)
def test_every_model_choice_trains_one_step(choice, tiny):
    config = tiny(choice, "data.parts=[pivconnector,servoholder]")
    system = build_system(config, build_parts(config.data), "")
    stages = system(torch.randint(0, 256, (1, 3, 64, 64), dtype=torch.uint8))
    belief, field = stages[-1]
    assert (belief.shape, field.shape) == ((1, 18, 8, 8), (1, 32, 8, 8))
    loss, _ = system.loss(stages, torch.zeros_like(belief), torch.zeros_like(field))
    loss.backward()
    system.make_optimizer(system.network.parameters()).step()


@pytest.mark.parametrize("name", ["adam", "adamw", "muon", "sgd"])
@pytest.mark.parametrize("schedule", ["constant", "cosine", "onecycle"])
def test_every_optimizer_runs_every_schedule(name, schedule, tiny):
    config = tiny(f"optimizer={name}", f"scheduler={schedule}", "optimizer.lr=0.01")
    system = build_system(config, build_parts(config.data), "")
    optimizer = system.make_optimizer(system.network.parameters())
    if schedule == "constant":
        assert system.make_scheduler is None
        return
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


HOSTILE = {
    "model.backbone": "os.system", "model.attention": "subprocess.Popen",
    "model.head": "builtins.eval", "optimizer": "dopepp.models.network.build_network",
    "model.loss": "dopepp.experiment.assembly.build_system.torch.hub.load",
    "scheduler": "dopepp.training.system.PoseSystem", "data.jitter": "not_a_module.Thing",
    # These three pass Hydra's own list of forbidden names.
    "data.masking": "torch.utils.collect_env.run", "data.augment": "sympy.sympify",
    "callbacks.checkpoint": "torch.load",
    "logger.extra": "torch.optim",
}  # fmt: skip


def build_all(config: RunConfig, run_dir: Path) -> None:
    parts = build_parts(config.data)
    build_datamodule(config.data, parts, seed=0)
    build_system(config, parts, "")
    with open_trackers(config, run_dir) as trackers:
        build_trainer(config, run_dir, trackers=trackers)


@pytest.mark.parametrize(("place", "target"), HOSTILE.items())
def test_a_hostile_target_is_refused(place, target, tiny, tmp_path):
    config = tiny(f"++{place}._target_='{target}'")
    with pytest.raises(UserError, match="_target_") as error:
        build_all(config, tmp_path)
    assert repr(target) in error.value.got
    assert "\n" not in str(error.value)


def test_every_folder_of_an_evaluation_is_below_output_dir():
    with initialize_config_dir(str(CONF), version_base="1.3"):
        hydra = compose("evaluate", ["output_dir=x"], return_hydra_config=True).hydra
    assert hydra.run.dir == hydra.sweep.dir
    assert hydra.sweep.dir.startswith("x/evaluate/")


def test_a_rejected_optimizer_value_is_reported_immediately():
    with pytest.raises(UserError, match="learning rate"):
        optimizer_factory({"_target_": "torch.optim.Adam", "lr": -1.0})


@pytest.mark.parametrize("num_steps", [0, 1, 2, 9, 10, 11, 20])
def test_one_cycle_accepts_any_number_of_steps(num_steps):
    node = {"_target_": "torch.optim.lr_scheduler.OneCycleLR", "max_lr": 0.1, "pct_start": 0.1}
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=0.1)
    schedule = scheduler_factory(node)(optimizer, num_steps)
    for _ in range(num_steps):
        assert 0 <= optimizer.param_groups[0]["lr"] <= 0.1
        optimizer.step()
        schedule.step()
