"""Options and images that may change when a run is resumed, and overrides of a run folder."""

import contextlib
import copy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from dopepp.core.errors import UserError
from dopepp.data.sample import Instance, Sample
from dopepp.experiment.command_line import prepare
from dopepp.experiment.results.folder import (
    CONFIG_FILE,
    OVERRIDES_FILE,
    write_config,
    write_json,
)
from dopepp.experiment.run.described_images import describe_images, differing_images
from dopepp.experiment.run.resume import (
    check_resume,
    config_differences,
    read_overrides,
    trusted_overrides,
)
from dopepp.models.checkpoint import Checkpoint
from tests.data.makers import MadeSource, pose_at


def one_image(level: int = 100, shift: float = 0.0, **identity: object) -> MadeSource:
    """Return a source of one image of a grey level, with a part that may be shifted."""

    def make(index: int, epoch: int) -> Sample:
        image = np.full((48, 64, 3), level, np.uint8)
        part = Instance("part", pose_at(0, 0, 0.5 + shift), np.zeros((9, 2)))
        return Sample(image, np.eye(3), [part], None, "x", "0")

    return MadeSource(make, 1, "images", identity)


def test_descriptions_of_images_reveal_differences():
    first = describe_images(one_image(files="ab" * 32, parts={"a": "1"}))
    # Through a file and back, and with another machine's rounding, it is the same.
    again = yaml.safe_load(yaml.safe_dump(first))
    rounded = describe_images(one_image(101, 1e-7, files="ab" * 32, parts={"a": "1"}))
    assert (differing_images(first, again), differing_images(first, rounded)) == ([], [])
    for other, expected in (
        (one_image(files="cd" * 32, parts={"a": "1"}), "0 images.files: abab"),
        (one_image(files="ab" * 32, parts={"a": "2"}), "0 images.parts.a: 1 → 2"),
        (one_image(files="ab" * 32), "0 images.parts.a: 1 → None"),
        (one_image(100, 0.01, files="ab" * 32, parts={"a": "1"}), "labels of the first image"),
        (one_image(110, 0.0, files="ab" * 32, parts={"a": "1"}), "pixels of the first image"),
    ):
        (line,) = differing_images(first, describe_images(other))
        assert line.startswith(expected)
        assert len(line) < 120


def test_a_new_preset_field_with_equal_images_is_no_difference():
    first, new = (describe_images(one_image(preset=text)) for text in ("Preset()", "Preset(a=1)"))
    assert differing_images(first, new) == []
    (line,) = differing_images(first, describe_images(one_image(110, preset="Preset(a=1)")))
    assert line == "pixels of the first image"


def test_a_part_that_is_called_preset_is_compared():
    first, other = (describe_images(one_image(parts={"preset": mesh})) for mesh in "12")
    assert differing_images(first, other) == ["0 images.parts.preset: 1 → 2"]


@pytest.fixture
def resumed(tiny, tmp_path):
    """Resume a run with overrides and return the accepted differences."""
    (tmp_path / "run").mkdir()
    started = tiny()
    write_config(tmp_path / "run", started.plain)
    images = {split: describe_images(one_image()) for split in ("train", "val", "test")}

    def go_on(*overrides: str, spec: str = "a", **splits: MadeSource) -> list[str]:
        saved = Checkpoint({"net": "a"}, {}, [], (64, 64), 8, 1.0, data={"images": images})
        present = {**images, **{name: describe_images(first) for name, first in splits.items()}}
        payload = {"spec": {"net": spec}, "data": {"images": copy.deepcopy(present)}}
        config = tiny(*overrides) if overrides else started
        accepted = check_resume(tmp_path / "run", config, saved, payload)
        return [str(item) for item in accepted]

    return go_on


