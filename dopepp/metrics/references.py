"""Reference rows of a result table: poses that need no estimate.

The three references combine the true position with a random rotation, with a rotation from the test
set, and with the best constant rotation. A narrow range of test poses has high reference rows.

A part is rotated about the centre of its cuboid, so every measure depends only on the rotation Q
between the true and the guessed orientation. A reference is a list of rotations Q. It has no
AR_MSPD, which depends on the position in the image, and no average precision, which needs scores.

To add a reference, write a function that returns rotations Q and call it in :func:`reference_rows`.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dopepp.geometry.cuboid import CENTROID
from dopepp.geometry.rotation import nearest_rotation, random_rotation
from dopepp.metrics.functional import add, add_s, mssd, pass_rate, rotation_error_deg
from dopepp.metrics.row import PoseErrors, PoseRow, bop_points, summarise, symmetry_transforms
from dopepp.parts.part import Part

CHANCE_ALL: Final = "chance, all rotations"
CHANCE_RANGE: Final = "chance, test range"
BEST_CONSTANT: Final = "best constant pose"
REFERENCES: Final = (CHANCE_ALL, CHANCE_RANGE, BEST_CONSTANT)

_MAX_POSES: Final = 300  # Largest number of test poses; the best constant compares all pairs
_NUM_DRAWS: Final = 2000
"""Number of guesses in a chance row: the standard error of a share near 15 % is 0.8 %."""
_NUM_POINTS: Final = 500
"""Number of ADD points: the mean of 500 of 2,000 distances is accurate to about 1 %."""
_NUM_SURFACE_DRAWS: Final = 300
"""Number of guesses evaluated by ADD-S and symmetric errors, which cost far more than ADD."""


def reference_rows(
    part: Part, T_cam_obj: Float[np.ndarray, "n 4 4"], seed: int = 0
) -> dict[str, PoseRow]:
    """Compute the three reference rows of a part for the true poses of its instances, metres.

    Returns:
        Rows by name, in the order of :data:`REFERENCES`. Measures are None without instances, and
        for ``chance, test range`` also with a single instance.
    """
    rng = np.random.default_rng(seed)
    rotations = np.asarray(T_cam_obj, np.float64).reshape(-1, 4, 4)[:, :3, :3]
    num_instances = len(rotations)
    # Sorted, so that the rows do not depend on the order in which ranks gathered the poses.
    rotations = rotations[np.lexsort(rotations.reshape(-1, 9).T)]
    if len(rotations) > _MAX_POSES:
        rotations = rotations[rng.choice(len(rotations), _MAX_POSES, replace=False)]
    centred = np.asarray(part.points, np.float64) - part.cuboid[CENTROID]
    few = rng.permutation(len(centred))[:_NUM_POINTS]
    points, few_points = torch.from_numpy(centred), torch.from_numpy(centred[few])
    guesses = dict.fromkeys(REFERENCES, np.empty((0, 3, 3)))
    if len(rotations):
        guesses[CHANCE_ALL] = np.stack([random_rotation(rng) for _ in range(_NUM_DRAWS)])
        guesses[CHANCE_RANGE] = _other_poses(rotations, rng)
        guesses[BEST_CONSTANT] = _best_constant(rotations, few_points, 0.1 * part.diameter)
    rows = {}
    for name, guess in guesses.items():
        rows[name] = PoseRow(part.name, name, 0, num_symmetries=len(symmetry_transforms(part)))
        if len(guess):
            rows[name] = _row(part, name, torch.from_numpy(guess), few_points, points)
        rows[name].num_instances = num_instances
    return rows


def _row(part: Part, name: str, Q: Tensor, few_points: Tensor, points: Tensor) -> PoseRow:
    """Return the row of guesses at the true position with the rotation errors Q, (n, 3, 3)."""
    identity = torch.eye(3, dtype=torch.float64).expand_as(Q)
    origin = Q.new_zeros(len(Q), 3)
    # Chance guesses are in random order, so the first guesses are a random sample.
    subset = slice(_NUM_SURFACE_DRAWS)
    about_centre = Q[subset], origin[subset], identity[subset], origin[subset]
    # Symmetries are transforms of the object frame, whose origin may lie anywhere.
    centre = torch.from_numpy(np.asarray(part.cuboid[CENTROID], np.float64))
    poses = Q[subset], centre - Q[subset] @ centre, identity[subset], origin[subset]
    group = symmetry_transforms(part)
    errors = PoseErrors(
        add=add(Q, origin, identity, origin, few_points),
        add_s=add_s(*about_centre, points),
        mssd=mssd(*poses, bop_points(part), group),
        mspd=None,
        rotation_deg=rotation_error_deg(Q, identity),
        rotation_s_deg=rotation_error_deg(Q[subset], identity[subset], group),
        translation=None,
        mahalanobis=None,
        diameter=part.diameter,
        num_symmetries=len(group),
    )
    return summarise(part.name, name, errors)


def _other_poses(
    rotations: Float[np.ndarray, "n 3 3"], rng: np.random.Generator
) -> Float[np.ndarray, "draws 3 3"]:
    """Return the rotations between pairs of test poses: all pairs, or a random subset."""
    n = len(rotations)
    # Pair k of the n·(n − 1) ordered pairs has a true pose and the index offset of its guess.
    true, step = np.divmod(rng.permutation(n * (n - 1))[:_NUM_DRAWS], max(n - 1, 1))
    guessed = (true + 1 + step) % n
    return np.asarray(rotations[true].transpose(0, 2, 1) @ rotations[guessed])


def _best_constant(
    rotations: Float[np.ndarray, "n 3 3"], points: Tensor, threshold: float
) -> Float[np.ndarray, "n 3 3"]:
    """Return the rotation errors of the constant rotation with the most ADDs below a threshold.

    Candidates are all test rotations and their mean; equal rates are decided by the mean ADD.
    """
    mean = nearest_rotation(rotations.mean(axis=0))
    candidates = np.concatenate([rotations, mean[None]])
    Q = rotations.transpose(0, 2, 1)[None] @ candidates[:, None]
    guess = torch.from_numpy(Q.reshape(-1, 3, 3))
    zero, identity = guess.new_zeros(len(guess), 3), torch.eye(3).double().expand_as(guess)
    errors = add(guess, zero, identity, zero, points).reshape(len(candidates), len(rotations))
    rates = [(pass_rate(row, threshold), -float(row.mean())) for row in errors]
    return np.asarray(Q[rates.index(max(rates))])
