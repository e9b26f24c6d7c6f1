"""The study behind a search: opened once, by one command at a time, and never mixed."""

from __future__ import annotations

import fcntl
import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import optuna
from optuna.study import StudyDirection
from optuna.trial import TrialState

from dopepp.errors import UserError
from dopepp.experiment import record
from dopepp.experiment.options import below, flat
from dopepp.training.trial import open_storage

_LOCK_FILE: Final = ".search.lock"
_FACTS: Final = "configuration"
_NUM_SHOWN: Final = 3
_DIRECTIONS: Final = {"max": StudyDirection.MAXIMIZE, "min": StudyDirection.MINIMIZE}
_NO_PART: Final = ("hydra", "output_dir", "resume", "search.num_trials", "search.num_parallel",
                   "search.storage", "search.space", "callbacks.trial.storage")  # fmt: skip
"""What may differ between two commands of one study; of the space, its texts are compared."""


@contextmanager
def alone(folder: Path, study: str) -> Iterator[None]:
    """Keep a second command from searching in the same folder; ends with the process.

    Raises:
        UserError: There is another one.
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

    Args:
        options: The node ``search``.
        facts: What decides about a trial's result besides what is varied, by its name.
        seed: Of the draws; those of a command that goes on are not those of the first one again.

    Raises:
        UserError: The study was begun with other facts, or its storage cannot be opened.
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
