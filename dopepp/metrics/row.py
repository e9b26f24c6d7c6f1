"""Every error of one object's poses, and the row of a result table that sums them up.

To add an error, give :class:`PoseErrors` a field and :meth:`PoseErrors.of` its function. To add a
measure, give :class:`PoseRow` a field and :data:`COLUMNS` its heading and formula; tables, CSV and
``metrics.json`` follow.
"""

from __future__ import annotations

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
"""Median of the Mahalanobis distance of six Gaussian numbers: the root of chi-squared's."""


@dataclass
class PoseErrors:
    """Errors of N poses of one object, infinite where it was missed.

    Attributes:
        add: ADD, metres.
        add_s: ADD-S, metres.
        mssd: MSSD over the part's symmetries, metres.
        mspd: MSPD over the part's symmetries, pixels of an image 640 wide; None where a camera is
            not known.
        rotation_deg: Angle between the orientations, degrees.
        rotation_s_deg: The least such angle over the part's symmetries, degrees.
        translation: Distance between the object frame's origins, metres; None of guesses.
        deviations: Mahalanobis distance by the estimate's own covariance, over the median that
            right covariances give; infinite, too, where none is known. None of guesses.
        diameter: Diameter of the part, metres.
        num_symmetries: Transforms that map the part onto itself, the identity among them.
    """

    add: Errors
    add_s: Errors
    mssd: Errors
    mspd: Errors | None
    rotation_deg: Errors
    rotation_s_deg: Errors
    translation: Errors | None
    deviations: Errors | None
    diameter: float
    num_symmetries: int = 1

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
        """Compute them, of estimated poses (NaN for a miss) and true ones, metres.

        Camera matrices and the images' widths are pixels, NaN where unknown; covariances are those
        of :class:`~dopepp.recovery.detection.Detection`, NaN where an estimate has none.
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
            deviations=mahalanobis(*poses, covariance, group) / _USUAL_MAHALANOBIS,
            diameter=part.diameter,
            num_symmetries=len(group),
        )

    @property
    def add_or_s(self) -> Errors:
        """ADD, of a part with symmetries ADD-S, metres."""
        return self.add_s if self.num_symmetries > 1 else self.add


def symmetry_transforms(part: Part) -> Float[Tensor, "s 4 4"]:
    """Return the part's symmetry transforms, the identity first."""
    return torch.from_numpy(symmetry_group(part.symmetries_discrete, part.symmetries_continuous))


def bop_points(part: Part) -> Float[Tensor, "v 3"]:
    """Return what BOP's scores look at: the mesh's vertices, of a part without mesh the ADD points.

    The surface samples of a CAD part miss its corners, where the largest distances are.
    """
    points = part.points if part.mesh is None else part.mesh.vertices
    return torch.from_numpy(np.asarray(points, np.float64))


