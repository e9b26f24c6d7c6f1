"""Reading run folders: trainings, evaluations and whole multiruns; failed ones are read too."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import yaml

from dopepp.errors import UserError
from dopepp.experiment import record
from dopepp.experiment.cost import COST_FILE
from dopepp.experiment.report import Report

_HYDRA: Final = Path(".hydra")
_TRACES: Final = (_HYDRA, Path(record.CONFIG_FILE), Path(record.METRICS_FILE),
                  Path(record.FAILURE_FILE))  # fmt: skip
"""A run leaves at least one of these."""

_ELSEWHERE: Final = ("output_dir", "resume", "ckpt_path", "baseline", "device", "num_pictures")
"""Options that say where something is, not what is measured."""


@dataclass
class Run:
    """A run folder.

    Attributes:
        folder: The folder.
        model: The model's name.
        overrides: What it was overridden with, without options that only name places.
        report: Its result, None where there is none.
        failure: Why there is none, in one line.
        seed: Of the training; None where unknown.
        config: The resolved config, empty where there is none.
        checkpoint: Its best checkpoint, None where unknown.
        recipe: Everything but the seed that decides about the result, as one text; empty where
            unknown.
    """

    folder: Path
    model: str
    overrides: list[str]
    report: Report | None
    failure: str
    seed: int | None
    config: dict[str, Any] = field(default_factory=dict)
    checkpoint: Path | None = None
    recipe: str = ""


def find_runs(paths: Sequence[Path]) -> list[Run]:
    """Read run folders, evaluation folders and all jobs of multirun folders, each once.

    Raises:
        UserError: A path is none of them.
    """
    folders = {folder.resolve(): folder for path in paths for folder in _folders(path)}
    return [read_run(folder) for folder in folders.values()]


def _folders(path: Path) -> Iterator[Path]:
    if any((path / trace).exists() for trace in _TRACES):
        yield path
        return
    jobs = [one for one in path.iterdir() if one.name.isdigit()] if path.is_dir() else []
    if not jobs:
        raise UserError(
            f"{path}, which holds no run",
            "the folder of a training, an evaluation or a multirun",
            "pass a folder with metrics.json or config.yaml in it",
        )
    yield from sorted(jobs, key=lambda one: int(one.name))


def read_run(folder: Path) -> Run:
    """Read one run folder; whatever is missing or damaged in it becomes its failure."""
    report, failure = _result(folder)
    config = _mapping(folder / record.CONFIG_FILE)
    composed = config or _mapping(folder / _HYDRA / "config.yaml")
    overrides = _overrides(folder)
    training, recipe = config, [_without_places(config)] if config else []
    checkpoint = folder / record.BEST_CHECKPOINT
    if report is not None and "checkpoint" in report.details:
        checkpoint = folder / str(report.details["checkpoint"])
    if "ckpt_path" in composed:  # an evaluation: what it measured says what was trained
        checkpoint = Path(str(composed["ckpt_path"]))
        trained = checkpoint.parent.parent
        training = composed = _mapping(trained / record.CONFIG_FILE)
        overrides = [*_overrides(trained), *overrides]
        recipe = [*recipe, _without_places(training)] if training else []
    seed = training.get("seed")
    model = composed.get("model") or {}
    chosen = [text.partition("=")[2] for text in overrides if text.startswith("model=")]
    named = [str(model["name"])] if "name" in model else chosen[-1:]
    return Run(
        folder,
        (named or [report.name if report is not None else "dopepp"])[0],
        overrides,
        report,
        failure,
        seed if isinstance(seed, int) else None,
        config,
        checkpoint,
        json.dumps(recipe, sort_keys=True, default=str) if recipe else "",
    )


def _result(folder: Path) -> tuple[Report | None, str]:
    """Return a run's result, or why there is none."""
    failed, metrics = folder / record.FAILURE_FILE, folder / record.METRICS_FILE
    try:
        if failed.is_file():
            return None, str(record.read_json(failed).get("reason", "without a reason"))
        if (folder / COST_FILE).is_file():
            return None, ""
        if metrics.is_file():
            return Report.from_record(record.read_json(metrics)), ""
    except UserError as error:
        return None, str(error)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        return None, f"{metrics.name} is not of this version: {error!r}"
    if (folder / record.LAST_CHECKPOINT).is_file():
        return None, f"unfinished: it left no {metrics.name}; go on with resume={folder}"
    return None, f"unfinished: it left no {metrics.name}"


def _overrides(folder: Path) -> list[str]:
    path = folder / _HYDRA / "overrides.yaml"
    try:
        listed = yaml.safe_load(path.read_text()) if path.is_file() else []
    except (OSError, ValueError, yaml.YAMLError):  # cut short where the disk was full
        listed = []
    texts = [str(text).lstrip("+") for text in listed or []]
    return [text for text in texts if not text.startswith(("hydra.", *_places()))]


def _places() -> tuple[str, ...]:
    return tuple(f"{name}=" for name in _ELSEWHERE)


def _mapping(path: Path) -> dict[str, Any]:
    """Read a YAML mapping; empty where there is none."""
    try:
        content = yaml.safe_load(path.read_text()) if path.is_file() else {}
    except (OSError, ValueError, yaml.YAMLError):  # as above
        content = {}
    return content if isinstance(content, dict) else {}


def _without_places(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a config without the seed and without what only names places."""
    return {key: value for key, value in config.items() if key not in ("seed", *_ELSEWHERE)}
