"""Reading run folders: trainings, evaluations and whole multiruns; failed ones are read too."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from dopepp.core.errors import UserError
from dopepp.core.yaml import read_yaml
from dopepp.experiment.config.parse import as_written_now
from dopepp.experiment.cost import COST_FILE
from dopepp.experiment.reports.evaluators import Cost
from dopepp.experiment.reports.report import Report
from dopepp.experiment.runs import record

_HYDRA: Final = Path(".hydra")
_TRACES: Final = (_HYDRA, Path(record.CONFIG_FILE), Path(record.METRICS_FILE),
                  Path(record.FAILURE_FILE))  # fmt: skip
"""A run leaves at least one of these."""

_ELSEWHERE: Final = ("output_dir", "resume", "ckpt_path", "baseline", "device", "num_pictures")
"""Options that say where something is, not what is measured."""

_UNKNOWN_MODEL: Final = "run"
"""What a run is called that left nothing but its folder."""


@dataclass
class Run:
    """A run folder.

    Attributes:
        folder: The folder.
        model: The model's name.
        overrides: What it was overridden with, without options that only name places.
        report: Its result, None where there is none.
        failure: Why there is none, in one line; empty where none was asked for (``job=cost``).
        seed: Of the training; None where unknown.
        config: The resolved config, empty where there is none.
        checkpoint: Its best checkpoint, None where unknown.
        recipe: Everything but seed and parts that decides about the result, as one text; empty
            where unknown.
        cost: What its network costs; None where unknown.
        pruned: Whether it has no result because a search stopped it.
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
    cost: Cost | None = None
    pruned: bool = False


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
    cost, failure, report, pruned = None, "", None, False
    try:
        report = _result(folder)
        cost = _cost(folder) if report is None else report.cost
    except _FailedError as error:
        failure, pruned = str(error), isinstance(error, _PrunedError)
    config = _mapping(folder / record.CONFIG_FILE)
    checkpoint = folder / record.BEST_CHECKPOINT
    if report is not None and "checkpoint" in report.details:
        checkpoint = folder / str(report.details["checkpoint"])
    training, overrides = config, overrides_of(folder)
    configs = [config] if config else []
    if "ckpt_path" in config:  # an evaluation: what it measured says what was trained, and how
        checkpoint = Path(str(config["ckpt_path"]))
        trained = checkpoint.parent.parent
        training = _mapping(trained / record.CONFIG_FILE)
        overrides = [*overrides_of(trained), *overrides]
        configs = [config, training] if training else []
    seed = training.get("seed")
    return Run(
        folder,
        _model(training or _mapping(folder / _HYDRA / "config.yaml"), overrides, report),
        overrides,
        report,
        failure,
        seed if isinstance(seed, int) else None,
        config,
        checkpoint,
        _recipe(configs),
        cost,
        pruned,
    )


def _model(config: Mapping[str, Any], overrides: Sequence[str], report: Report | None) -> str:
    """Return the model's name, of a run that ended early as far as it is known."""
    model = config.get("model")
    if isinstance(model, dict) and "name" in model:
        return str(model["name"])
    chosen = [text.partition("=")[2] for text in overrides if text.startswith("model=")]
    if chosen:
        return chosen[-1]
    return _UNKNOWN_MODEL if report is None else report.name


def _recipe(configs: Sequence[Mapping[str, Any]]) -> str:
    """Return configs as one text, without seed and parts and without what only names places."""
    kept = [
        {key: value for key, value in config.items() if key not in ("seed", *_ELSEWHERE)}
        for config in map(as_written_now, configs)
    ]
    for config in kept:
        if isinstance(config.get("data"), dict):
            config["data"] = {k: v for k, v in config["data"].items() if k != "parts"}
    return json.dumps(kept, sort_keys=True, default=str) if kept else ""


class _FailedError(Exception):
    """Why a run has no result, in one line."""


class _PrunedError(_FailedError):
    """When a search stopped it, and why."""


def _result(folder: Path) -> Report | None:
    """Return a run's result; None of a job that was to measure its network's cost alone.

    Raises:
        _FailedError: It failed, did not finish, or left a damaged file.
    """
    failed, metrics = folder / record.FAILURE_FILE, folder / record.METRICS_FILE
    try:
        if failed.is_file():
            raise _FailedError(record.read_json(failed).get("reason", "without a reason"))
        if (folder / record.PRUNED_FILE).is_file():
            reason = record.read_json(folder / record.PRUNED_FILE).get("reason", "")
            raise _PrunedError(reason)
        if metrics.is_file():
            return Report.from_record(record.read_json(metrics))
    except UserError as error:
        raise _FailedError(str(error)) from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise _FailedError(f"{metrics.name} is not of this version: {error!r}") from error
    if (folder / COST_FILE).is_file():
        return None
    unfinished = f"unfinished: it left no {metrics.name}"
    if (folder / record.LAST_CHECKPOINT).is_file():
        unfinished += f"; go on with resume={folder}"
    raise _FailedError(unfinished)


def _cost(folder: Path) -> Cost:
    """Return what a job that measures costs has left."""
    try:
        stored = record.read_json(folder / COST_FILE)
        return Cost(stored["parameters"], stored["gmacs"], stored["ms_per_frame"])
    except (UserError, KeyError) as error:
        raise _FailedError(f"{COST_FILE} is not of this version: {error}") from error


def overrides_of(folder: Path) -> list[str]:
    """Return what a run was overridden with, without Hydra's own and what only names places."""
    path = folder / _HYDRA / "overrides.yaml"
    try:
        listed = read_yaml(path) if path.is_file() else []
    except UserError:  # cut short where the disk was full
        listed = []
    texts = [str(text).lstrip("+") for text in listed] if isinstance(listed, list) else []
    places = tuple(f"{name}=" for name in _ELSEWHERE)
    return [text for text in texts if not text.startswith(("hydra.", *places))]


def _mapping(path: Path) -> dict[str, Any]:
    """Read a YAML mapping; empty where there is none."""
    try:
        content = read_yaml(path) if path.is_file() else {}
    except UserError:  # as above
        content = {}
    return content if isinstance(content, dict) else {}
