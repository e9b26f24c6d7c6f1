"""What a search varies, as Optuna's distributions, and the study behind it.

An option is varied by a sweep of Hydra's, ``key=interval(0, 1)``. A study is opened by one command
at a time, and trials of different configurations are never mixed in it.

To vary another option, write it into ``search.space`` or on the command line.
"""

from __future__ import annotations

import fcntl
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import optuna
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep, Override, RangeSweep
from hydra.errors import HydraException
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.study import StudyDirection
from optuna.trial import TrialState

from dopepp.core.errors import UserError
from dopepp.experiment.config.parse import FORMER_TARGETS, below, flat
from dopepp.experiment.runs import record
from dopepp.training.callbacks.trial import open_storage

_FORMS: Final = "interval(low, high), int(interval(…)), tag(log, interval(…)), range(…), choice(…)"
_LOG: Final = "log"
_LOCK_FILE: Final = ".search.lock"
_FACTS: Final = "configuration"
_NUM_SHOWN: Final = 3
_DIRECTIONS: Final = {"max": StudyDirection.MAXIMIZE, "min": StudyDirection.MINIMIZE}
_NO_PART: Final = (
    "hydra", "output_dir", "resume", "search.num_trials", "search.num_parallel", "search.storage",
    "search.space", "callbacks.trial.storage", "data.virtual",
)  # fmt: skip
"""What may differ between two commands of one study; of the space, its texts are compared, and
``data.virtual`` is where earlier versions say again what the node ``virtual`` says."""


@dataclass(frozen=True)
class Space:
    """What is varied, by option, and from what it is drawn; and what is not.

    ``texts`` are the same as they were written, to be compared with those of an earlier command;
    ``fixed`` are the overrides that every trial has.
    """

    varied: dict[str, BaseDistribution]
    texts: dict[str, str]
    fixed: list[str]


def read_space(loader: ConfigLoader, space: Sequence[str], arguments: Sequence[str]) -> Space:
    """Read ``search.space`` and the command line, whose overrides win.

    A :class:`UserError`: an entry cannot be read or is no sweep, or nothing is varied.
    """
    parser = OverridesParser.create(config_loader=loader)
    try:
        entries = parser.parse_overrides([str(text) for text in space])
    except HydraException as error:
        raise _bad_entry(f"{list(space)}, unreadable: {error}") from error
    given = parser.parse_overrides(list(arguments))
    sweeps: dict[str, Override] = {}
    for entry in entries:
        if not entry.is_sweep_override():
            raise _bad_entry(f"{entry.input_line!r}, which is one value")
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
        raise _bad_entry("nothing to vary")
    texts = {key: str(one.input_line).partition("=")[2] for key, one in sweeps.items()}
    return Space({key: _distribution(sweep) for key, sweep in sweeps.items()}, texts, fixed)


def _distribution(sweep: Override) -> BaseDistribution:
    """Return what Optuna draws an option from."""
    value = sweep.value()
    try:
        if isinstance(value, IntervalSweep):
            low: Any = value.start  # ints where the interval was cast to int
            high: Any = value.end
            kind = IntDistribution if isinstance(low, int) else FloatDistribution
            return kind(low, high, log=_LOG in value.tags)
        if isinstance(value, RangeSweep) and isinstance(value.step, int):
            numbers = range(int(value.start or 0), int(value.stop or 0), value.step)
            return IntDistribution(min(numbers), max(numbers), step=abs(value.step))
        if sweep.is_discrete_sweep():
            return CategoricalDistribution(list(sweep.sweep_string_iterator()))
    except ValueError as error:
        raise _bad_entry(f"{sweep.input_line!r}: {error}") from error
    raise _bad_entry(f"{sweep.input_line!r}")


def _bad_entry(got: str) -> UserError:
    return UserError(f"search.space with {got}", _FORMS, "correct search.space or the command line")


def examples(space: Space) -> list[list[str]]:
    """Return overrides that try every option once, to see whether they compose."""
    first = {key: _ends(one)[0] for key, one in space.varied.items()}
    tried = [first]
    for key, distribution in space.varied.items():
        tried += [{**first, key: end} for end in _ends(distribution)[1:]]
    return [overrides(space, params) for params in tried]


