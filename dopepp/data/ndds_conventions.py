"""How an NDDS data set writes its poses: found by reprojecting the cuboid, because names mislead.

In the wild, ``quaternion_xyzw`` holds x, y, z, w or w, x, y, z; lengths are centimetres (NDDS, FAT)
or metres (nvisii) or millimetres; camera axes are OpenCV's or, in old nvisii files, OpenGL's; and
the pose is that of the mesh or of a frame that ``fixed_model_transform`` turns the mesh into (FAT).
Each combination is a hypothesis. It predicts where the part's cuboid appears, and the right one
puts it on ``projected_cuboid``. To allow for one more habit, add it to
:mod:`dopepp.data.ndds_poses`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.data.ndds_fields import bad
from dopepp.data.ndds_poses import CONVENTIONS, Convention, Observation
from dopepp.errors import UserError
from dopepp.geometry.camera import transform

MAX_ERROR_PX: Final = 5.0
"""Of the right hypothesis in three quarters of the instances: annotations of photos are this good.
"""

_MAX_SHARE: Final = 0.05
"""Of the longer side of its projected cuboid, an instance may be off, where that is more than
``MAX_ERROR_PX``: annotations of photos are worse on what is near."""

_MOST: Final = 0.75
_RATIO: Final = 3.0
_ROUNDING_PX: Final = 0.05
_SAME_POSE: Final = 0.05
"""Hypotheses whose corners differ by less than this many diameters are no rivals: the better fit of
them counts even where noise leaves it less than three times better."""


@dataclass(frozen=True)
class Finding:
    """The convention of a data set.

    Attributes:
        convention: The one that fits.
        error_px: Its reprojection error in three quarters of the instances.
        rival_px: The error of the best one that gives other poses.
        undecided: Other orders, units or axes that give the same poses in these instances.
        num_instances: How many instances were compared.
    """

    convention: Convention
    error_px: float
    rival_px: float
    undecided: tuple[Convention, ...]
    num_instances: int

    def __str__(self) -> str:
        """Say what was found and how sure it is."""
        text = (
            f"{self.convention} (reprojection error {self.error_px:.2g} px, of the next best "
            f"{self.rival_px:.3g} px, {self.num_instances} instances)"
        )
        if self.undecided:
            others = "; ".join(map(str, self.undecided))
            text += f"; the same poses so far with: {others}"
        return text


def find_convention(observations: Sequence[Observation], where: str) -> Finding:
    """Find the one convention under which the part's cuboid lands on ``projected_cuboid``.

    Args:
        observations: Instances with ``projected_cuboid``; one is enough in most cases.
        where: The data set, for errors.

    Raises:
        UserError: None fits three quarters of the instances within 5 px, or two that give different
            poses fit alike.
    """
    errors = {
        convention: _most([one.error_px(convention) for one in observations])
        for convention in CONVENTIONS
    }
    ranked = sorted(errors, key=lambda one: errors[one])
    least = errors[ranked[0]]
    if not least <= MAX_ERROR_PX:
        raise _undecidable(where, "no known convention fits", ranked[:6], errors)
    best = next(one for one in CONVENTIONS if errors[one] <= least + _ROUNDING_PX)
    rivals = [one for one in ranked if one != best]
    alike = tuple(one for one in rivals if _same_poses(observations, best, one))
    others = [one for one in rivals if one not in alike]
    rival = min((errors[one] for one in others), default=np.inf)
    if rival < _RATIO * errors[best] + _ROUNDING_PX:
        raise _undecidable(where, "two conventions fit alike", [best, *others[:5]], errors)
    undecided = tuple(one for one in alike if replace(one, frame=best.frame) != best)
    return Finding(best, errors[best], rival, undecided, len(observations))


def check_observation(one: Observation, convention: Convention) -> Float[np.ndarray, "4 4"]:
    """Return an instance's pose after holding it against its own ``projected_cuboid``.

    Raises:
        UserError: The pose is behind the camera, needs a ``fixed_model_transform`` that its class
            does not have, or is off by more than 5 px and 5 % of the cuboid's longer side.
    """
    T_cam_obj, field = one.T_cam_obj(convention), one.item.field
    if T_cam_obj is None:
        got = f"no fixed_model_transform of {one.item.label} in the object settings"
        raise bad(one.path, f"{field}.class", got, f"one as for the others ({convention})")
    if T_cam_obj[2, 3] <= 0:
        got = f"an object behind the camera (z = {T_cam_obj[2, 3]:.3g} m)"
        raise bad(one.path, f"{field}.location", got, f"one before it ({convention})")
    predicted = one.predicted_px(convention)
    # Projections of what nobody sees or what reaches behind the camera mean nothing.
    if predicted is None or not np.isfinite(predicted).all() or one.item.visibility == 0:
        return T_cam_obj
    error, extent = one.error_px(convention), float(np.ptp(predicted, axis=0).max())
    if one.item.corners_px is not None and error > max(MAX_ERROR_PX, _MAX_SHARE * extent):
        got = f"{error:.3g} px from where the pose puts the cuboid of {one.part.name}"
        raise bad(one.path, f"{field}.projected_cuboid", got, f"the data set's {convention}")
    return T_cam_obj


def _same_poses(observations: Sequence[Observation], a: Convention, b: Convention) -> bool:
    """Tell whether two conventions put most instances' cuboids at the same place in space."""
    distances = []
    for one in observations:
        T_a, T_b = one.T_cam_obj(a), one.T_cam_obj(b)
        if T_a is None or T_b is None:
            return False
        apart = transform(T_a, one.part.cuboid) - transform(T_b, one.part.cuboid)
        distances.append(float(np.abs(apart).max()) / one.part.diameter)
    return _most(distances) <= _SAME_POSE


def _most(values: Sequence[float]) -> float:
    """Return what three quarters of the values do not exceed: a few damaged items do not count."""
    return float(np.quantile(values, _MOST, method="higher"))


def _undecidable(
    where: str, why: str, shown: Sequence[Convention], errors: dict[Convention, float]
) -> UserError:
    figures = "; ".join(f"{errors[one]:.3g} px: {one}" for one in shown)
    return UserError(
        f"{where}: {why}; reprojection error: {figures}",
        f"one convention with at most {MAX_ERROR_PX:g} px and a third of any other's error",
        "check that the parts are the meshes (and units) the data set was made with, and its K",
    )
