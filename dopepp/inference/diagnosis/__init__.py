"""What is wrong where poses are missing or bad: a sentence and a fix for each thing looked at.

A picture is looked at as :meth:`PoseEstimator.predict` does, then in further sizes, and what is
found is held against its outline. Findings stand in the order of causes: a wrong mesh or a blurred
picture spoils all that follows, and maps tell least about why they are empty.

To add a check, write a function from a :class:`Case` to a :class:`Finding` in ``checks.py`` and
name it in :data:`CHECKS`, before those whose findings it explains.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from dopepp.inference.diagnosis.case import Case
from dopepp.inference.diagnosis.checks import (
    Finding,
    camera,
    exposure,
    part_size,
    pose,
    sharpness,
    size,
    visibility,
)

__all__ = ["CHECKS", "Case", "Finding", "diagnose"]

CHECKS: Final[tuple[Callable[[Case], Finding], ...]] = (
    part_size, exposure, sharpness, camera, size, visibility, pose,
)  # fmt: skip
"""In the order of causes."""


def diagnose(case: Case) -> list[Finding]:
    """Return a finding of every check, in the order of causes."""
    return [check(case) for check in CHECKS]
