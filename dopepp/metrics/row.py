"""Errors of an object's poses, and the measures of a result table.

To add an error, give :class:`PoseErrors` a field and :meth:`PoseErrors.of` its function. To add a
measure, give :class:`PoseRow` a field and :data:`COLUMNS` its heading and formula; tables, CSV and
``metrics.json`` follow.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dopepp.geometry.symmetry import symmetry_group
from dopepp.metrics.functional import (
    BOP_MSPD_THRESHOLDS,
    BOP_THRESHOLDS,
    add,
    add_s,
    auc,
    average_recall,
    coverage,
    mahalanobis,
    mspd,
    mssd,
    pass_rate,
    rotation_error_deg,
    translation_error,
)
from dopepp.metrics.functional.distances import Errors
from dopepp.parts.part import Part

NOT_AVAILABLE: Final = "n/a"

Poses = Float[Tensor, "n 4 4"]

_USUAL_MAHALANOBIS: Final = 2.3126
"""Median of the Mahalanobis distance of six standard normal numbers."""


@dataclass
class PoseErrors:
    """Errors of N poses of one object, infinite for a miss."""

    add: Errors  # ADD, metres
    add_s: Errors  # ADD-S, metres
    mssd: Errors  # MSSD over the part's symmetries, metres
    # MSPD over the part's symmetries, pixels of an image 640 wide; None if a camera is unknown.
    mspd: Errors | None
    rotation_deg: Errors  # Angle between the orientations, degrees
    rotation_s_deg: Errors  # Smallest angle over the part's symmetries, degrees
    # Distance between the object frame's origins, metres; None for a reference row.
    translation: Errors | None
    # Mahalanobis distance under the estimated covariance; infinite without a covariance, None for a
    # reference row.
    mahalanobis: Errors | None
    diameter: float  # Diameter of the part, metres
    num_symmetries: int = 1  # Number of symmetry transforms, including the identity

    @classmethod
    def of(
        cls,
        part: Part,
        T_est: Poses,
        T_gt: Poses,
        K: Float[Tensor, "n 3 3"],
        width: Errors,
        covariance: Float[Tensor, "n 6 6"],
    ) -> PoseErrors:
        """Compute all errors of estimated poses from true poses.

        ``T_est`` and ``T_gt`` are in metres; K and ``width`` of the images in pixels. Missed poses
        and unknown numbers are NaN. Covariances are those of detections.
        """
        poses = T_est[:, :3, :3], T_est[:, :3, 3], T_gt[:, :3, :3], T_gt[:, :3, 3]
        points = torch.from_numpy(np.asarray(part.points, np.float64))
        vertices, group = bop_points(part), symmetry_transforms(part)
        has_cameras = bool(K.isfinite().all() & width.isfinite().all())
        return cls(
            add=add(*poses, points),
            add_s=add_s(*poses, points),
            mssd=mssd(*poses, vertices, group),
            mspd=mspd(*poses, vertices, K, group) * (640 / width) if has_cameras else None,
            rotation_deg=rotation_error_deg(poses[0], poses[2]),
            rotation_s_deg=rotation_error_deg(poses[0], poses[2], group),
            translation=translation_error(poses[1], poses[3]),
            mahalanobis=mahalanobis(*poses, covariance, group),
            diameter=part.diameter,
            num_symmetries=len(group),
        )

    @property
    def add_or_s(self) -> Errors:
        """ADD-S for a part with symmetries, otherwise ADD, metres."""
        return self.add_s if self.num_symmetries > 1 else self.add


def symmetry_transforms(part: Part) -> Float[Tensor, "s 4 4"]:
    """Return a part's symmetry transforms, metres, identity first; continuous ones are sampled."""
    return torch.from_numpy(symmetry_group(part.symmetries_discrete, part.symmetries_continuous))


def bop_points(part: Part) -> Float[Tensor, "v 3"]:
    """Return the points for BOP's scores: the mesh's vertices, or ADD points without a mesh.

    Vertices include the corners, which have the largest distances; surface samples miss corners.
    """
    points = part.points if part.mesh is None else part.mesh.vertices
    return torch.from_numpy(np.asarray(points, np.float64))


