"""Symmetry groups: the rigid transforms that map a part onto itself."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.geometry.camera import make_transform
from dopepp.geometry.rotation import Vector, rotation_angle, rotation_vector_to_matrix

MAX_FINITE: Final = 60
"""Rotations of the icosahedron: the largest finite group that is no n-fold axis with its flips."""

SAME_TURN: Final = math.radians(10.0)
"""Rotations closer than this are one: those of a 12-fold axis are 30° apart, measured ones err."""

_AVERAGINGS: Final = 5
"""The error is squared by each: 10° become less than 1e-15."""

BALL_STEP: Final = 0.2
"""Radians between neighbouring rotations of a ball, at least."""

_PARALLEL: Final = 0.01
"""Sine of the angle under which two axes are one, written down twice."""

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

    As in BOP, every step of a continuous symmetry is combined with every discrete symmetry. Two
    axes that are not parallel make a ball of the part, whose rotations are 0.2 rad apart.

    Args:
        discrete: BOP-style rigid transforms without the identity, metres.
        continuous: BOP-style (axis, offset) pairs, metres.
        max_step: Largest move of a point at half a diameter from the axis, diameters.

    Raises:
        ValueError: ``max_step`` is not positive or an axis has no length.
    """
    if not max_step > 0:
        raise ValueError(f"max_step must be positive, got {max_step}")
    group = np.eye(4)[None]
    if discrete is not None and len(discrete):
        group = np.concatenate([group, np.asarray(discrete, np.float64)])
    if not continuous:
        return group
    axes = np.array([_unit(axis) for axis, _ in continuous])
    offset = np.array(continuous[0][1], np.float64)
    if np.linalg.norm(np.cross(axes[0], axes), axis=1).max() > _PARALLEL:
        return _with_centre(_rotations(max(2 * max_step, BALL_STEP)), offset)
    count = math.ceil(math.pi / max_step)
    angles = np.arange(count) * (2 * math.pi / count)
    turns = _with_centre(rotation_vector_to_matrix(angles[:, None] * axes[0]), offset)
    return np.asarray((turns[None] @ group[:, None]).reshape(-1, 4, 4))


def _unit(axis: Sequence[float]) -> Vector:
    length = float(np.linalg.norm(axis))
    if not 0 < length < math.inf:
        raise ValueError(f"an axis of symmetry must have a length, got {list(axis)}")
    return np.array(axis, np.float64) / length


def _with_centre(
    rotations: Float[np.ndarray, "rotations 3 3"], centre: Vector
) -> Float[np.ndarray, "rotations 4 4"]:
    """Return rotations about a point as transforms, the first exactly the identity."""
    shifts = centre - rotations @ centre
    transforms = [make_transform(*pair) for pair in zip(rotations, shifts, strict=True)]
    transforms[0] = np.eye(4)
    return np.stack(transforms)


def _rotations(step: float) -> Float[np.ndarray, "rotations 3 3"]:
    """Return rotations about a step (radians) apart: z to a spiral of directions, and turns."""
    number = np.arange(math.ceil(4 * math.pi / step**2))
    z = 1 - 2 * number / number[-1]  # the first is z itself
    polar, around = np.arccos(z), np.pi * (3 - math.sqrt(5)) * number
    tilt = np.stack([-np.sin(around), np.cos(around), np.zeros_like(z)], axis=1)
    angles = np.arange(0, 2 * math.pi, 2 * math.pi / math.ceil(2 * math.pi / step))
    turns = rotation_vector_to_matrix(angles[:, None] * np.array([0.0, 0.0, 1.0]))
    tilts = rotation_vector_to_matrix(polar[:, None] * tilt)
    return np.asarray((tilts[:, None] @ turns[None]).reshape(-1, 3, 3))


def exact_group(
    rotations: Float[np.ndarray, "generators 3 3"],
) -> Float[np.ndarray, "group 3 3"] | None:
    """Return the finite group that measured rotations generate, the identity first, or None.

    Products are added until all are within 10° of an element; a group of more than 60 elements is
    None. Then each element g is replaced by the mean of ρ(gh)·ρ(h)⁻¹ over all h, which turns an
    approximate homomorphism ρ into an exact one (Grove, Karcher, Ruh 1974).
    """
    group = [np.eye(3)]
    generators = [np.asarray(rotation, np.float64) for rotation in rotations]
    for element in group:  # grows while it is gone through
        for generator in generators:
            product = generator @ element
            if rotation_angle(product @ np.swapaxes(group, 1, 2)).min() > SAME_TURN:
                group.append(product)
        if len(group) > MAX_FINITE:
            return None
    elements = np.array(group)
    products = elements[:, None] @ elements[None]
    away = rotation_angle(products[:, :, None] @ np.swapaxes(elements, 1, 2))
    table = away.argmin(axis=2)
    for _ in range(_AVERAGINGS):
        left, _, right = np.linalg.svd((elements[table] @ np.swapaxes(elements, 1, 2)).mean(axis=1))
        elements = left @ right
    elements[0] = np.eye(3)
    return np.asarray(elements)
