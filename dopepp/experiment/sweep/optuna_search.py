"""Search hyperparameters: run the trials of an Optuna study with Hydra's launcher.

A trial and its job have the same number. Trials that an interrupted command left ``RUNNING`` are
resumed first, each in its own folder from its last checkpoint. Only one command may use a study at
a time, and all trials of a study have the same fixed options.

To vary an option, add a Hydra sweep such as ``key=interval(0, 1)`` to ``search.space`` or to the
command line.
"""

from __future__ import annotations

import fcntl
import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import optuna
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep, Override, RangeSweep
from hydra.core.utils import JobReturn
from hydra.errors import HydraException
from hydra.plugins.launcher import Launcher
from omegaconf import DictConfig, OmegaConf
from optuna import distributions
from optuna.trial import FrozenTrial, TrialState

from dopepp.core.errors import UserError
from dopepp.core.validation import Range, parse
from dopepp.experiment.config.run_config import flatten, is_below
from dopepp.experiment.results import display
from dopepp.experiment.results.folder import OBJECTIVE, PRUNED_FILE, read_end
from dopepp.training.pruning import MOST, open_storage

_FACTS: Final = "configuration"
_NUM_SHOWN: Final = 3
_NO_PART: Final = (
    "hydra", "output_dir", "resume", "search.num_trials", "search.num_parallel", "search.storage",
    "search.space", "callbacks.trial.storage",
)  # fmt: skip
"""Options that may differ between commands of a study; the space is compared as text."""


@dataclass(frozen=True)
class Search:
    """Options of the node ``search`` that this process reads; the jobs read the others."""

    study: str | int  # name of the study
    storage: str  # SQLite file or database URL
    mode: Literal["max", "min"]
    num_trials: Annotated[int, Range(1, MOST)]
    num_parallel: Annotated[int, Range(1, 10_000)]
    space: tuple[str, ...]  # Hydra sweeps


@dataclass(frozen=True)
class Space:
    """Distribution and sweep text of each varied option, and the overrides of every trial."""

    varied: dict[str, distributions.BaseDistribution]
    texts: dict[str, str]
    fixed: list[str]


def search(
    config: DictConfig,
    loader: ConfigLoader,
    launcher: Launcher,
    arguments: Sequence[str],
    swept: Sequence[str],
) -> list[JobReturn]:
    """Run trials until ``search.num_trials`` trials of the study are complete, pruned or failed."""
    if swept:
        raise UserError(
            f"search=optuna with an experiment that already sweeps over {', '.join(swept)}",
            "an experiment without a sweep, such as experiment=quickstart",
            "leave out search=optuna, or choose another experiment",
        )
    options = parse(Search, OmegaConf.to_container(config.search, resolve=True), "search")
    space = read_space(loader, options.space, arguments)
    for example in examples(space):
        loader.load_sweep_config(config, example)
    folder = Path(str(config.hydra.sweep.dir))
    plain = OmegaConf.to_container(config, resolve=False)
    # All options that affect the result of a trial, and the search space.
    facts = {key: str(value) for key, value in flatten(plain) if not is_below(key, _NO_PART)}
    facts |= {f"search.space {key}": text for key, text in space.texts.items()}
    with exclusive_search(folder, options.study):
        study = open_study(options, facts, int(config.seed))
        trials = _Trials(study, space, launcher, folder)
        OmegaConf.save(config, folder / "multirun.yaml")
        returns = trials.run(options.num_trials, options.num_parallel)
        _report(study, options)
    return returns