@dataclass
class PoseRow:
    """Measures of one method on one object; None ("n/a") for an undefined measure.

    Shares lie in [0, 1], angles are degrees, distances metres. Medians and 90th percentiles are
    over matched instances. The class is not frozen, because torchmetrics rebuilds the rows.
    """

    object: str  # The part's name, or ``mean``
    method: str  # Source of the poses: the estimator, or the name of a reference
    num_instances: int  # Number of evaluated ground-truth instances
    add_01d: float | None = None  # Share of instances with ADD below a tenth of the diameter
    add_005d: float | None = None
    add_002d: float | None = None
    pass_5cm: float | None = None
    pass_10cm: float | None = None
    auc_10cm: float | None = None
    add_s_01d: float | None = None
    auc_s_10cm: float | None = None
    median_rotation_deg: float | None = None
    median_translation: float | None = None
    p90_rotation_deg: float | None = None
    p90_translation: float | None = None
    # Median ratio of true errors to estimated standard deviations, 1 for calibrated covariances;
    # None without covariances.
    median_deviations: float | None = None
    # Share of matched poses inside their 90 % covariance region, or None.
    coverage: float | None = None
    # Largest distance of a match (:func:`~dopepp.metrics.pose.matching_radius`).
    matching_radius: float | None = None
    miss_rate: float | None = None  # Share of instances without a matched prediction
    # Share of the reported poses with ADD(-S) below a tenth of the diameter; None if nothing is
    # reported.
    precision: float | None = None
    false_per_frame: float | None = None  # Detections without an instance, per image
    # AP over the scores, correct with ADD(-S) below a tenth of the diameter.
    average_precision: float | None = None
    mssd_01d: float | None = None
    ar_mssd: float | None = None  # BOP's average recall of MSSD
    # BOP's average recall of MSPD; None if an image's camera is unknown.
    ar_mspd: float | None = None
    # Share of instances with MSPD below 5 px at 640 px width; None without cameras.
    mspd_5px: float | None = None
    median_rotation_s_deg: float | None = None
    add_or_s_01d: float | None = None  # Like ``add_01d``, with ADD-S for a part with symmetries
    auc_or_s_10cm: float | None = None
    pass_5cm_5deg: float | None = None
    num_symmetries: int = 1  # Number of symmetry transforms of the object, including the identity


Formula = Callable[[PoseErrors], float | None]
"""Function of the errors of N >= 1 poses; None for an undefined measure."""


@dataclass(frozen=True)
class Column:
    """How a field of :class:`PoseRow` is computed and displayed."""

    field: str  # Name of the field
    heading: str  # Heading with the unit
    scale: float = 1.0  # Factor from the stored to the displayed unit
    decimals: int = 0  # Displayed digits after the point
    # Group in a printed table; only parts with symmetries have the group ``symmetry``.
    group: str = ""
    # Function of the errors; None if errors alone do not determine the measure.
    formula: Formula | None = None

    def text(self, row: PoseRow) -> str:
        """Return the text of this column for a row."""
        return self.format(getattr(row, self.field))

    def format(self, value: float | None, *, signed: bool = False) -> str:
        """Return a value in the displayed unit, or ``n/a`` for None."""
        if value is None:
            return NOT_AVAILABLE
        return f"{value * self.scale:{'+' if signed else ''}.{self.decimals}f}"


def _below(error: str, diameters: float) -> Formula:
    """Return the formula of the share of errors below a threshold in diameters."""
    return lambda errors: pass_rate(getattr(errors, error), diameters * errors.diameter)


def _within(error: str, metres: float) -> Formula:
    """Return the formula of the share of errors below a threshold in metres."""
    return lambda errors: pass_rate(getattr(errors, error), metres)


def _area(error: str) -> Formula:
    """Return the formula of an error's area under the accuracy curve up to 0.1 m, in [0, 1]."""
    return lambda errors: auc(getattr(errors, error), 0.1)


def _of_finite(error: str, statistic: Callable[[Tensor], float]) -> Formula:
    """Return a formula: the statistic of the finite errors, or None without finite errors."""

    def formula(errors: PoseErrors) -> float | None:
        values = getattr(errors, error)
        finite = torch.empty(0) if values is None else values[values.isfinite()].double()
        return statistic(finite) if len(finite) else None

    return formula


def _median(error: str) -> Formula:
    """Return the formula of the median of an error's finite values."""
    return _of_finite(error, lambda finite: statistics.median(finite.tolist()))


def _p90(error: str) -> Formula:
    """Return the formula of the 90 % quantile of an error's finite values."""
    return _of_finite(error, lambda finite: float(finite.quantile(0.9)))


def _near(errors: PoseErrors) -> float | None:
    """Return the share of poses within 5 cm and, up to symmetry, within 5°."""
    if errors.translation is None:
        return None
    near = (errors.translation < 0.05) & (errors.rotation_s_deg < 5)
    return float(near.double().mean())


def _ar_mssd(errors: PoseErrors) -> float:
    return average_recall(errors.mssd, [share * errors.diameter for share in BOP_THRESHOLDS])


def _ar_mspd(errors: PoseErrors) -> float | None:
    """Return BOP's average recall of MSPD, or None without cameras."""
    return None if errors.mspd is None else average_recall(errors.mspd, BOP_MSPD_THRESHOLDS)