def finite_median(errors: Errors | None) -> float | None:
    """Median of the finite errors (the mean of the middle two if even); None if there is none."""
    finite = torch.empty(0) if errors is None else errors[errors.isfinite()].double().sort().values
    if len(finite) == 0:
        return None
    return float((finite[(len(finite) - 1) // 2] + finite[len(finite) // 2]) / 2)


def finite_p90(errors: Errors | None) -> float | None:
    """90th percentile of the finite errors, between two of them linearly; None if there is none."""
    finite = torch.empty(0) if errors is None else errors[errors.isfinite()].double()
    return float(finite.quantile(0.9)) if len(finite) else None


@dataclass
class PoseRow:
    """Measures of one method on one object; None where a measure does not exist ("n/a").

    Shares lie in [0, 1], angles are degrees, distances metres. Medians and 90th percentiles are
    over matched instances. (Not frozen: torchmetrics rebuilds what ``compute`` returns.)

    Attributes:
        object: The part's name, or ``mean``.
        method: What produced the poses: the estimator, or a reference row's name.
        num_instances: Ground-truth instances that count; poses tried in a reference row.
        add_01d: Share with ADD below a tenth of the diameter, and so on.
        add_or_s_01d: The same with ADD-S of a part with symmetries, with ADD of others.
        ar_mssd: BOP's average recall of MSSD.
        ar_mspd: BOP's average recall of MSPD; None where an image's camera is not known.
        median_deviations: By how many times the true errors exceed the standard deviations that
            the estimates state, in the median: 1 is honest; None without covariances.
        miss_rate: Share of instances without a matched prediction.
        average_precision: AP over the scores, with ADD below a tenth of the diameter right.
        precision: TP / (TP + FP); 0 without predictions.
        false_positives: Predictions matched with no instance.
        num_symmetries: As of :class:`PoseErrors`.
    """

    object: str
    method: str
    num_instances: int
    add_01d: float | None = None
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
    median_deviations: float | None = None
    miss_rate: float | None = None
    precision: float | None = None
    false_positives: int | None = None
    average_precision: float | None = None
    mssd_01d: float | None = None
    ar_mssd: float | None = None
    ar_mspd: float | None = None
    median_rotation_s_deg: float | None = None
    add_or_s_01d: float | None = None
    auc_or_s_10cm: float | None = None
    pass_5cm_5deg: float | None = None
    num_symmetries: int = 1


Formula = Callable[[PoseErrors], float | None]
"""Errors of N >= 1 poses to what they amount to."""


@dataclass(frozen=True)
class Column:
    """How a field of :class:`PoseRow` is computed, and how a table shows it.

    Attributes:
        field: The field's name.
        heading: What stands above it, with the unit.
        scale: Factor from the stored unit to the shown one.
        decimals: Digits after the point.
        group: Measures of one group stand together in a printed table; those of the group
            ``symmetry`` say something of their own only about a part with symmetries.
        formula: Function of the errors; None of what needs more than errors.
    """

    field: str
    heading: str
    scale: float = 1.0
    decimals: int = 0
    group: str = ""
    formula: Formula | None = None

    def text(self, row: PoseRow) -> str:
        """Return a row's cell."""
        return self.shown(getattr(row, self.field))

    def shown(self, value: float | None, *, signed: bool = False) -> str:
        """Return a value in the shown unit, ``n/a`` where it does not exist."""
        if value is None:
            return NOT_AVAILABLE
        return f"{value * self.scale:{'+' if signed else ''}.{self.decimals}f}"


def _below(error: str, diameters: float) -> Formula:
    return lambda errors: pass_rate(getattr(errors, error), diameters * errors.diameter)


def _within(error: str, metres: float) -> Formula:
    return lambda errors: pass_rate(getattr(errors, error), metres)


def _area(error: str) -> Formula:
    return lambda errors: auc(getattr(errors, error), 0.1)


def _median(error: str) -> Formula:
    return lambda errors: finite_median(getattr(errors, error))


def _p90(error: str) -> Formula:
    return lambda errors: finite_p90(getattr(errors, error))


def _near(errors: PoseErrors) -> float | None:
    """Return the share off by less than 0.05 m and, of the nearest symmetry, 5°."""
    if errors.translation is None:
        return None
    near = (errors.translation < 0.05) & (errors.rotation_s_deg < 5)
    return float(near.double().mean())


def _ar_mssd(errors: PoseErrors) -> float:
    return average_recall(errors.mssd, [share * errors.diameter for share in BOP_THRESHOLDS])


def _ar_mspd(errors: PoseErrors) -> float | None:
    return None if errors.mspd is None else average_recall(errors.mspd, BOP_MSPD_THRESHOLDS)


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
    Column("median_rotation_deg", "rotation °", 1, 1, "median", _median("rotation_deg")),
    Column("median_translation", "translation mm", 1000, 1, "median", _median("translation")),
    Column("p90_rotation_deg", "rotation 90 % °", 1, 1, "median", _p90("rotation_deg")),
    Column("p90_translation", "translation 90 % mm", 1000, 1, "median", _p90("translation")),
    Column("median_deviations", "error / stated", 1, 1, "median", _median("deviations")),
    Column("miss_rate", "missed %", 100, 1, "detection"),
    Column("average_precision", "AP[ADD-0.1d] %", 100, 1, "detection"),
    Column("precision", "precision %", 100, 1, "detection"),
    Column("false_positives", "false pos.", group="detection"),
)
"""The measures of a table, in order; ``object`` and ``method`` name its rows."""

_TOTALS: Final = ("num_instances", "false_positives")


def shown_columns(row: PoseRow, all_measures: bool = False) -> list[Column]:
    """Return what tells something of a row's object: symmetric measures where it has symmetries."""
    everything = all_measures or row.num_symmetries > 1
    return [column for column in COLUMNS if everything or column.group != "symmetry"]


def summarise(name: str, method: str, errors: PoseErrors) -> PoseRow:
    """Fill the measures that follow from the errors of N >= 1 poses alone."""
    measures: dict[str, Any] = {c.field: c.formula(errors) for c in COLUMNS if c.formula}
    return PoseRow(name, method, len(errors.add), num_symmetries=errors.num_symmetries, **measures)


def mean_row(rows: Sequence[PoseRow], method: str) -> PoseRow:
    """Average each measure over the objects that have it and at least one instance.

    Counts are totals over all objects. An object without ground truth takes no part in the means.
    The mean has symmetries where an object has.
    """
    mean = PoseRow(object="mean", method=method, num_instances=0)
    mean.num_symmetries = max((row.num_symmetries for row in rows), default=1)
    for column in COLUMNS:
        counted = column.field in _TOTALS
        values = [getattr(row, column.field) for row in rows if counted or row.num_instances]
        available = torch.tensor([v for v in values if v is not None], dtype=torch.float64)
        if len(available):
            value = int(available.sum()) if counted else float(available.mean())
            setattr(mean, column.field, value)
    return mean
