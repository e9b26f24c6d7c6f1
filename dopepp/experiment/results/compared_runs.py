"""Run folders, and the methods of which they are seeds and parts.

Trainings, evaluations and whole multiruns are read; failed and unfinished runs, too.
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
from dopepp.experiment.results.cost import COST_FILE
from dopepp.experiment.results.folder import (
    BEST_CHECKPOINT,
    CONFIG_FILE,
    FAILURE_FILE,
    LAST_CHECKPOINT,
    METRICS_FILE,
    PRUNED_FILE,
    read_json,
)
from dopepp.experiment.results.frame import shown_rows
from dopepp.experiment.results.report import Cost, Report

BASELINE: Final = "dope"
"""A method of this name stands first, and every other one's Δ is against it."""

_HYDRA: Final = ".hydra"
_TRACES: Final = (_HYDRA, CONFIG_FILE, METRICS_FILE, FAILURE_FILE)
"""A run leaves at least one of these."""

_ELSEWHERE: Final = ("output_dir", "resume", "ckpt_path", "baseline", "device", "num_pictures")
"""Options that say where something is, not what is measured."""

_BESIDE: Final = ("shading", "scale_factors", "by", "num_bins", "bop_csv", "all_measures")
"""Options that measure more beside the result, and leave it as it is."""

_CHOSEN_SIZES: Final = (("data", "input_size"), ("virtual", "camera_scale"))
"""Where null in a config is replaced by what suits the objects' sizes."""

_LONGEST_NAME: Final = 60
"""Characters of a name that tables and legends have room for."""


@dataclass
class Run:
    """A run folder.

    Attributes:
        overrides: Overrides that do not only name places.
        report: Result; None where there is none.
        failure: Why there is none, in one line; empty where none was asked for (``job=cost``).
        config: Resolved config; empty where there is none.
        recipe: Everything but seed and objects that decides about the result, as one text; empty
            where unknown.
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

    @property
    def alike(self) -> tuple[str, str, str] | None:
        """What the seeds of a method share: recipe, name and test set; None where unknown."""
        if self.report is None or self.seed is None or not self.recipe:
            return None
        return self.recipe, self.report.name, self.report.test_set

    @property
    def place(self) -> str:
        """The folder's name; of a job, whose name is a number, with its multirun's."""
        folder = self.folder.resolve()
        return f"{folder.parent.name}/{folder.name}" if folder.name.isdigit() else folder.name


@dataclass
class Entry:
    """A method in a comparison.

    Attributes:
        reports: Results on one test set, one per seed.
        seeds: Seeds of the trainings, as many; None where unknown.
        failure: Why there is no result, in one line; empty where only the cost was asked for.
        pruned: Whether the reason is that a search stopped it, which is no failure.
        runs: Run folders; empty where reports do not come from any.
        refine: How its poses were refined; empty of the network's own.
    """

    name: str
    reports: list[Report] = field(default_factory=list)
    seeds: list[int | None] = field(default_factory=list)
    failure: str = ""
    pruned: bool = False
    runs: list[Run] = field(default_factory=list)
    refine: str = ""

    @property
    def test_set(self) -> str:
        """Fingerprint of the images; empty where it is not known."""
        return self.reports[0].test_set if self.reports else ""

    @property
    def objects(self) -> list[str]:
        """Names of the rows: every object, and the mean where there are several."""
        return list(shown_rows(self.reports[0].rows)) if self.reports else []

    @property
    def cost(self) -> Cost:
        """What the method costs; the time is the mean over seeds."""
        costs = [report.cost for report in self.reports]
        costs = costs or [run.cost or Cost() for run in self.runs[:1]]
        times = [cost.ms_per_frame for cost in costs if cost.ms_per_frame is not None]
        return replace(costs[0], ms_per_frame=float(np.mean(times)) if times else None)


def find_runs(paths: Sequence[Path]) -> list[Run]:
    """Read each folder of runs, evaluations and multiruns once.

    Raises:
        UserError: A path holds no run.
    """
    folders = {folder.resolve(): folder for path in paths for folder in _folders(path)}
    return [read_run(folder) for folder in folders.values()]


def _folders(path: Path) -> list[Path]:
    if any((path / trace).exists() for trace in _TRACES):
        return [path]
    jobs = [job for job in path.iterdir() if job.name.isdigit()] if path.is_dir() else []
    if not jobs:
        raise UserError(
            f"{path}, which holds no run",
            "the folder of a training, an evaluation or a multirun",
            "pass a folder with metrics.json or config.yaml in it",
        )
    return sorted(jobs, key=lambda job: int(job.name))


def read_run(folder: Path) -> Run:
    """Read one run folder; whatever is missing or damaged in it becomes its failure."""
    config = _mapping(folder / CONFIG_FILE)
    run = Run(folder, "", overrides_of(folder), None, "", None, config, folder / BEST_CHECKPOINT)
    try:
        run.report, run.cost = _result(folder)
    except UserError as error:
        run.failure = str(error)
    except _NoResultError as end:
        run.failure, run.pruned = str(end), end.pruned
    if run.report is not None and "checkpoint" in run.report.details:
        run.checkpoint = folder / str(run.report.details["checkpoint"])
    training, configs = config, [_as_asked(folder, config)] if config else []
    if "ckpt_path" in config:  # an evaluation: what it measured says what was trained, and how
        run.checkpoint = Path(str(config["ckpt_path"]))
        trained = run.checkpoint.parent.parent
        training = _mapping(trained / CONFIG_FILE)
        run.overrides = [*overrides_of(trained), *run.overrides]
        configs = [config, _as_asked(trained, training)] if training else []
    seed = training.get("seed")
    run.seed = seed if isinstance(seed, int) else None
    run.recipe = _recipe(configs)
    run.model = _model(training or _mapping(folder / _HYDRA / "config.yaml"), run)
    return run


def _model(config: Mapping[str, Any], run: Run) -> str:
    """Return the model's name, of a run that ended early as far as it is known."""
    model = config.get("model")
    if isinstance(model, dict) and "name" in model:
        return str(model["name"])
    chosen = [text.partition("=")[2] for text in run.overrides if text.startswith("model=")]
    return chosen[-1] if chosen else "run" if run.report is None else run.report.name