def _mspd_5px(errors: PoseErrors) -> float | None:
    """Return the share of MSPDs below 5 px of a 640-pixel-wide image, or None without cameras."""
    return None if errors.mspd is None else pass_rate(errors.mspd, 5)


def _median_deviations(errors: PoseErrors) -> float | None:
    """Return the median Mahalanobis distance, divided by its value for correct covariances."""
    median = _median("mahalanobis")(errors)
    return None if median is None else median / _USUAL_MAHALANOBIS


COLUMNS: Final[tuple[Column, ...]] = (
    Column("num_instances", "instances"),
    Column("add_01d", "ADD-0.1d %", 100, 1, "ADD", _below("add", 0.1)),
    Column("add_005d", "ADD-0.05d %", 100, 1, "ADD", _below("add", 0.05)),
    Column("add_002d", "ADD-0.02d %", 100, 1, "ADD", _below("add", 0.02)),
    Column("pass_5cm", "ADD<5cm %", 100, 1, "ADD", _within("add", 0.05)),
    Column("pass_10cm", "ADD<10cm %", 100, 1, "ADD", _within("add", 0.1)),
    Column("auc_10cm", "AUC[0,10cm] %", 100, 1, "ADD", _area("add")),
    Column("pass_5cm_5deg", "5 cm 5° %", 100, 1, "ADD", _near),
    Column("add_or_s_01d", "ADD(-S)-0.1d %", 100, 1, "symmetry", _below("add_or_s", 0.1)),
    Column("auc_or_s_10cm", "AUC(-S)[0,10cm] %", 100, 1, "symmetry", _area("add_or_s")),
    Column("add_s_01d", "ADD-S-0.1d %", 100, 1, "symmetry", _below("add_s", 0.1)),
    Column("auc_s_10cm", "AUC-S[0,10cm] %", 100, 1, "symmetry", _area("add_s")),
    Column("mssd_01d", "MSSD-0.1d %", 100, 1, "symmetry", _below("mssd", 0.1)),
    Column("median_rotation_s_deg", "rotation-S °", 1, 1, "symmetry", _median("rotation_s_deg")),
    Column("ar_mssd", "AR_MSSD %", 100, 1, "BOP", _ar_mssd),
    Column("ar_mspd", "AR_MSPD %", 100, 1, "BOP", _ar_mspd),
    Column("mspd_5px", "MSPD<5px %", 100, 1, "BOP", _mspd_5px),
    Column("median_rotation_deg", "rotation °", 1, 1, "median", _median("rotation_deg")),
    Column("median_translation", "translation mm", 1000, 1, "median", _median("translation")),
    Column("p90_rotation_deg", "rotation 90 % °", 1, 1, "median", _p90("rotation_deg")),
    Column("p90_translation", "translation 90 % mm", 1000, 1, "median", _p90("translation")),
    Column("median_deviations", "error / stated", 1, 1, "covariance", _median_deviations),
    Column(
        "coverage", "coverage[0.9] %", 100, 1, "covariance", _of_finite("mahalanobis", coverage)
    ),
    Column("matching_radius", "matching radius mm", 1000, 1, "detection"),
    Column("miss_rate", "missed %", 100, 1, "detection"),
    Column("precision", "precision %", 100, 1, "detection"),
    Column("false_per_frame", "false/frame", 1, 3, "detection"),
    Column("average_precision", "AP %", 100, 1, "detection"),
)
"""Measures of a table, in order."""

_TOTALS: Final = ("num_instances", "false_per_frame")
"""Measures whose mean row holds the sum over objects."""


def shown_columns(row: PoseRow, all_measures: bool = False) -> list[Column]:
    """Return a row's columns; unless ``all_measures``, symmetric ones for symmetric parts only."""
    has_symmetries = all_measures or row.num_symmetries > 1
    return [column for column in COLUMNS if has_symmetries or column.group != "symmetry"]


def summarise(name: str, method: str, errors: PoseErrors) -> PoseRow:
    """Return a row with the measures that the errors of N >= 1 poses determine."""
    measures: dict[str, Any] = {c.field: c.formula(errors) for c in COLUMNS if c.formula}
    return PoseRow(name, method, len(errors.add), num_symmetries=errors.num_symmetries, **measures)


def mean_row(rows: Sequence[PoseRow], method: str) -> PoseRow:
    """Average each measure over the objects that have it and at least one instance.

    Numbers of instances and of false detections are totals over all objects.
    """
    mean = PoseRow(object="mean", method=method, num_instances=0)
    mean.num_symmetries = max((row.num_symmetries for row in rows), default=1)
    for column in COLUMNS:
        is_total = column.field in _TOTALS
        values = [getattr(row, column.field) for row in rows if is_total or row.num_instances]
        available = [value for value in values if value is not None]
        if available:
            total = sum(available)
            setattr(mean, column.field, total if is_total else total / len(available))
    return mean