class _Trials:
    """The trials of a study; each trial is a job in the folder of its number."""

    def __init__(self, study: optuna.Study, space: Space, launcher: Launcher, folder: Path) -> None:
        self._study, self._space, self._launcher, self._folder = study, space, launcher, folder
        numbers = {trial.number for trial in study.get_trials(deepcopy=False)}
        names = [path.name for path in folder.iterdir() if path.name.isdigit()]
        foreign = [name for name in names if int(name) not in numbers]
        if foreign:  # a trial must not resume the job of another study
            raise UserError(
                f"{folder} with the jobs {', '.join(sorted(foreign))} of another study",
                f"a folder that holds only jobs of the study {study.study_name}",
                "set another search.study=NAME, or move the folder away",
            )

    def run(self, num_trials: int, at_a_time: int) -> list[JobReturn]:
        """Run an earlier command's unfinished trials, then new trials up to ``num_trials``."""
        returns: list[JobReturn] = []
        self._tell(self._running())
        left = self._running()
        if left:
            names = ", ".join(str(trial.number) for trial in left)
            display.console.print(f"study {self._study.study_name} continues with trials {names}")
        for trials in _consecutive(left, at_a_time):
            returns += self._launch(trials)
        ended = (TrialState.COMPLETE, TrialState.PRUNED, TrialState.FAIL)
        while (missing := num_trials - len(self._study.get_trials(False, ended))) > 0:
            asked = range(min(missing, at_a_time))
            numbers = {self._study.ask(self._space.varied).number for _ in asked}
            returns += self._launch([trial for trial in self._running() if trial.number in numbers])
        return returns

    def _launch(self, trials: Sequence[FrozenTrial]) -> Sequence[JobReturn]:
        """Run trials of consecutive numbers; a trial without an outcome is reported as failed."""
        jobs = [overrides(self._space, trial.params) for trial in trials]
        returns = self._launcher.launch(jobs, initial_job_idx=trials[0].number)
        self._tell(trials)
        numbers = {trial.number for trial in trials}
        for trial in self._running():
            if trial.number in numbers:  # the process died without a result
                self._study.tell(trial.number, state=TrialState.FAIL)
        return returns

    def _tell(self, trials: Sequence[FrozenTrial]) -> None:
        """Report state and objective of those trials that have ended to the Optuna study."""
        for trial in trials:
            state, value = outcome(self._folder / str(trial.number))
            if state != TrialState.RUNNING:
                self._study.tell(trial.number, value, state=state)

    def _running(self) -> list[FrozenTrial]:
        return self._study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))


def _consecutive(trials: Sequence[FrozenTrial], at_most: int) -> Iterator[Sequence[FrozenTrial]]:
    """Yield groups of up to ``at_most`` trials with consecutive numbers, for the launcher."""
    for _, run in groupby(enumerate(trials), lambda pair: pair[1].number - pair[0]):
        left = [trial for _, trial in run]
        for first in range(0, len(left), at_most):
            yield left[first : first + at_most]


def _report(study: optuna.Study, options: Search) -> None:
    """Print the number of trials by state, and the overrides of the best complete trial."""
    states = Counter(trial.state.name.lower() for trial in study.get_trials(deepcopy=False))
    counts = ", ".join(f"{count} {state}" for state, count in sorted(states.items()))
    display.console.print(f"study {study.study_name}: {counts}; {options.storage}")
    if states[TrialState.COMPLETE.name.lower()]:
        best = study.best_trial
        best_options = " ".join(search_overrides(best.params))
        display.console.print(
            f"best trial {best.number}, objective {best.value:.4f}: {best_options}"
        )


def read_space(loader: ConfigLoader, space: Sequence[str], arguments: Sequence[str]) -> Space:
    """Read the search space; overrides of the command line take precedence."""
    parser = OverridesParser.create(config_loader=loader)
    try:
        entries = parser.parse_overrides([str(text) for text in space])
    except HydraException as error:
        raise _bad_entry(f"{list(space)}, unreadable: {error}") from error
    given = parser.parse_overrides(list(arguments))
    sweeps: dict[str, Override] = {}
    for entry in entries:
        if not entry.is_sweep_override():
            raise _bad_entry(f"{entry.input_line!r}, which is a single value")
        sweeps[entry.get_key_element()] = entry
    fixed = []
    for override in given:
        key = override.get_key_element()
        sweeps.pop(key, None)
        if override.is_sweep_override():
            sweeps[key] = override
        else:
            fixed.append(str(override.input_line))
    if not sweeps:
        raise _bad_entry("no option to vary")
    texts = {key: str(sweep.input_line).partition("=")[2] for key, sweep in sweeps.items()}
    return Space({key: _distribution(sweep) for key, sweep in sweeps.items()}, texts, fixed)