def _as_asked(folder: Path, config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's config without the sizes that were chosen for its objects, not asked for."""
    asked, kept = _mapping(folder / _HYDRA / "config.yaml"), dict(config)
    for node, name in _CHOSEN_SIZES:
        if (asked.get(node) or {}).get(name, name) is None and isinstance(kept.get(node), dict):
            kept[node] = {**kept[node], name: None}
    return kept


def _recipe(configs: Sequence[Mapping[str, Any]]) -> str:
    """Return configs as one text, without seed, objects and what does not touch the result."""
    kept = [_without(config, "seed", *_ELSEWHERE, *_BESIDE) for config in configs]
    for config in kept:
        if isinstance(config.get("data"), dict):
            config["data"] = _without(config["data"], "parts", "objects")
    return json.dumps(kept, sort_keys=True, default=str) if kept else ""


def _without(config: Mapping[str, Any], *keys: str) -> dict[str, Any]:
    return {key: value for key, value in config.items() if key not in keys}


class _NoResultError(Exception):
    """Why a run has no result, in one line; ``pruned`` where a search stopped it."""

    def __init__(self, reason: str, pruned: bool = False) -> None:
        super().__init__(reason)
        self.pruned = pruned


def _result(folder: Path) -> tuple[Report | None, Cost]:
    """Return a run's result and cost; a job that measured its network's cost has no result."""
    for name in (FAILURE_FILE, PRUNED_FILE):
        if (folder / name).is_file():
            reason = read_json(folder / name).get("reason", "without a reason")
            raise _NoResultError(reason, name == PRUNED_FILE)
    for name in (METRICS_FILE, COST_FILE):
        if (folder / name).is_file():
            stored = read_json(folder / name)
            try:
                if name == COST_FILE:
                    return None, Cost(*(stored[key] for key in Cost.__annotations__))
                report = Report.from_record(stored)
                return report, report.cost
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                raise _NoResultError(f"{name} is not of this version: {error!r}") from error
    unfinished = f"unfinished: it left no {METRICS_FILE}"
    if (folder / LAST_CHECKPOINT).is_file():
        unfinished += f"; go on with resume={folder}"
    raise _NoResultError(unfinished)


def overrides_of(folder: Path) -> list[str]:
    """Return what a run was overridden with, without Hydra's own and what only names places."""
    listed = _yaml(folder / _HYDRA / "overrides.yaml")
    texts = [str(text).lstrip("+") for text in listed] if isinstance(listed, list) else []
    places = tuple(f"{name}=" for name in _ELSEWHERE)
    return [text for text in texts if not text.startswith(("hydra.", *places))]


def _mapping(path: Path) -> dict[str, Any]:
    """Read a YAML mapping; empty where there is none."""
    content = _yaml(path)
    return content if isinstance(content, dict) else {}


def _yaml(path: Path) -> Any:
    """Read YAML; None where there is no file, or one cut short where the disk was full."""
    try:
        return read_yaml(path) if path.is_file() else None
    except UserError:
        return None


def ordered(entries: Sequence[Entry], baseline: str = BASELINE) -> list[Entry]:
    """Put the baseline, by its name or the first word of it, before all others."""
    return sorted(entries, key=lambda e: baseline not in (e.name, e.name.split(" ")[0]))


def group(runs: Sequence[Run]) -> list[Entry]:
    """Put runs that differ in nothing but the seed into one entry, in order of the first one.

    They must have been measured on the same test set. Networks of other parts, trained alike with
    the same seeds, join the entry: one network a part, as the paper has it. A run without a result
    stands alone.
    """
    entries: list[Entry] = []
    for run in runs:
        alike = [each for each in entries if run.alike and run.alike == each.runs[0].alike]
        entry = next((each for each in alike if run.seed not in each.seeds), None)
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
    """Return the methods, and behind each whose every run was measured refined, too, that."""
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
    """Tell whether an entry differs from those of a method in nothing but its parts."""
    mine, theirs = entry.runs[0].alike, method[0].runs[0].alike
    if mine is None or theirs is None or mine[:2] != theirs[:2]:
        return False
    names = {name for entry_of_method in method for name in entry_of_method.reports[0].errors}
    return set(entry.seeds) == set(method[0].seeds) and names.isdisjoint(entry.reports[0].errors)


def _join(method: Sequence[Entry]) -> Entry:
    by_seed = [dict(zip(entry.seeds, entry.reports, strict=True)) for entry in method]
    return replace(
        method[0],
        reports=[Report.joined([reports[seed] for reports in by_seed]) for seed in method[0].seeds],
        runs=[run for entry in method for run in entry.runs],
    )


def _name(entries: Sequence[Entry]) -> None:
    """Name each entry after its model and the overrides in which the entries differ.

    Where these are too many, and where two entries would have one name, the folder's name serves;
    where even that is the same, its path.
    """
    overrides = [
        [text for text in entry.runs[0].overrides if all(text in r.overrides for r in entry.runs)]
        for entry in entries
    ]
    for entry, mine in zip(entries, overrides, strict=True):
        differing = [text for text in mine if not all(text in other for other in overrides)]
        rest = [text for text in differing if not text.startswith("model=")]
        entry.name = " ".join([entry.runs[0].model, *rest])
        if len(entry.name) > _LONGEST_NAME:
            entry.name = f"{entry.runs[0].model} {entry.runs[0].place}"
    for more in ("place", "folder"):
        counts = Counter(entry.name for entry in entries)
        for entry in entries:
            if counts[entry.name] > 1:
                entry.name = f"{entry.name} {getattr(entry.runs[0], more)}"
