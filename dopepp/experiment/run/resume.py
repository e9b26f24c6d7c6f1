"""Check whether a run can be resumed with the present config and images.

Every difference between the stored and the present config is reported. Options that affect
learning (:data:`LEARNT_FROM`) and the images may change only with ``resume_anyway=true``. The
network and the kind of optimiser must not change, because the saved state would not fit, nor the
initial weights, which would have no effect. All other options may change, such as the duration, the
device and the callbacks.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import yaml
from hydra.core.hydra_config import HydraConfig

from dopepp.core.errors import UserError
from dopepp.core.files import write_file
from dopepp.core.yaml import read_yaml
from dopepp.experiment.config.run_config import RunConfig, flatten, is_below
from dopepp.experiment.results.folder import (
    BEST_CHECKPOINT,
    CONFIG_FILE,
    OVERRIDES_FILE,
    read_json,
    write_json,
)
from dopepp.experiment.run.described_images import differing_images
from dopepp.models.checkpoint import Checkpoint

_log = logging.getLogger(__name__)

OVERRIDES: Final = Path(".hydra", "overrides.yaml")
_HYDRA: Final = Path(".hydra", "hydra.yaml")

LEARNT_FROM: Final = (
    "seed", "data", "virtual", "maps", "symmetry", "model.loss",
    "trainer.devices", "trainer.num_nodes", "trainer.accumulate_grad_batches",
)  # fmt: skip
"""Options that determine images, targets, loss and the composition of batches."""
_NOT_LEARNT_FROM: Final = (
    "data.num_workers", "data.cache_dir", "data.download_dir", "data.num_test", "data.test",
    "data.image_sets.test", "data.targets",
)  # fmt: skip
"""Exceptions from :data:`LEARNT_FROM`: caches, loader processes and the test images."""
_THIS_CALL: Final = ("resume", "resume_anyway", "output_dir")
"""Options that resume a run or select its folder, and do not affect the training."""
_NETWORK: Final = ("model.backbone", "model.attention", "model.head", "model.width")
_OPTIMIZER: Final = "optimizer._target_"

# A trial of a search is resumed by itself, because only the search knows the trial's number.
_DROPPED: Final = ("resume", "resume_anyway", "hydra.run.dir", "search", "callbacks.trial")

_ABSENT: Final = "not set"
_OVERRIDE: Final = re.compile(r"(\+\+?|~)?(?P<key>[A-Za-z_][\w/.@:]*)(=.*)?", re.DOTALL)


class ConfigDifference(NamedTuple):
    """An option, by its dotted name, with its old and new value as text."""

    key: str
    values: tuple[str, str]

    def __str__(self) -> str:
        return f"{self.key}: {' → '.join(self.values)}"


def check_resume(
    run: Path, config: RunConfig, saved: Checkpoint, payload: Mapping[str, Any]
) -> list[ConfigDifference]:
    """Return the accepted differences between a run and the config that resumes it.

    ``saved`` is the last checkpoint of the run, ``payload`` the description of a checkpoint of the
    present config. A UserError is raised if the network, the kind of optimiser or ``init_from``
    differs, or the data or the loss without ``resume_anyway``.
    """
    path = run / CONFIG_FILE
    before = read_yaml(path) if path.is_file() else config.plain
    if not isinstance(before, Mapping):
        fix = "restore the file from backup, or start a new run"
        raise UserError(
            f"{path}, which contains a {type(before).__name__}", "a mapping of options", fix
        )
    differences = config_differences(before, config.plain)
    state = [change for change in differences if change.key == _OPTIMIZER]
    if saved.spec != payload["spec"] or state:
        network = [change for change in differences if is_below(change.key, _NETWORK)]
        raise UserError(
            f"resume={run}, whose network differs from the config's ({_listed(network + state)})"
            if not state
            else f"resume={run} with another optimiser ({_listed(state)})",
            "the model, the number of objects and the optimiser of the interrupted run",
            "restore these options, or start a new run with "
            f"init_from={run / BEST_CHECKPOINT} if the network is the same",
        )
    if initial := [change for change in differences if change.key == "init_from"]:
        raise UserError(
            f"resume={run} with other initial weights ({_listed(initial)})",
            "init_from of the interrupted run, which continues with its own weights",
            "leave out init_from, or start a new run without resume",
        )
    learnt = [change for change in differences if is_below(change.key, LEARNT_FROM)]
    learnt = [change for change in learnt if not is_below(change.key, _NOT_LEARNT_FROM)]
    if not learnt:  # changed options already explain changed images
        learnt = image_differences(saved.data.get("images"), payload["data"].get("images"))
    if learnt and not config.resume_anyway:
        raise UserError(
            f"resume={run} with other data or another loss ({_listed(learnt)})",
            "the data and the loss of the interrupted run",
            "restore these options, or add resume_anyway=true",
        )
    return list(dict.fromkeys([*differences, *learnt]))


def config_differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[ConfigDifference]:
    """Return the options in which two configs differ, except those that only resume a run."""
    before, after = dict(flatten(old)), dict(flatten(new))
    return [
        ConfigDifference(key, (str(before.get(key, _ABSENT)), str(after.get(key, _ABSENT))))
        for key in {**before, **after}
        if before.get(key) != after.get(key) and not is_below(key, _THIS_CALL)
    ]


def image_differences(saved: object, present: object) -> list[ConfigDifference]:
    """Return the splits (train, val) whose descriptions in two checkpoints differ, with reasons."""
    differences: list[ConfigDifference] = []
    if isinstance(saved, Mapping) and isinstance(present, Mapping):  # both written by train.py
        for split in ("train", "val"):
            if lines := differing_images(saved[split], present[split]):
                changed = f"changed ({'; '.join(lines)})"
                differences.append(ConfigDifference(f"{split} images", ("as trained on", changed)))
    return differences


def trusted_overrides(stored: object, source: Path) -> list[str]:
    """Return the overrides of a run, except those of its folder, of resuming and of a search.

    A run folder is not trusted. Hydra's flags and nodes could execute arbitrary code, so they are
    not read from a folder.
    """
    texts = stored if isinstance(stored, list) else [stored]
    matches = [_OVERRIDE.fullmatch(text) if isinstance(text, str) else None for text in texts]
    kept = []
    for text, match in zip(texts, matches, strict=True):
        if match is None:
            fix = "restore the file from backup, or start a new run"
            raise UserError(f"{source} with {text!r:.100}", "a list of overrides key=value", fix)
        if is_below(match["key"], _DROPPED):
            continue
        if "hydra" in re.split(r"[/.@:]", match["key"]):
            _log.warning(
                "%s: ignoring %r, because Hydra options are not read from a run", source, text
            )
            continue
        kept.append(text)
    return kept


def read_overrides(run: Path) -> list[str] | None:
    """Return the overrides of a run, or None if a file is missing or truncated."""
    resume_file, overrides, hydra = (run / path for path in (OVERRIDES_FILE, OVERRIDES, _HYDRA))
    if resume_file.is_file():
        return trusted_overrides(read_json(resume_file).get("overrides"), resume_file)
    # The run was killed before it wrote its own file. Hydra writes the overrides into two files;
    # if they differ, a file is truncated.
    if not overrides.is_file():
        return None
    stored = read_yaml(overrides)
    if hydra.is_file() and stored != task_overrides(read_yaml(hydra)):
        return None
    return trusted_overrides(stored, overrides)


def remember_overrides(run: Path) -> None:
    """Store this process's overrides in ``run`` atomically; Hydra's own file may be truncated."""
    if not HydraConfig.initialized():
        return
    overrides = [str(text) for text in HydraConfig.get().overrides.task]
    write_json(run / OVERRIDES_FILE, {"overrides": overrides})
    write_file(run / OVERRIDES, yaml.safe_dump(overrides).encode())


def task_overrides(hydra: object) -> object:
    """Return the overrides in Hydra's stored config, except those of Hydra itself, or None."""
    for key in ("hydra", "overrides", "task"):
        hydra = hydra.get(key) if isinstance(hydra, dict) else None
    return hydra


def _listed(differences: Sequence[ConfigDifference]) -> str:
    """Join differences of options; without any, the number of objects differs."""
    return ", ".join(map(str, differences)) or "the number of objects"
