"""Read run folders and group the runs into methods.

A method is one or more training runs that differ only in seed or object. Training runs, evaluations
and multiruns are read, including failed and unfinished runs.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.core.yaml import read_yaml
from dopepp.experiment.config.data_config import AUTOMATIC
from dopepp.experiment.results.folder import (
    BEST_CHECKPOINT,
    CONFIG_FILE,
    COST_FILE,
    FAILURE_FILE,
    LAST_CHECKPOINT,
    METRICS_FILE,
    PRUNED_FILE,
    read_end,
)
from dopepp.experiment.results.frame import shown_rows
from dopepp.experiment.results.report import Cost, Report

TABLE_FILE: Final = "compare.csv"
BASELINE: Final = "dope"  # default name of the baseline: the first method, to which every Δ refers

_HYDRA: Final = ".hydra"

# Options of locations, devices and further measurements, which do not affect the result.
_ELSEWHERE: Final = ("output_dir", "resume", "ckpt_path", "baseline", "device", "num_pictures")
_BESIDE: Final = ("shading", "scale_factors", "by", "num_bins", "bop_csv", "all_measures")

_LONGEST_NAME: Final = 60  # maximum length of a method's name in tables and legends


@dataclass
class Run:
    """A training, evaluation or cost measurement, as read from its run folder."""

    folder: Path
    overrides: list[str]  # without those of locations, devices or Hydra itself
    config: dict[str, Any]  # resolved; empty if unknown
    checkpoint: Path
    model: str = ""
    report: Report | None = None
    failure: str = ""  # reason for a missing result, unless only the cost was requested
    seed: int | None = None
    recipe: str = ""  # all options that affect the result, except seed and objects, if known
    cost: Cost | None = None
    pruned: bool = False  # the result is missing because a search stopped the run

    @property
    def method_key(self) -> tuple[str, str, str] | None:
        """Recipe, name and test set, equal for all runs of a method; None if unknown."""
        if self.report is None or self.seed is None or not self.recipe:
            return None
        return self.recipe, self.report.name, self.report.test_set

    @property
    def short_path(self) -> str:
        """Name of the folder; a numbered job is preceded by the name of its multirun."""
        folder = self.folder.resolve()
        return f"{folder.parent.name}/{folder.name}" if folder.name.isdigit() else folder.name


@dataclass
class Entry:
    """A method in a comparison."""

    name: str
    reports: list[Report] = field(default_factory=list)  # on one test set, one per seed
    seeds: list[int | None] = field(default_factory=list)  # None if unknown
    failure: str = ""  # reason for a missing result, unless only the cost was requested
    pruned: bool = False  # a search stopped the run, which does not count as a failure
    runs: list[Run] = field(default_factory=list)
    refine: str = ""  # empty for the poses of the network itself

    @property
    def test_set(self) -> str:
        """Fingerprint of the test images; empty if unknown."""
        return self.reports[0].test_set if self.reports else ""

    @property
    def objects(self) -> list[str]:
        """Names of the objects, followed by the mean if there are several."""
        return list(shown_rows(self.reports[0].rows)) if self.reports else []

    @property
    def cost(self) -> Cost:
        """Cost of the method; the time is the mean over seeds."""
        costs = [report.cost for report in self.reports]
        costs = costs or [run.cost or Cost() for run in self.runs[:1]]
        times = [cost.ms_per_frame for cost in costs if cost.ms_per_frame is not None]
        return replace(costs[0], ms_per_frame=float(np.mean(times)) if times else None)


def find_runs(paths: Sequence[Path]) -> list[Run]:
    """Read the runs in folders of training runs, evaluations and multiruns, each folder once."""
    found = {path: _folders(path) for path in paths}
    for path, folders in found.items():
        # ``outputs/compare/*`` also matches the folders of earlier comparisons.
        is_comparison = (path / TABLE_FILE).is_file() and any(found.values())
        if not folders and not is_comparison:
            raise UserError(
                f"{path}, which holds no run",
                "the folder of a training run, an evaluation or a multirun",
                "pass a folder with metrics.json or config.yaml in it",
            )
    once = {folder.resolve(): folder for folders in found.values() for folder in folders}
    return [read_run(folder) for folder in once.values()]


def _folders(path: Path) -> list[Path]:
    """Return the folder itself if it holds a run, or the numbered job folders of a multirun."""
    traces = (_HYDRA, CONFIG_FILE, METRICS_FILE, FAILURE_FILE)  # every run writes one of these
    if any((path / trace).exists() for trace in traces):
        return [path]
    jobs = [job for job in path.iterdir() if job.name.isdigit()] if path.is_dir() else []
    return sorted(jobs, key=lambda job: int(job.name))


def read_run(folder: Path) -> Run:
    """Read one run folder; ``Run.failure`` states which result is missing or damaged."""
    config = _mapping(folder / CONFIG_FILE)
    run = Run(folder, overrides_of(folder), config, folder / BEST_CHECKPOINT)
    try:
        _read_result(run)
    except UserError as error:
        run.failure = str(error)
    if run.report is not None and "checkpoint" in run.report.details:
        run.checkpoint = folder / str(run.report.details["checkpoint"])
    training, configs = config, [_without_automatic_values(folder, config)] if config else []
    if config.get("ckpt_path") is not None:  # its checkpoint belongs to a training run
        run.checkpoint = Path(str(config["ckpt_path"]))
        trained = run.checkpoint.parent.parent
        training = _mapping(trained / CONFIG_FILE)
        run.overrides = [*overrides_of(trained), *run.overrides]
        configs = [config, _without_automatic_values(trained, training)] if training else []
    seed = training.get("seed")
    run.seed = seed if isinstance(seed, int) else None
    run.recipe = _recipe(configs)
    run.model = _model(training or _mapping(folder / _HYDRA / "config.yaml"), run)
    return run


def _model(config: Mapping[str, Any], run: Run) -> str:
    """Return the name of the model, from the overrides if the run ended early."""
    model = config.get("model")
    if isinstance(model, dict) and "name" in model:
        return str(model["name"])
    chosen = [text.partition("=")[2] for text in run.overrides if text.startswith("model=")]
    return chosen[-1] if chosen else "run" if run.report is None else run.report.name


def _without_automatic_values(folder: Path, config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's config with None for the options of :data:`AUTOMATIC` that were not set."""
    composed, result = _mapping(folder / _HYDRA / "config.yaml"), dict(config)
    for node, name in AUTOMATIC:
        is_automatic = (composed.get(node) or {}).get(name, name) is None
        if is_automatic and isinstance(result.get(node), dict):
            result[node] = {**result[node], name: None}
    return result


