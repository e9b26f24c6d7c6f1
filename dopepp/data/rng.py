"""Random numbers of the data pipeline: every draw has its own generator.

A generator depends on (seed, purpose, epoch, index) only, so workers, ranks and resuming a run
never change an item, and two purposes never share a stream.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.random import Generator


class Purpose(IntEnum):
    """What a generator is for; the numbers are part of the data and must not change."""

    SHUFFLE = 101
    MIX = 102
    CYCLE = 103
    AUGMENT = 104
    BACKGROUND = 105
    SHADING = 106


def item_rng(seed: int, purpose: Purpose, epoch: int, index: int = 0) -> Generator:
    """Return the generator of one item (all arguments non-negative)."""
    # Last, because a generator ignores trailing zeros: [seed, epoch, index], from which the
    # factory draws its scenes, is [seed, epoch, index, 0].
    return np.random.default_rng([seed, epoch, index, int(purpose)])
