"""Going on with a run: what it is built from, and what may have changed since.

Every difference between the run's config and the present one is told in a line. What the network
learns from (:data:`LEARNT_FROM`, and the images themselves) may change only with
``resume_anyway=true``; the network and the kind of optimiser may not change at all, because the
saved state fits no others. All else is accepted: how long, where, with which callbacks, how fast.

Files, meshes or the rendering code may change under the same options. So a checkpoint holds, of
every split, what its sources say of themselves and how its first image looks: its labels and a
picture of 16 × 12 pixels, which another machine's rounding does not change.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import yaml
from hydra.core.hydra_config import HydraConfig

from dopepp.core.errors import UserError
from dopepp.core.files import write_whole
from dopepp.core.yaml import read_yaml
from dopepp.data.sample import DescribedSource, Sample
from dopepp.experiment.assembly.build_sources import held_out_source
from dopepp.experiment.config.data_config import DataConfig, chosen_data, trained_on
from dopepp.experiment.config.run_config import RunConfig, below, flat
from dopepp.experiment.results.folder import (
    BEST_CHECKPOINT,
    CONFIG_FILE,
    OVERRIDES_FILE,
    read_json,
    write_json,
)
from dopepp.geometry.camera import Letterbox
from dopepp.models.checkpoint import Checkpoint
from dopepp.parts.part import Parts

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
    differences = config_differences(before, config.plain)
    state = [difference for difference in differences if difference.key == _OPTIMIZER]
    if saved.spec != payload["spec"] or state:
        network = [
            difference for difference in differences if below(difference.key, _NETWORK)
        ] + state
        raise UserError(
            f"resume={run}, whose network differs from the chosen one ({_listed(network)})"
            if not state
            else f"resume={run} with another optimiser ({_listed(state)})",
            "the model, the number of objects and the optimiser of that run",
            f"leave them as they were, or start anew with init_from={run / BEST_CHECKPOINT}"
            " where the network is the same",
        )
    learnt = [difference for difference in differences if below(difference.key, LEARNT_FROM)]
    learnt = [difference for difference in learnt if not below(difference.key, _NOT_LEARNT_FROM)]
    if not learnt:  # else the images are others for that reason
        learnt = image_differences(saved.data.get("images"), payload["data"].get("images"))
    if learnt and not config.resume_anyway:
        raise UserError(
            f"resume={run} with other data or another loss ({_listed(learnt)})",
            "what the run has learnt from so far",
            "leave these as they were, or add resume_anyway=true",
        )
    return list(dict.fromkeys([*differences, *learnt]))


def config_differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[ConfigDifference]:
    """Return the options in which two configs differ, but for what belongs to one call alone."""
    old_options, new_options = (dict(flat(config)) for config in (old, new))
    return [
        ConfigDifference(key, _text(old_options, key), _text(new_options, key))
        for key in {**old_options, **new_options}
        if old_options.get(key) != new_options.get(key) and not below(key, _THIS_CALL)
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
            value, allowed = f"{source} with {text!r:.100}", "overrides as key=value"
            raise UserError(value, allowed, "check the run's folder")
        if match["key"] in ("resume", "resume_anyway", "hydra.run.dir"):
            continue
        if "hydra" in re.split(r"[/.@:]", match["key"]):
            _log.warning("%s: %r is left out, Hydra's own options come from you", source, text)
            continue
        kept.append(text)
    return kept


def read_overrides(run: Path) -> list[str] | None:
    """Return the overrides that a run was started with; None where a file is missing or cut."""
    resume_file, overrides, hydra = (run / path for path in (OVERRIDES_FILE, OVERRIDES, _HYDRA))
    if resume_file.is_file():
        return trusted_overrides(read_json(resume_file).get("overrides"), resume_file)
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


_LOOK_SIZE: Final = (16, 12)
_MAX_LEVELS: Final = 2.0
"""Mean difference of two small pictures, in grey levels, above which they show something else."""
_MAX_LABEL: Final = 1e-4
"""Difference of two camera matrices (relative) or poses (metres) above which they are others."""
_LONG: Final = 40
"""Values with more characters are not shown."""


def describe_images(source: DescribedSource) -> dict[str, Any]:
    """Describe a split's images in plain values."""
    sources = {
        f"{number} {info.name}": {"images": info.num_images, **info.identity}
        for number, info in enumerate(source.describe())
    }
    return {"sources": sources, "first_image": _look(source.sample(0, 0))}


