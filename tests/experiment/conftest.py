"""Configurations, an entry point without training time, reports and run folders."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from matplotlib.backends.backend_agg import FigureCanvasAgg
from omegaconf import OmegaConf

from dopepp.experiment.config.run_config import RunConfig
from dopepp.experiment.results.folder import FAILURE_FILE, METRICS_FILE, write_config, write_json
from dopepp.experiment.results.report import Cost, Report
from dopepp.experiment.run.evaluate import run_evaluation
from dopepp.metrics.pose import MEAN
from dopepp.metrics.row import PoseErrors, PoseRow, mean_row, summarise


@pytest.fixture
def blank_figures(monkeypatch):
    """Leave the pictures of curves empty, because drawing a figure takes half a second."""
    monkeypatch.setattr(FigureCanvasAgg, "draw", FigureCanvasAgg.get_renderer)


@pytest.fixture
def evaluate(composed, blank_figures, tmp_path):
    """Run ``evaluate.py`` with overrides in a folder of the test; return its reports."""

    def run(*overrides: str, folder: str = "run") -> list[Report]:
        return run_evaluation(composed(*overrides, config="evaluate"), tmp_path / folder)

    return run


CONF = Path(__file__).parents[2] / "conf"
GROUPS = {str(path.relative_to(CONF)) for path in CONF.rglob("*") if path.is_dir()}
COMPOSED: dict[tuple[str, ...], Any] = {}
"""Configs of chosen files; composing takes almost half a second, other values almost no time."""


@pytest.fixture
def composed():
    """Compose ``conf/train.yaml`` (or another config) with overrides, as a plain dict."""

    def make(*overrides: str, config: str = "train") -> dict[str, Any]:
        parsed = OverridesParser.create().parse_overrides(list(overrides))
        chosen = [item for item in parsed if item.key_or_group in GROUPS or item.is_delete()]
        key = (config, *(str(item.input_line) for item in chosen))
        if key not in COMPOSED:
            COMPOSED[key] = compose(config, list(key[1:]))
        made = copy.deepcopy(COMPOSED[key])
        for item in parsed:
            if item not in chosen:
                is_new = item.is_add() or item.is_force_add()
                OmegaConf.update(made, item.key_or_group, item.value(), force_add=is_new)
        plain: dict[str, Any] = OmegaConf.to_container(made, resolve=True, throw_on_missing=True)
        return plain

    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield make


@pytest.fixture
def parsed(composed):
    """Compose and parse the config of ``train.py``."""
    return lambda *overrides: RunConfig.of(composed(*overrides))


@pytest.fixture
def tiny(parsed, tiny_options):
    """Compose and parse a config with a tiny network and tiny data."""
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
        trainer.is_global_zero = True
        trainer.strategy = SimpleNamespace(broadcast=lambda decision: decision)
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
    """Fail, die or be interrupted as the test demands, on the first run only."""
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
    """An entry point like ``train.py`` whose jobs take no time; END_<job>=how ends a job early."""
    path = tmp_path / "fast_training.py"
    path.write_text(FAST_TRAINING)
    (tmp_path / "conf").symlink_to(CONF)
    return path


@pytest.fixture
def call_fast(call, fast_training, tmp_path):
    """Run the fast training in this process."""
    return partial(call, fast_training, f"output_dir={tmp_path}", "~hydra.callbacks.compare")


DIAMETER = 0.1


def report_of(
    name: str,
    add: Sequence[float] | Mapping[str, Sequence[float]],
    *,
    refined: Sequence[float] | None = None,
    test_set: str = "images",
    num_symmetries: int = 1,
) -> Report:
    """Return a report of objects with these ADD errors, metres; the rotation is 10° per mm."""
    add = add if isinstance(add, Mapping) else {"part": add}
    errors = {part: np.array(values, np.float64) for part, values in add.items()}
    rows, constant = {}, {}
    for part, values in errors.items():
        e = torch.from_numpy(values)
        errors_of = PoseErrors(
            e, e, e, None, 10_000 * e, 10_000 * e, None, None, DIAMETER, num_symmetries
        )
        rows[part] = summarise(part, name, errors_of)
        rows[part].miss_rate = float(np.isinf(values).sum() / max(len(values), 1))
        constant[part] = PoseRow(part, "best constant pose", len(values), add_01d=0.2)
    rows[MEAN] = mean_row(list(rows.values()), name)
    constant[MEAN] = mean_row(list(constant.values()), "best constant pose")
    report = Report(
        name, rows, {"best constant pose": constant}, errors, Cost(1234567, 1.5, 7.25),
        sum(map(len, errors.values())),
        rotation_deg={part: 10_000 * values for part, values in errors.items()},
        diameters=dict.fromkeys(errors, DIAMETER), test_set=test_set,
    )  # fmt: skip
    if refined is not None:
        after = report_of(f"{name} + region", dict.fromkeys(errors, refined), test_set=test_set)
        report = replace(report, refined=after)
    return report


def write_run(
    folder: Path, overrides: Sequence[str] = (), result: Report | str | None = None, **config: Any
) -> Path:
    """Write the files of a run: its report, or the reason for its failure."""
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(list(overrides)))
    if isinstance(result, Report):
        write_json(folder / METRICS_FILE, result.to_record())
        seed = next((int(text[5:]) for text in overrides if text.startswith("seed=")), 0)
        model = {"name": result.name, "width": 0.25}
        write_config(folder, {"model": model, "seed": seed, **config})
    elif result is not None:
        write_json(folder / FAILURE_FILE, {"reason": result})
    return folder
