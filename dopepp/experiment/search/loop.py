"""Searching: trials are asked from a study, run by Hydra's launcher, and told to it.

A trial's number is its job's. Whatever ends a command in the middle, its trials stay ``RUNNING`` in
the study: the next command runs those first, each under its number and in its folder, where a
training goes on from its last checkpoint.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import optuna
from hydra.core.config_loader import ConfigLoader
from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from omegaconf import DictConfig, OmegaConf
from optuna.trial import FrozenTrial, TrialState

from dopepp.core.checks import check_integer
from dopepp.core.errors import UserError
from dopepp.experiment.runs import display
from dopepp.experiment.search.study import (
    Space,
    alone,
    chosen,
    examples,
    facts_of,
    open_study,
    outcome,
    overrides,
    read_space,
)
from dopepp.training.callbacks.trial import MOST

_MAX_PARALLEL = 10_000


def search(
    config: DictConfig,
    loader: ConfigLoader,
    launcher: Launcher,
    arguments: Sequence[str],
    swept: Sequence[str],
) -> list[JobReturn]:
    """Run trials until the study has as many finished ones as ``search.num_trials``.

    ``swept`` are the options that the experiment sweeps over by itself; there must be none. A
    :class:`UserError`: an option of the search is wrong, or the study does not belong to this
    command.
    """
    if swept:
        raise UserError(
            f"search=optuna with an experiment that sweeps over {', '.join(swept)} itself",
            "an experiment of one training, such as experiment=quickstart",
            "leave one of the two out",
        )
    options = _plain(config.search, resolve=True)
    wanted = check_integer("search.num_trials", options["num_trials"], 1, MOST)
    at_a_time = check_integer("search.num_parallel", options["num_parallel"], 1, _MAX_PARALLEL)
    space = read_space(loader, options["space"], arguments)
    for example in examples(space):
        loader.load_sweep_config(config, example)
    folder = Path(str(config.hydra.sweep.dir))
    facts = facts_of(_plain(config, resolve=False), space.texts)
    with alone(folder, str(options["study"])):
        study = open_study(options, facts, int(config.seed))
        trials = _Trials(study, space, launcher, folder)
        OmegaConf.save(config, folder / "multirun.yaml")
        returns = trials.run(wanted, at_a_time)
        _report(study, options)
    return returns


def _plain(node: DictConfig, resolve: bool) -> dict[str, Any]:
    plain = OmegaConf.to_container(node, resolve=resolve)
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items()}


class _Trials:
    """The trials of a study, each a job in a folder of its number."""

    def __init__(self, study: optuna.Study, space: Space, launcher: Launcher, folder: Path) -> None:
        self._study, self._space, self._launcher, self._folder = study, space, launcher, folder
        known = {trial.number for trial in study.get_trials(deepcopy=False)}
        names = [path.name for path in folder.iterdir() if path.name.isdigit()]
        foreign = [name for name in names if int(name) not in known]
        if foreign:  # a trial must not go on in the folder of another study's
            raise UserError(
                f"{folder} with the jobs {', '.join(sorted(foreign))} of another study",
                f"a folder of the study {study.study_name} alone",
                "choose another search.study=NAME, or move the folder away",
            )

    def run(self, wanted: int, at_a_time: int) -> list[JobReturn]:
        """Finish what an earlier command has left, then run new ones until so many are finished."""
        returns: list[JobReturn] = []
        self._tell(self._running())
        left = self._running()
        if left:
            numbers = ", ".join(str(trial.number) for trial in left)
            display.console.print(f"study {self._study.study_name} goes on with trials {numbers}")
        for trials in _consecutive(left, at_a_time):
            returns += self._launch(trials)
        while (missing := wanted - self._num_finished()) > 0:
            asked = range(min(missing, at_a_time))
            numbers_asked = {self._study.ask(self._space.varied).number for _ in asked}
            returns += self._launch([one for one in self._running() if one.number in numbers_asked])
        return returns

    def _launch(self, trials: Sequence[FrozenTrial]) -> Sequence[JobReturn]:
        """Run trials of consecutive numbers and tell the study how they ended."""
        jobs = [overrides(self._space, trial.params) for trial in trials]
        returns = self._launcher.launch(jobs, initial_job_idx=trials[0].number)
        self._tell(trials)
        numbers = {trial.number for trial in trials}
        for trial in self._running():
            if trial.number in numbers:  # its process died without a word
                self._study.tell(trial.number, state=TrialState.FAIL)
        return returns

    def _tell(self, trials: Sequence[FrozenTrial]) -> None:
        """Tell the study about those trials whose jobs have ended."""
        for trial in trials:
            state, value = outcome(self._folder / str(trial.number))
            if state != TrialState.RUNNING:
                self._study.tell(trial.number, value, state=state)

    def _running(self) -> list[FrozenTrial]:
        return self._study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))

    def _num_finished(self) -> int:
        trials = self._study.get_trials(deepcopy=False)
        return sum(trial.state.is_finished() for trial in trials)


def _consecutive(trials: Sequence[FrozenTrial], at_most: int) -> Iterator[Sequence[FrozenTrial]]:
    """Yield runs of consecutive numbers: a launcher counts up from the first one's."""
    for _, run in groupby(enumerate(trials), lambda pair: pair[1].number - pair[0]):
        left = [trial for _, trial in run]
        for first in range(0, len(left), at_most):
            yield left[first : first + at_most]


def _report(study: optuna.Study, options: Mapping[str, Any]) -> None:
    """Print how the trials ended, and the best one as overrides."""
    states = Counter(trial.state.name.lower() for trial in study.get_trials(deepcopy=False))
    counts = ", ".join(f"{count} {state}" for state, count in sorted(states.items()))
    display.console.print(f"study {study.study_name}: {counts}; {options['storage']}")
    if states[TrialState.COMPLETE.name.lower()]:
        best = study.best_trial
        options_of = " ".join(chosen(best.params))
        display.console.print(f"best trial {best.number}, objective {best.value:.4f}: {options_of}")
