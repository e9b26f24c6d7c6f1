"""Options of an evaluation's protocols: shading, scale and rates per bin.

To add a protocol, give :class:`Protocols` its option, write a module that measures and records it,
and call it in :func:`dopepp.experiment.results.measurement.measure_and_record`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

from dopepp.core.errors import UserError
from dopepp.core.validation import Range, check

QuantityName = Literal["distance", "visibility", "size", "rotation"]
"""Quantities that rates can be broken down by (``dopepp.experiment.results``)."""

_MAX_SCALE: Final = 20.0
"""Twenty times as near or as far."""


@dataclass(frozen=True)
class Protocols:
    """The protocols asked for.

    Attributes:
        shading: Shares of every object's visible area to cover, ascending, without 0.
        scales: How many times as large the parts are to appear, ascending, without 1.
        by: Quantities over which rates are broken down.
        num_bins: Bins of each.
    """

    shading: tuple[float, ...] = ()
    scales: tuple[float, ...] = ()
    by: tuple[QuantityName, ...] = ()
    num_bins: int = 5

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> Protocols:
        """Read the options; a training has no scales.

        Raises:
            UserError: An option is wrong.
        """
        shares = "shares of the visible area from 0 to 1, not 0 alone, e.g. [0.2,0.4,0.6,0.8]"
        bounds = (1 / _MAX_SCALE, _MAX_SCALE)
        factors = "factors from {:g} to {:g}, not 1 alone, e.g. [0.5,1,2]".format(*bounds)
        return cls(
            shading=_levels("shading", config["shading"], (0, 1), 0, shares),
            scales=_levels("scale", config.get("scale_factors"), bounds, 1, factors),
            by=_quantities(config["by"]),
            num_bins=check("num_bins", config["num_bins"], int, Range(1, 1000)),
        )

    def __bool__(self) -> bool:
        """Tell whether there is any."""
        return bool(self.shading or self.scales or self.by)


def _levels(
    option: str, given: object, bounds: tuple[float, float], usual: float, allowed: str
) -> tuple[float, ...]:
    """Read one level or several; the usual one, the images as they are, is measured anyway."""
    levels = [] if given is None else given if isinstance(given, list) else [given]
    numbers = [
        level for level in levels if isinstance(level, int | float) and not isinstance(level, bool)
    ]
    wrong = len(numbers) < len(levels) or not all(
        bounds[0] <= level <= bounds[1] for level in numbers
    )
    if wrong or (given is not None and all(level == usual for level in numbers)):
        raise UserError(f"{option}={given!r:.100}", allowed, f"change {option}")
    return tuple(sorted({float(level) for level in numbers if level != usual}))


def _quantities(given: object) -> tuple[QuantityName, ...]:
    """Read ``by``: one quantity or several."""
    names = [] if given is None else given if isinstance(given, list) else [given]
    quantities: dict[object, QuantityName] = {name: name for name in get_args(QuantityName)}
    wrong = [name for name in names if not isinstance(name, str) or name not in quantities]
    if wrong or (given is not None and not names):
        allowed = f"one or more of {', '.join(get_args(QuantityName))}"
        raise UserError(f"by={given!r:.100}", allowed, "change by")
    return tuple(dict.fromkeys(quantities[name] for name in names))
