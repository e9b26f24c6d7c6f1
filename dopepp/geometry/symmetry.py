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
"""Order of the icosahedral group: the largest finite group apart from dihedral groups."""

SAME_TURN: Final = math.radians(10.0)
"""Largest angle between rotations that count as equal; a 12-fold axis has steps of 30°."""

_AVERAGINGS: Final = 5  # Each averaging squares the error: 10° become less than 1e-15
BALL_STEP: Final = 0.2  # Smallest angle between neighbouring rotations of a ball, radians
_PARALLEL: Final = 0.01  # Sine of the largest angle between parallel axes

MAX_STEP = 0.01
"""Largest move of a point between two steps of a continuous symmetry, diameters (BOP)."""

ContinuousSymmetry = tuple[tuple[float, ...], tuple[float, ...]]
"""Axis of rotational symmetry and a point on the axis, metres."""


def symmetry_group(
    discrete: Float[np.ndarray, "symmetries 4 4"] | None = None,
    continuous: Sequence[ContinuousSymmetry] = (),
    max_step: float = MAX_STEP,
) -> Float[np.ndarray, "group 4 4"]:
    """Return all symmetry transforms, the identity first; continuous symmetries are sampled.

    As in BOP, every step of a continuous symmetry is combined with every discrete symmetry. A part
    with two axes that are not parallel is a ball, whose rotations are 0.2 rad apart.

    Both kinds of symmetries are as in BOP, metres; ``discrete`` lacks the identity. ``max_step`` is
    the largest move of a point at half a diameter from the axis, diameters.

    Raises:
        ValueError: An axis has no length.
    """
    group = np.eye(4)[None]
    if discrete is not None:
        group = np.concatenate([group, np.asarray(discrete, np.float64).reshape(-1, 4, 4)])
    if not continuous:
        return group
    axes = np.array([axis for axis, _ in continuous], np.float64)
    lengths = np.array([np.linalg.norm(axis) for axis in axes])
    if not ((lengths > 0) & np.isfinite(lengths)).all():
        raise ValueError(f"an axis of symmetry must have a length, got {axes.tolist()}")
    axes /= lengths[:, None]
    offset = np.array(continuous[0][1], np.float64)
    if np.linalg.norm(np.cross(axes[0], axes), axis=1).max() > _PARALLEL:
        return rotations_about(offset, _ball_rotations(max(2 * max_step, BALL_STEP)))
    count = math.ceil(math.pi / max_step)
    angles = np.arange(count) * (2 * math.pi / count)
    about_axis = rotations_about(offset, rotation_vector_to_matrix(angles[:, None] * axes[0]))
    return np.asarray((about_axis[None] @ group[:, None]).reshape(-1, 4, 4))


def rotations_about(
    centre: Vector, rotations: Float[np.ndarray, "rotations 3 3"]
) -> Float[np.ndarray, "rotations 4 4"]:
    """Return rotations about a point (metres) as rigid transforms."""
    return make_transform(rotations, centre - rotations @ centre)


def _ball_rotations(step: float) -> Float[np.ndarray, "rotations 3 3"]:
    """Return rotations that cover all orientations, about ``step`` radians apart.

    They map z to directions on a spiral, after one of several rotations about z.
    """
    number = np.arange(math.ceil(4 * math.pi / step**2))
    z = 1 - 2 * number / number[-1]  # the first direction is z
    polar, around = np.arccos(z), np.pi * (3 - math.sqrt(5)) * number
    tilt = np.stack([-np.sin(around), np.cos(around), np.zeros_like(z)], axis=1)
    angles = np.arange(0, 2 * math.pi, 2 * math.pi / math.ceil(2 * math.pi / step))
    about_axis = rotation_vector_to_matrix(angles[:, None] * np.array([0.0, 0.0, 1.0]))
    tilts = rotation_vector_to_matrix(polar[:, None] * tilt)
    return np.asarray((tilts[:, None] @ about_axis[None]).reshape(-1, 3, 3))


def exact_group(
    rotations: Float[np.ndarray, "generators 3 3"],
) -> Float[np.ndarray, "group 3 3"] | None:
    """Return the finite group that measured rotations generate, the identity first.

    Products are added until all are within 10° of an element. Then each element g is replaced by
    the mean of ρ(gh)·ρ(h)⁻¹ over all h, which turns an approximate homomorphism ρ into an exact one
    (Grove, Karcher, Ruh 1974).

    Returns:
        The group, or None if it has more than 60 elements.
    """
    group = [np.eye(3)]
    generators = [np.asarray(rotation, np.float64) for rotation in rotations]
    for element in group:  # the loop appends to the group
        for generator in generators:
            product = generator @ element
            if rotation_angle(product @ np.swapaxes(group, 1, 2)).min() > SAME_TURN:
                group.append(product)
        if len(group) > MAX_FINITE:
            return None
    elements = np.array(group)
    products = elements[:, None] @ elements[None]
    table = rotation_angle(products[:, :, None] @ np.swapaxes(elements, 1, 2)).argmin(axis=2)
    for _ in range(_AVERAGINGS):
        left, _, right = np.linalg.svd((elements[table] @ np.swapaxes(elements, 1, 2)).mean(axis=1))
        elements = left @ right
    elements[0] = np.eye(3)
    return np.asarray(elements)