def _recipe(configs: Sequence[Mapping[str, Any]]) -> str:
    """Return configs as one string, without seed, objects and options without effect on results."""
    kept = [_without(config, "seed", *_ELSEWHERE, *_BESIDE) for config in configs]
    for config in kept:
        if isinstance(config.get("data"), dict):
            config["data"] = _without(config["data"], "parts", "objects")
    return json.dumps(kept, sort_keys=True, default=str) if kept else ""


def _without(config: Mapping[str, Any], *keys: str) -> dict[str, Any]:
    return {key: value for key, value in config.items() if key not in keys}


def _read_result(run: Run) -> None:
    """Set the result and cost of a run (only the cost for ``job=cost``), or the failure."""
    name, record = read_end(run.folder)
    if not name:
        run.failure = f"unfinished: no {METRICS_FILE}"
        if (run.folder / LAST_CHECKPOINT).is_file():
            run.failure += f"; continue with resume={run.folder}"
        return
    try:
        if name == METRICS_FILE:
            run.report = Report.from_record(record)
            run.cost = run.report.cost
        elif name == COST_FILE:
            run.cost = Cost(*(record[key] for key in Cost.__annotations__))
        else:
            run.failure = str(record.get("reason", "failed for an unknown reason"))
            run.pruned = name == PRUNED_FILE
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        run.failure = f"{name} is of another version: {error!r}"


def overrides_of(folder: Path) -> list[str]:
    """Return a run's stored overrides, but not those of locations, devices or Hydra itself."""
    listed = _yaml(folder / _HYDRA / "overrides.yaml")
    texts = [str(text).lstrip("+") for text in listed] if isinstance(listed, list) else []
    ignored = tuple(f"{name}=" for name in _ELSEWHERE)
    return [text for text in texts if not text.startswith(("hydra.", *ignored))]


