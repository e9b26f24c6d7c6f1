"""What an evaluation measures beside the test set as it is: shading, and rates per bin.

To add a protocol, give :class:`Protocols` its option, write a module that measures and records it,
and call that in :func:`dopepp.experiment.evaluation.measure_and_record`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from dopepp.errors import UserError
from dopepp.experiment.quantities import QUANTITIES
from dopepp.models.gate import check_integer

_MAX_BINS: Final = 1000


@dataclass(frozen=True)
class Protocols:
    """The protocols asked for.

    Attributes:
        shading: Shares of every object's visible area to cover, ascending, without 0.
        by: Quantities over which rates are broken down.
        num_bins: Bins of each.
    """

    shading: tuple[float, ...] = ()
    by: tuple[str, ...] = ()
    num_bins: int = 5

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> Protocols:
        """Read the evaluation's options.

        Raises:
            UserError: One of them is wrong.
        """
        return cls(
            shading=_shares(config["shading"]),
            by=_quantities(config["by"]),
            num_bins=check_integer("num_bins", config["num_bins"], 1, _MAX_BINS),
        )

    def __bool__(self) -> bool:
        """Tell whether there is any."""
        return bool(self.shading or self.by)


def _shares(given: object) -> tuple[float, ...]:
    """Read ``shading``: one share or several; 0, the image as it is, is measured anyway."""
    shares = [] if given is None else given if isinstance(given, list) else [given]
    numbers = [s for s in shares if isinstance(s, int | float) and not isinstance(s, bool)]
    wrong = len(numbers) < len(shares) or not all(0 <= s <= 1 for s in numbers)
    if wrong or (given is not None and not any(numbers)):
        raise UserError(
            f"shading={given!r:.100}",
            "shares of the visible area from 0 to 1, not 0 alone, e.g. [0.2,0.4,0.6,0.8]",
            "change shading",
        )
    return tuple(sorted({float(share) for share in numbers if share > 0}))


def _quantities(given: object) -> tuple[str, ...]:
    """Read ``by``: one quantity or several."""
    names = [] if given is None else given if isinstance(given, list) else [given]
    wrong = [name for name in names if not isinstance(name, str) or name not in QUANTITIES]
    if wrong or (given is not None and not names):
        raise UserError(
            f"by={given!r:.100}", f"one or more of {', '.join(QUANTITIES)}", "change by"
        )
    return tuple(dict.fromkeys(str(name) for name in names))