ACCEPTED = {
    "trainer.max_epochs=9": "trainer.max_epochs: 1 → 9",
    "data.num_workers=3": "data.num_workers: 0 → 3",
    "data.num_test=9": "data.num_test: 3 → 9",
    "data/test=photoreal": "data.test.renderer: None → photoreal",
    "data.cache_dir=/x": "data.cache_dir: None → /x",
    "optimizer.weight_decay=0.5": "optimizer.weight_decay: 0.01 → 0.5",
    "trainer.precision=32-true": "trainer.precision: auto → 32-true",
    "callbacks.overlays.num_images=3": "callbacks.overlays.num_images: 12 → 3",
    "recovery.max_peaks=3": "recovery.max_peaks: 64 → 3",
    "logger=tensorboard": "logger.tensorboard.name: not set → tensorboard",
}


def test_options_without_effect_on_learning_may_change(resumed):
    accepted = resumed(*ACCEPTED)
    assert set(ACCEPTED.values()) <= set(accepted)
    assert len(accepted) < len(ACCEPTED) + 5  # what hangs on them: the other logger's options


def test_unchanged_runs_have_no_differences(resumed):
    assert resumed() == []
    assert resumed("output_dir=/elsewhere", "resume=x", "resume_anyway=true") == []
    assert resumed(test=one_image(50)) == []  # test images do not affect learning


LEARNT_FROM = {
    "seed=1": "seed: 0 → 1",
    "data.batch_size=2": "data.batch_size: 4 → 2",
    "data.samples_per_epoch=4": "data.samples_per_epoch: 8 → 4",
    "data.cache=memory": "data.cache: none → memory",  # all epochs are equal
    "virtual.preset=table": "virtual.preset: quickstart → table",
    "++virtual.scene.lighting.tint=0.5": "virtual.scene.lighting.tint: not set → 0.5",
    "data.masking.probability=0.1": "data.masking.probability: 0.5 → 0.1",
    "data/augment=none": "data.augment._target_: dopepp.data.transforms.augment.Photometric → None",
    "maps.sigma=2.0": "maps.sigma: 1.0 → 2.0",
    "symmetry=none": "symmetry.canonical: True → False",
    "model/loss=mse": "model.loss._target_: dopepp.models.losses.SpatialCrossEntropy → ",
    "trainer.accumulate_grad_batches=2": "trainer.accumulate_grad_batches: 1 → 2",
    "trainer.devices=2": "trainer.devices: 1 → 2",
}


def test_learning_options_change_only_with_resume_anyway(resumed):
    harmless = "trainer.max_epochs=9"
    with pytest.raises(UserError, match="with other data or another loss") as error:
        resumed(*LEARNT_FROM, harmless)
    for line in LEARNT_FROM.values():
        assert line in error.value.got
    assert "max_epochs" not in error.value.got
    assert error.value.fix.endswith("add resume_anyway=true")
    accepted = resumed(*LEARNT_FROM, harmless, "resume_anyway=true")
    for line in (*LEARNT_FROM.values(), "trainer.max_epochs: 1 → 9"):
        assert sum(item.startswith(line) for item in accepted) == 1, line


@pytest.mark.parametrize("split", ["train", "val"])
def test_changed_images_with_equal_options_are_rejected(split, resumed):
    changed: dict[str, Any] = {split: one_image(50)}
    with pytest.raises(UserError, match=rf"{split} images: as trained on → changed \(pixels of"):
        resumed(**changed)
    assert len(resumed("resume_anyway=true", **changed)) == 1


@pytest.mark.parametrize("anyway", ["true", "false"])
def test_another_network_or_optimiser_is_always_rejected(anyway, resumed):
    with pytest.raises(UserError, match=r"network differs.*model\.width: 0\.0625 → 0\.5") as error:
        resumed("model.width=0.5", f"resume_anyway={anyway}", spec="b")
    assert "init_from=" in error.value.fix
    with pytest.raises(UserError, match="the number of objects"):
        resumed(f"resume_anyway={anyway}", spec="b")
    with pytest.raises(UserError, match=r"another optimiser \(optimizer\._target_: .*Muon → .*SGD"):
        resumed("optimizer=sgd", f"resume_anyway={anyway}")
    with pytest.raises(UserError, match=r"other initial weights \(init_from: None → a\.ckpt\)"):
        resumed("init_from=a.ckpt", f"resume_anyway={anyway}")


