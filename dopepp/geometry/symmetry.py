"""Symmetry groups: the rigid transforms that map a part onto itself."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from dopepp.geometry.camera import make_transform
from dopepp.geometry.rotation import rotation_vector_to_matrix

MAX_STEP = 0.01
"""How far a point may move between two steps of a continuous symmetry, in diameters (BOP)."""

ContinuousSymmetry = tuple[tuple[float, ...], tuple[float, ...]]
"""Axis and a point on it (metres): the part may be turned about it by any angle."""


def symmetry_group(
    discrete: Float[np.ndarray, "symmetries 4 4"] | None = None,
    continuous: Sequence[ContinuousSymmetry] = (),
    max_step: float = MAX_STEP,
) -> Float[np.ndarray, "group 4 4"]:
    """Return all symmetry transforms, the identity first, continuous ones in steps.

    As in BOP, a continuous symmetry is cut into ⌈π / max_step⌉ steps, so that a point at half a
    diameter from the axis moves by at most ``max_step`` diameters, and every step is combined with
    every discrete symmetry.

    Args:
        discrete: BOP-style rigid transforms without the identity, metres; None for none.
        continuous: BOP-style (axis, offset) pairs, metres.
        max_step: Largest step in diameters.

    Raises:
        ValueError: ``max_step`` is not positive or an axis has no length.
    """
    if not max_step > 0:
        raise ValueError(f"max_step must be positive, got {max_step}")
    group = np.eye(4)[None]
    if discrete is not None and len(discrete):
        group = np.concatenate([group, np.asarray(discrete, np.float64)])
    for axis, offset in continuous:
        steps = _turns(np.array(axis, np.float64), np.array(offset, np.float64), max_step)
        group = (steps[None] @ group[:, None]).reshape(-1, 4, 4)
    return group


def _turns(
    axis: Float[np.ndarray, "3"], offset: Float[np.ndarray, "3"], max_step: float
) -> Float[np.ndarray, "steps 4 4"]:
    """Return the turns about an axis, the identity first."""
    length = float(np.linalg.norm(axis))
    if not 0 < length < math.inf:
        raise ValueError(f"an axis of symmetry must have a length, got {axis.tolist()}")
    count = math.ceil(math.pi / max_step)
    angles = np.arange(count) * (2 * math.pi / count)
    turns = rotation_vector_to_matrix(angles[:, None] * (axis / length))
    turns[0] = np.eye(3)
    return np.stack([make_transform(turn, offset - turn @ offset) for turn in turns])