def differing_images(stored: Mapping[str, Any], present: Mapping[str, Any]) -> list[str]:
    """Say in which points two descriptions of images differ; nothing where they do not."""
    old, new = dict(flat(stored["sources"])), dict(flat(present["sources"]))
    lines = [
        f"{key}: {_shown(old.get(key))} → {_shown(new.get(key))}"
        for key in {**old, **new}
        if old.get(key) != new.get(key)
    ]
    before, now = stored["first_image"], present["first_image"]
    if before["labels"] != now["labels"] or not all(
        np.allclose(before[name], now[name], rtol=_MAX_LABEL, atol=_MAX_LABEL)
        for name in ("K", "T_cam_obj")
    ):
        lines.append("labels of the first image")
    if _picture_difference(before, now) > _MAX_LEVELS:
        lines.append("pixels of the first image")
    return lines


def _look(sample: Sample) -> dict[str, Any]:
    box = Letterbox.fit(sample.size, _LOOK_SIZE)
    small = cv2.resize(sample.image, (box.width, box.height), interpolation=cv2.INTER_AREA)
    return {
        "K": sample.K.tolist(),
        "labels": [instance.label for instance in sample.instances],
        "T_cam_obj": [instance.T_cam_obj.tolist() for instance in sample.instances],
        "size": [box.width, box.height],
        "pixels": np.asarray(small, np.uint8).tobytes().hex(),
    }


def _picture_difference(before: Mapping[str, Any], now: Mapping[str, Any]) -> float:
    """Return the mean absolute difference, grey levels; infinite for other sizes."""
    if before["size"] != now["size"]:
        return np.inf
    pictures = (
        np.frombuffer(bytes.fromhex(look["pixels"]), np.uint8).astype(float)
        for look in (before, now)
    )
    return float(np.abs(np.subtract(*pictures)).mean())


def _shown(value: object) -> str:
    text = str(value)
    return text if len(text) <= _LONG else f"{text[:_LONG]}…"


def warn_of_other_images(checkpoint: Checkpoint, data: DataConfig, parts: Parts) -> None:
    """Warn of test images that changed under the checkpoint's own options, and of other shapes.

    ``parts`` are the checkpoint's objects as these data have them. A test set of other options is
    what its user wants.
    """
    pairs = zip(checkpoint.parts, parts, strict=True)
    others = [a.name for a, b in pairs if a.mesh_hash and b.mesh_hash not in ("", a.mesh_hash)]
    if others:
        _log.warning("the checkpoint was trained on another shape of %s", ", ".join(others))
    stored, config = checkpoint.data.get("images"), trained_on(checkpoint.data)
    if not isinstance(stored, dict) or config is None:
        return  # a checkpoint that train.py has not written
    try:
        trained_data = chosen_data(None, None, config, "the checkpoint")
    except UserError:
        return  # nor does one whose data nobody can read
    if _test_set(trained_data) != _test_set(data):
        return
    differences = differing_images(
        stored["test"], describe_images(held_out_source(data, parts, "test"))
    )
    if differences:
        _log.warning(
            "the test images are not those of the checkpoint's own figures, "
            "though their configuration is the same: %s",
            "; ".join(differences),
        )


def _test_set(data: DataConfig) -> list[object]:
    """Return the options that name a test set; the others cannot mean another one."""
    named = (data.format, data.root, data.objects, data.parts, data.unit, data.frames, data.virtual)
    return [
        *named,
        data.image_sets,
        data.num_test,
        data.eval_seed,
        data.test.renderer,
        data.targets,
        data.classes or {},
    ]