def test_a_run_without_config_is_compared_by_its_checkpoint(resumed, tmp_path):
    (tmp_path / "run" / CONFIG_FILE).unlink()
    assert resumed("seed=1") == []
    with pytest.raises(UserError, match="network differs"):
        resumed(spec="b")


def test_a_new_option_with_null_is_no_difference():
    assert config_differences({"data": {"a": 1}}, {"data": {"a": 1, "new": None}}) == []


def test_overrides_of_the_task_are_kept():
    stored = [
        "model=dope", "data/augment=none", "data.parts=[pivconnector]", "+trainer.num_nodes=1",
        "++virtual.scene.turning={tilt_deg: 3}", "~callbacks.overlays", "output_dir=/a b/ö=1",
        "logger=wandb", "experiment=quickstart", "optimizer._target_=torch.optim.RMSprop",
        "resume=/x", "resume_anyway=true", "hydra.run.dir=/x",
    ]  # fmt: skip
    assert trusted_overrides(stored, Path("overrides.yaml")) == stored[:10]


def test_a_job_of_a_table_is_resumed_by_itself_and_beside_options(tmp_path, monkeypatch):
    stored = ["experiment=table6_dope_vs_dopepp", "model=dope"]
    write_json(tmp_path / OVERRIDES_FILE, {"overrides": stored})
    given = [f"resume={tmp_path}", "hydra.run.dir=/elsewhere", "seed=2"]
    monkeypatch.setattr("sys.argv", ["train.py", "--cfg", "hydra", *given, "--resolve"])
    prepare([], {}, 1)
    fixed = [f"hydra.run.dir={tmp_path}", "hydra.output_subdir=null", "hydra.mode=RUN"]
    words = ["--cfg", "hydra", *stored, *fixed, given[0], "seed=2", "--resolve"]
    assert sys.argv[1:] == words


def test_a_trial_of_a_search_is_resumed_by_itself(tmp_path):
    stored = ["search=optuna", "++search.num_trials=3", "callbacks.trial.prune=false", "seed=1"]
    assert trusted_overrides(stored, tmp_path) == ["seed=1"]


OF_HYDRA = (
    "hydra.callbacks.x._target_=os.system", "+hydra.callbacks.x={_target_: sympy.sympify, a: x}",
    "++hydra.callbacks.x._target_=torch.load", "hydra/launcher=joblib", "+hydra/launcher=x",
    "hydra/sweeper@x=y", "override hydra/launcher=x", "hydra.sweeper._target_=os.system",
    "hydra.launcher._target_=torch.utils.collect_env.run", "hydra.searchpath=[file:///tmp/evil]",
    "hydra.mode=MULTIRUN", "~hydra.callbacks", "+logger@hydra.callbacks=wandb",
    "+logger@_global_.hydra.callbacks=wandb", "hydra={callbacks: {x: {_target_: os.system}}}",
    " hydra.mode=MULTIRUN", "--config-dir=/tmp/evil", "-cd=/tmp", "--multirun", "-m",
    "--config-path", "",
)  # fmt: skip


@pytest.mark.parametrize("text", OF_HYDRA)
def test_options_of_hydra_are_not_read_from_a_run(text):
    """Hostile files are in tests/security/test_hostile_runs.py."""
    kept = []
    with contextlib.suppress(UserError):
        kept = trusted_overrides(["model=dope", text], Path("overrides.yaml"))
    assert kept in ([], ["model=dope"])


def test_a_folder_without_overrides(tmp_path):
    assert read_overrides(tmp_path) is None