def _ends(distribution: BaseDistribution) -> list[object]:
    """Return every choice, or one number of a range: another one composes as well."""
    if isinstance(distribution, CategoricalDistribution):
        return list(distribution.choices)
    assert isinstance(distribution, (FloatDistribution, IntDistribution))
    return [distribution.low]


def overrides(space: Space, params: dict[str, object]) -> list[str]:
    """Return the overrides of a trial."""
    return [*space.fixed, *chosen(params)]


def chosen(params: dict[str, object]) -> list[str]:
    """Return what a trial varies as overrides: as it is run, shown, and run again by hand.

    Four digits of a drawn number are enough, and fit into a table.
    """
    return [
        f"{key}={value:.4g}" if isinstance(value, float) else f"{key}={value}"
        for key, value in params.items()
    ]


@contextmanager
def alone(folder: Path, study: str) -> Iterator[None]:
    """Keep a second command from searching in the same folder; ends with the process.

    If there is another one, it is a :class:`UserError`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / _LOCK_FILE).open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise UserError(
                f"search.study={study}, which another command is searching in {folder}",
                "one command at a time",
                "wait for it, raise its search.num_parallel, or choose another search.study",
            ) from error
        yield


def open_study(options: Mapping[str, Any], facts: Mapping[str, str], seed: int) -> optuna.Study:
    """Open a study, or begin it.

    ``facts`` is what decides about a trial's result besides what is varied, by its name. The seed
    is of the draws; those of a command that goes on are not those of the first one again. A
    :class:`UserError`: the study was begun with other facts, or its storage cannot be opened.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    name = str(options["study"])
    if options["mode"] not in _DIRECTIONS:
        raise UserError(f"search.mode={options['mode']}", "max or min", "choose one of them")
    study = optuna.create_study(
        storage=open_storage(str(options["storage"])),
        study_name=name,
        direction=_DIRECTIONS[str(options["mode"])],
        load_if_exists=True,
    )
    begun_with = study.user_attrs.get(_FACTS)
    if begun_with is None:
        study.set_user_attr(_FACTS, json.dumps(dict(facts)))
    else:
        _check_same(json.loads(begun_with), facts, name)
    study.sampler = optuna.samplers.TPESampler(seed=seed + len(study.get_trials(deepcopy=False)))
    return study


def _check_same(before: Mapping[str, str], now: Mapping[str, str], study: str) -> None:
    """Refuse to mix trials that cannot be compared."""
    named = {key: FORMER_TARGETS.get(value, value) for key, value in before.items()}
    before = {key: value for key, value in named.items() if not below(key, _NO_PART)}
    keys = sorted(key for key in {*before, *now} if before.get(key) != now.get(key))
    if not keys:
        return
    shown = [f"{key}={now.get(key, 'absent')}" for key in keys[:_NUM_SHOWN]]
    was = [f"{key}={before.get(key, 'absent')}" for key in keys[:_NUM_SHOWN]]
    more = f" and {len(keys) - _NUM_SHOWN} more" if len(keys) > _NUM_SHOWN else ""
    raise UserError(
        f"{', '.join(shown)}{more}, while the study {study} was begun with {', '.join(was)}",
        "the command that the study was begun with",
        "choose another search.study=NAME",
    )


def facts_of(config: Mapping[str, Any], texts: Mapping[str, str]) -> dict[str, str]:
    """Return a config, and what it is varied by, flat and without what names only places."""
    facts = {key: str(value) for key, value in flat(config) if not below(key, _NO_PART)}
    return {**facts, **{f"search.space {key}": text for key, text in texts.items()}}


def outcome(folder: Path) -> tuple[TrialState, float | None]:
    """Read from a job's folder how its trial ended; RUNNING where it has not.

    A job without a finite objective has failed as a trial.
    """
    if (folder / record.PRUNED_FILE).is_file():
        return TrialState.PRUNED, None
    if (folder / record.FAILURE_FILE).is_file():
        return TrialState.FAIL, None
    if not (folder / record.METRICS_FILE).is_file():
        return TrialState.RUNNING, None
    value = record.read_json(folder / record.METRICS_FILE).get(record.OBJECTIVE)
    if not isinstance(value, (int, float)) or not math.isfinite(value):
        return TrialState.FAIL, None
    return TrialState.COMPLETE, float(value)
