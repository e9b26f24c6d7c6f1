from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from dopepp.experiment.config.run_config import RunConfig

CONF = Path(__file__).parents[2] / "conf"


@pytest.fixture
def composed():
    """Compose ``conf/train.yaml`` (or another one) with overrides, as a plain dict."""

    def make(*overrides: str, config: str = "train") -> dict[str, Any]:
        return OmegaConf.to_container(
            compose(config, list(overrides)), resolve=True, throw_on_missing=True
        )

    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield make


@pytest.fixture
def parsed(composed):
    """The same as ``train.py`` parses it."""
    return lambda *overrides: RunConfig.of(composed(*overrides))


@pytest.fixture
def tiny(parsed, tiny_options):
    """The same with a network and data that take no time."""
    return partial(parsed, *tiny_options)


FAST_TRAINING = '''
"""train.py with a training that takes no time: its objective is best at a learning rate of 1e-3."""
import math, os, signal, time
from pathlib import Path
from types import SimpleNamespace
import hydra, torch
from dopepp.experiment.results.folder import METRICS_FILE, write_json
from dopepp.experiment.entries import entry, run_job
from dopepp.experiment.assembly.build_system import CALLBACKS
from dopepp.training.pruning import raise_if_pruned

EPOCHS = 4

def train(config, run_dir):
    lr, number = config["optimizer"]["lr"], run_dir.name
    with (run_dir.parent / "started.txt").open("a") as stream:
        stream.write(f"{number} {lr}\\n")
    print(f"printed by job {number}", flush=True)
    if lr <= 0:
        raise ValueError(f"lr={lr}")
    value = 1 - abs(math.log10(lr) + 3) / 4
    if "trial" in config["callbacks"]:
        report = CALLBACKS.build(config["callbacks"]["trial"])
        trainer = SimpleNamespace(max_epochs=EPOCHS, should_stop=False, callbacks=[report])
        report.setup(trainer, None, "fit")
        for trainer.current_epoch in range(EPOCHS):
            now = torch.tensor(value * (trainer.current_epoch + 1) / EPOCHS)
            trainer.callback_metrics = {"val/selection": now}
            report.on_validation_end(trainer, None)
            end(run_dir, os.environ.get(f"END_{number}"))
            if trainer.should_stop:
                break
        raise_if_pruned(trainer)
    else:
        end(run_dir, os.environ.get(f"END_{number}"))
    write_json(run_dir / METRICS_FILE, {"objective": value})

def end(run_dir, how):
    """Fail, die or be interrupted as the test asks, the first time."""
    if how is None or (run_dir / "ended_once").exists():
        return
    (run_dir / "ended_once").touch()
    if how == "raise":
        raise RuntimeError("as the test asked")
    os.kill(os.getpid(), signal.SIGINT if how == "interrupt" else signal.SIGKILL)
    time.sleep(60)  # the signal ends it

@hydra.main(version_base="1.3", config_path="conf", config_name="train")
def main(config):
    return run_job(config, train)

if __name__ == "__main__":
    entry(main)
'''


@pytest.fixture
def fast_training(tmp_path):
    """An entry point like ``train.py`` whose jobs take no time; END_<job>=how ends one early."""
    path = tmp_path / "fast_training.py"
    path.write_text(FAST_TRAINING)
    (tmp_path / "conf").symlink_to(CONF)
    return path


@pytest.fixture
def call_fast(call, fast_training, tmp_path):
    """Run it inside this process."""
    return partial(call, fast_training, f"output_dir={tmp_path}", "~hydra.callbacks.compare")
