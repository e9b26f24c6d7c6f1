"""What turns a head's belief output into a belief map that peaks at 1, by the name in the spec."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from jaxtyping import Float
from torch import Tensor

from dopepp.errors import UserError


def _identity(logits: Tensor) -> Tensor:
    return logits


def _exp(logits: Tensor) -> Tensor:
    return logits.float().clamp(max=0.0).exp()


@dataclass(frozen=True)
class Activation:
    """A belief activation.

    Attributes:
        function: Maps logits to beliefs, elementwise.
        initial_logit: Bias that an untrained head starts from.
    """

    function: Callable[[Tensor], Tensor]
    initial_logit: float

    def __call__(
        self, logits: Float[Tensor, "batch channels height width"]
    ) -> Float[Tensor, "batch channels height width"]:
        """Turn belief logits into belief maps."""
        return self.function(logits)


ACTIVATIONS: Final[Mapping[str, Activation]] = {
    # The output is the belief itself, as in DOPE: what MSE is paired with.
    "identity": Activation(_identity, 0.0),
    # belief = exp(logit), at most 1 and in float32: the log link of `losses.SpatialCrossEntropy`.
    # An untrained map starts at 0.01 in every cell, so its sum is that of one Gaussian of 2 cells
    # on a 52×52 map (2π·2² / 52² = 0.0093) and the "how much" term starts near its minimum.
    "exp": Activation(_exp, math.log(0.01)),
}


def find_activation(name: object) -> Activation:
    """Return an activation by name.

    Raises:
        UserError: There is none of that name.
    """
    if not isinstance(name, str) or name not in ACTIVATIONS:
        raise UserError(
            f"activation {name!r:.100}", ", ".join(ACTIVATIONS), "use the one your loss publishes"
        )
    return ACTIVATIONS[name]
