"""Which images were measured, as one word: results on other images cannot be set off against."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.data.sample import Sample
from dopepp.metrics.pose import MIN_VISIBLE_FRACTION
from dopepp.parts.part import Part

_DECIMALS: Final = 6
"""Of pixels and metres: machines differ in the last digits of what they compute."""


class Fingerprint:
    """A hash over a test set: its objects, and every image's name, camera and truth, in order.

    The pixels are not in it, because they may differ in a bit from machine to machine; the name of
    the source tells renderers apart, and the covered share shaded images.

    Args:
        parts: The objects that are scored.
    """

    def __init__(self, parts: Sequence[Part]) -> None:
        self._hash = hashlib.sha256()
        self._add(sorted((part.name, part.mesh_hash) for part in parts))

    def add(self, sample: Sample) -> None:
        """Take the next image."""
        truths = [
            [
                one.label,
                _rounded(one.T_cam_obj),
                bool(one.visible_fraction >= MIN_VISIBLE_FRACTION),
                round(one.masked_fraction, 2),
            ]
            for one in sample.instances
        ]
        self._add([sample.source, sample.key, sample.size, _rounded(sample.K), truths])

    def word(self) -> str:
        """Return the hash of what was taken so far."""
        return self._hash.hexdigest()

    def _add(self, facts: object) -> None:
        self._hash.update(json.dumps(facts).encode() + b"\n")


def _rounded(values: Float[np.ndarray, "rows columns"]) -> list[float]:
    """Return rounded numbers, of which none is a negative zero."""
    return [float(value) + 0.0 for value in np.round(values, _DECIMALS).ravel()]