def _distribution(sweep: Override) -> distributions.BaseDistribution:
    """Convert a Hydra sweep over an option into an Optuna distribution."""
    value = sweep.value()
    try:
        if isinstance(value, IntervalSweep):
            low: Any = value.start  # integers if the interval was cast to int
            high: Any = value.end
            kind = (
                distributions.IntDistribution
                if isinstance(low, int)
                else distributions.FloatDistribution
            )
            return kind(low, high, log="log" in value.tags)
        if isinstance(value, RangeSweep):
            start, stop, step = value.start or 0, value.stop or 0, value.step
            if isinstance(start, int) and isinstance(stop, int) and isinstance(step, int):
                numbers = range(start, stop, step)
                return distributions.IntDistribution(min(numbers), max(numbers), step=abs(step))
        if sweep.is_discrete_sweep():
            return distributions.CategoricalDistribution(list(sweep.sweep_string_iterator()))
    except ValueError as error:
        raise _bad_entry(f"{sweep.input_line!r}: {error}") from error
    raise _bad_entry(f"{sweep.input_line!r}")


def _bad_entry(problem: str) -> UserError:
    return UserError(
        f"search.space with {problem}",
        "interval(low, high), int(interval(…)), tag(log, interval(…)), range(…), choice(…)",
        "write the option in one of these forms, e.g. 'optimizer.lr=interval(1e-4, 1e-2)'",
    )


def examples(space: Space) -> list[list[str]]:
    """Return lists of overrides that together cover every choice, to check that they compose."""
    first = {key: _ends(choices)[0] for key, choices in space.varied.items()}
    tried = [first]
    for key, distribution in space.varied.items():
        tried += [{**first, key: end} for end in _ends(distribution)[1:]]
    return [overrides(space, params) for params in tried]


def _ends(distribution: Any) -> list[object]:
    """Return all choices of a distribution, or the lower end of a range."""
    return list(getattr(distribution, "choices", ())) or [distribution.low]


def overrides(space: Space, params: dict[str, object]) -> list[str]:
    """Return all overrides of a trial whose varied options have the values ``params``."""
    return [*space.fixed, *search_overrides(params)]


def search_overrides(params: dict[str, object]) -> list[str]:
    """Return ``key=value`` for each varied option, with four significant digits for a float."""
    return [
        f"{key}={value:.4g}" if isinstance(value, float) else f"{key}={value}"
        for key, value in params.items()
    ]


@contextmanager
def exclusive_search(folder: Path, study: str | int) -> Iterator[None]:
    """Lock a folder against a second search, until the context or the process ends."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".search.lock").open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise UserError(
                f"search.study={study}, which another command is searching in {folder}",
                "one command at a time",
                "wait for the other command, set another search.study=NAME, or start a single "
                "command with a larger search.num_parallel",
            ) from error
        yield


def open_study(options: Search, facts: Mapping[str, str], seed: int) -> optuna.Study:
    """Open or create the Optuna study of a search.

    ``facts`` are the fixed options that affect the result of a trial, and the search space. The
    number of stored trials is added to the sampler's ``seed``.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    name = str(options.study)
    study = optuna.create_study(
        storage=open_storage(options.storage),
        study_name=name,
        direction="maximize" if options.mode == "max" else "minimize",
        load_if_exists=True,
    )
    begun_with = study.user_attrs.get(_FACTS)
    if begun_with is None:
        study.set_user_attr(_FACTS, json.dumps(dict(facts)))
    else:
        _check_same(json.loads(begun_with), facts, name)
    study.sampler = optuna.samplers.TPESampler(seed=seed + len(study.get_trials(deepcopy=False)))
    return study


def _check_same(stored: Mapping[str, str], now: Mapping[str, str], study: str) -> None:
    """Check that this command has the fixed options of the study's first command (``stored``)."""
    keys = sorted(key for key in {*stored, *now} if stored.get(key) != now.get(key))
    if not keys:
        return
    present, original = (
        ", ".join(f"{key}={facts.get(key, 'absent')}" for key in keys[:_NUM_SHOWN])
        for facts in (now, stored)
    )
    remainder = f" and {len(keys) - _NUM_SHOWN} more" if len(keys) > _NUM_SHOWN else ""
    raise UserError(
        f"{present}{remainder}, but {original} at the start of the study {study}",
        "the options of the study's first command",
        "repeat that command, or start another study with search.study=NAME",
    )


def outcome(folder: Path) -> tuple[TrialState, float | None]:
    """Return state and objective of a trial from its files; a non-finite objective is a failure."""
    name, record = read_end(folder)
    value = record.get(OBJECTIVE)  # of a complete trial
    if isinstance(value, (int, float)) and math.isfinite(value):
        return TrialState.COMPLETE, float(value)
    return {"": TrialState.RUNNING, PRUNED_FILE: TrialState.PRUNED}.get(name, TrialState.FAIL), None
