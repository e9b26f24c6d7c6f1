"""What a search varies: Hydra's sweeps, ``key=interval(0, 1)``, as Optuna's distributions.

To vary another option, write it into ``search.space`` or on the command line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

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

from dopepp.errors import UserError

_FORMS: Final = "interval(low, high), int(interval(…)), tag(log, interval(…)), range(…), choice(…)"
_LOG: Final = "log"


@dataclass(frozen=True)
class Space:
    """What is varied and what is not.

    Attributes:
        varied: Option to what it is drawn from.
        texts: The same as they were written, to be compared with those of an earlier command.
        fixed: Overrides that every trial has.
    """

    varied: dict[str, BaseDistribution]
    texts: dict[str, str]
    fixed: list[str]


def read_space(loader: ConfigLoader, space: Sequence[str], arguments: Sequence[str]) -> Space:
    """Read ``search.space`` and the command line, whose overrides win.

    Raises:
        UserError: An entry cannot be read or is no sweep, or nothing is varied.
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
    if isinstance(distribution, CategoricalDistribution):
        return list(distribution.choices)
    assert isinstance(distribution, (FloatDistribution, IntDistribution))
    return [distribution.low]  # another number composes as well


def overrides(space: Space, params: dict[str, object]) -> list[str]:
    """Return the overrides of a trial."""
    return [*space.fixed, *chosen(params)]


def chosen(params: dict[str, object]) -> list[str]:
    """Return what a trial varies as overrides: as it is run, shown, and run again by hand.

    Four digits of a drawn number are enough, and fit into a table.
    """
    texts = {
        key: f"{value:.4g}" if isinstance(value, float) else str(value)
        for key, value in params.items()
    }
    return [f"{key}={text}" for key, text in texts.items()]