def _mapping(path: Path) -> dict[str, Any]:
    """Read a YAML mapping; return an empty mapping if the file has none."""
    content = _yaml(path)
    return content if isinstance(content, dict) else {}


def _yaml(path: Path) -> Any:
    """Read a YAML file; return None if it is missing or truncated."""
    try:
        return read_yaml(path) if path.is_file() else None
    except UserError:
        return None


def baseline_first(entries: Sequence[Entry], baseline: str = BASELINE) -> list[Entry]:
    """Sort the baseline, given by its name or the first word of the name, to the front."""
    return sorted(entries, key=lambda e: baseline not in (e.name, e.name.split(" ")[0]))


def group(runs: Sequence[Run]) -> list[Entry]:
    """Group runs that differ only in the seed into one entry, ordered by their first run.

    Networks of other parts with the same recipe and seeds join the entry (one network per part, as
    in the paper). A run without a result forms its own entry.
    """
    entries: list[Entry] = []
    for run in runs:
        key = run.method_key
        same = [entry for entry in entries if key and key == entry.runs[0].method_key]
        entry = next((entry for entry in same if run.seed not in entry.seeds), None)
        if entry is None:
            entry = Entry("", failure=run.failure, pruned=run.pruned)
            entries.append(entry)
        entry.runs.append(run)
        if run.report is not None:
            entry.reports.append(run.report)
            entry.seeds.append(run.seed)
    methods: list[list[Entry]] = []
    for entry in entries:
        method = next((each for each in methods if _is_of_another_part(entry, each)), [])
        if not method:
            methods.append(method)
        method.append(entry)
    entries = [method[0] if len(method) == 1 else _join(method) for method in methods]
    _name(entries)
    return entries


def with_refined(entries: Sequence[Entry]) -> list[Entry]:
    """Insert after each method the same method with refinement, if every run measured it."""
    pairs: list[Entry] = []
    for entry in entries:
        pairs.append(entry)
        refined = [report.refined for report in entry.reports if report.refined is not None]
        if refined and len(refined) == len(entry.reports):
            refine = refined[0].name.removeprefix(f"{entry.reports[0].name} + ")
            name = f"{entry.name} + {refine}"
            pairs.append(replace(entry, name=name, reports=refined, refine=refine))
    return pairs


def _is_of_another_part(entry: Entry, method: Sequence[Entry]) -> bool:
    """Return whether an entry differs from the entries of a method only in its parts."""
    key, method_key = entry.runs[0].method_key, method[0].runs[0].method_key
    if key is None or method_key is None or key[:2] != method_key[:2]:
        return False
    names = {name for other in method for name in other.reports[0].errors}
    return set(entry.seeds) == set(method[0].seeds) and names.isdisjoint(entry.reports[0].errors)


def _join(method: Sequence[Entry]) -> Entry:
    """Join the entries of a method that were measured on different parts into one entry."""
    by_seed = [dict(zip(entry.seeds, entry.reports, strict=True)) for entry in method]
    return replace(
        method[0],
        reports=[Report.joined([reports[seed] for reports in by_seed]) for seed in method[0].seeds],
        runs=[run for entry in method for run in entry.runs],
    )


def _name(entries: Sequence[Entry]) -> None:
    """Name each entry after its model and the overrides in which the entries differ."""
    overrides = [
        [text for text in entry.runs[0].overrides if all(text in r.overrides for r in entry.runs)]
        for entry in entries
    ]
    for entry, common in zip(entries, overrides, strict=True):
        differing = [text for text in common if not all(text in other for other in overrides)]
        rest = [text for text in differing if not text.startswith("model=")]
        entry.name = " ".join([entry.runs[0].model, *rest])
        if len(entry.name) > _LONGEST_NAME:
            entry.name = f"{entry.runs[0].model} {entry.runs[0].short_path}"
    for suffix in ("short_path", "folder"):  # makes equal names unique
        counts = Counter(entry.name for entry in entries)
        for entry in entries:
            if counts[entry.name] > 1:
                entry.name = f"{entry.name} {getattr(entry.runs[0], suffix)}"
