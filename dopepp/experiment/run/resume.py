"""Going on with a run: what it is built from, and what may have changed since.

Every difference between the run's config and the present one is told in a line. What the network
learns from (:data:`LEARNT_FROM`, and the images themselves) may change only with
``resume_anyway=true``; the network and the kind of optimiser may not change at all, because the
saved state fits no others. All else is accepted: how long, where, with which callbacks, how fast.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import yaml
from hydra.core.hydra_config import HydraConfig

from dopepp.core.errors import UserError
from dopepp.core.files import write_whole
from dopepp.core.yaml import read_yaml
from dopepp.experiment.config.run import RunConfig, below, flat
from dopepp.experiment.results.folder import (
    BEST_CHECKPOINT,
    CONFIG_FILE,
    OVERRIDES_FILE,
    read_json,
    write_json,
)
from dopepp.experiment.run.images import differing_images
from dopepp.models.checkpoint import Checkpoint

_log = logging.getLogger(__name__)

OVERRIDES: Final = Path(".hydra", "overrides.yaml")
_HYDRA: Final = Path(".hydra", "hydra.yaml")

LEARNT_FROM: Final = (
    "seed", "data", "virtual", "maps", "symmetry", "model.loss",
    "trainer.devices", "trainer.num_nodes", "trainer.accumulate_grad_batches",
)  # fmt: skip
"""Options that decide images, targets, loss, and which images make a step."""
_NOT_LEARNT_FROM: Final = (
    "data.num_workers", "data.cache_dir", "data.download_dir", "data.num_test", "data.test",
    "data.image_sets.test", "data.targets",
)  # fmt: skip
"""… with these exceptions: where renders are kept, who loads, and the test images."""
_THIS_CALL: Final = ("resume", "resume_anyway", "output_dir")
_NETWORK: Final = ("model.backbone", "model.attention", "model.head", "model.width")
_OPTIMIZER: Final = "optimizer._target_"

_ABSENT: Final = "not set"
_OVERRIDE: Final = re.compile(r"(\+\+?|~)?(?P<key>[A-Za-z_][\w/.@:]*)(=.*)?", re.DOTALL)


@dataclass(frozen=True)
class ConfigDifference:
    """One option, by its dotted name, whose value is not as it was; both values as text."""

    key: str
    old: str
    new: str

    def __str__(self) -> str:
        """Return the line a person reads."""
        return f"{self.key}: {self.old} → {self.new}"


def check_resume(
    run: Path, config: RunConfig, saved: Checkpoint, payload: Mapping[str, Any]
) -> list[ConfigDifference]:
    """Return the accepted differences between a run and the config that is to go on with it.

    ``payload`` is what a checkpoint of the present run would say of itself.

    Raises:
        UserError: The network or the kind of optimiser differs, or what is learnt from does and
            ``resume_anyway`` is not set.
    """
    path = run / CONFIG_FILE
    before = read_yaml(path) if path.is_file() else config.plain
    if not isinstance(before, Mapping):
        raise UserError(f"{path} with a {type(before).__name__}", "a config", "check the run")
    found = config_differences(before, config.plain)
    state = [one for one in found if one.key == _OPTIMIZER]
    if saved.spec != payload["spec"] or state:
        network = [one for one in found if below(one.key, _NETWORK)] + state
        raise UserError(
            f"resume={run}, whose network differs from the chosen one ({_listed(network)})"
            if not state
            else f"resume={run} with another optimiser ({_listed(state)})",
            "the model, the number of objects and the optimiser of that run",
            f"leave them as they were, or start anew with init_from={run / BEST_CHECKPOINT}"
            " where the network is the same",
        )
    learnt = [one for one in found if below(one.key, LEARNT_FROM)]
    learnt = [one for one in learnt if not below(one.key, _NOT_LEARNT_FROM)]
    if not learnt:  # else the images are others for that reason
        learnt = image_differences(saved.data.get("images"), payload["data"].get("images"))
    if learnt and not config.resume_anyway:
        raise UserError(
            f"resume={run} with other data or another loss ({_listed(learnt)})",
            "what the run has learnt from so far",
            "leave these as they were, or add resume_anyway=true",
        )
    return list(dict.fromkeys([*found, *learnt]))


def config_differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[ConfigDifference]:
    """Return the options in which two configs differ, but for what belongs to one call alone."""
    one, other = (dict(flat(config)) for config in (old, new))
    return [
        ConfigDifference(key, _text(one, key), _text(other, key))
        for key in {**one, **other}
        if one.get(key) != other.get(key) and not below(key, _THIS_CALL)
    ]


def image_differences(saved: object, present: object) -> list[ConfigDifference]:
    """Say where training and validation images are others though the options may be the same."""
    if not isinstance(saved, Mapping) or not isinstance(present, Mapping):
        return []  # a checkpoint that train.py has not written
    return [
        ConfigDifference(f"{split} images", "as trained on", f"others ({'; '.join(lines)})")
        for split in ("train", "val")
        for lines in [differing_images(saved[split], present[split])]
        if lines
    ]


def trusted_overrides(stored: object, source: Path) -> list[str]:
    """Return a run's own overrides without those that belong to the call it was started with.

    A run's folder may come from anybody. On the command line Hydra takes flags, and builds whatever
    its own nodes name; so neither is taken from a folder. The rest must be overrides.
    """
    if not isinstance(stored, list) or not all(isinstance(text, str) for text in stored):
        raise UserError(f"{source} without a list of overrides", "key=value lines", "check the run")
    kept = []
    for text in stored:
        match = _OVERRIDE.fullmatch(text)
        if match is None:
            got, allowed = f"{source} with {text!r:.100}", "overrides as key=value"
            raise UserError(got, allowed, "check the run's folder")
        if match["key"] in ("resume", "resume_anyway", "hydra.run.dir"):
            continue
        if "hydra" in re.split(r"[/.@:]", match["key"]):
            _log.warning("%s: %r is left out, Hydra's own options come from you", source, text)
            continue
        kept.append(text)
    return kept


def read_overrides(run: Path) -> list[str] | None:
    """Return the overrides that a run was started with; None where a file is missing or cut."""
    own, overrides, hydra = (run / path for path in (OVERRIDES_FILE, OVERRIDES, _HYDRA))
    if own.is_file():
        return trusted_overrides(read_json(own).get("overrides"), own)
    # Killed before it wrote its own file. Hydra writes the overrides last
    # and once more in another file: a file that was cut in the middle does not agree with it.
    if not overrides.is_file():
        return None
    stored = read_yaml(overrides)
    if hydra.is_file() and stored != _task(read_yaml(hydra)):
        return None
    return trusted_overrides(stored, overrides)


def remember_overrides(run: Path) -> None:
    """Write down how a run was started, or goes on: Hydra's own file may be cut in the middle."""
    if not HydraConfig.initialized():
        return
    overrides = [str(text) for text in HydraConfig.get().overrides.task]
    write_json(run / OVERRIDES_FILE, {"overrides": overrides})
    write_whole(run / OVERRIDES, yaml.safe_dump(overrides).encode())


def _task(hydra: object) -> object:
    for key in ("hydra", "overrides", "task"):
        hydra = hydra.get(key) if isinstance(hydra, dict) else None
    return hydra


def _text(entries: Mapping[str, object], key: str) -> str:
    return str(entries[key]) if key in entries else _ABSENT


def _listed(differences: Sequence[ConfigDifference]) -> str:
    return ", ".join(map(str, differences)) or "the number of objects"
