"""The one accumulator of pose errors: validation, evaluation and any other method's poses.

It keeps the poses themselves, so that every error is computed once, in one batch per object, and
a new measure needs no new state.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Protocol

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from dopepp.drawing.curves import accuracy_figure
from dopepp.errors import UserError
from dopepp.geometry.camera import transform
from dopepp.geometry.cuboid import CENTROID
from dopepp.metrics.functional import (
    add,
    add_s,
    match,
    rotation_error_deg,
    translation_error,
)
from dopepp.metrics.references import REFERENCES, reference_rows
from dopepp.metrics.row import PoseRow, finite_median, mean_row, summarise
from dopepp.parts.part import Part

MEAN: Final = "mean"
MIN_VISIBLE_FRACTION: Final = 0.1
"""An instance counts when at least this share of its silhouette is visible."""

_WIDTH: Final = 1 + 16 + 16
"""One instance in the state: object index, T_est (NaN for a miss), T_gt."""


class PredictedPose(Protocol):
    """What the accumulator reads of a detection."""

    @property
    def object(self) -> str:
        """Name of the part."""

    @property
    def score(self) -> float:
        """Confidence; a better one is matched first."""

    @property
    def T_cam_obj(self) -> Float[np.ndarray, "4 4"]:  # noqa: N802
        """Estimated pose, metres."""


class TruePose(Protocol):
    """What the accumulator reads of a ground-truth instance."""

    @property
    def label(self) -> str:
        """Name of the part."""

    @property
    def T_cam_obj(self) -> Float[np.ndarray, "4 4"]:  # noqa: N802
        """True pose, metres."""

    @property
    def visible_fraction(self) -> float:
        """Visible share of the full silhouette, in [0, 1]."""


class PoseMetrics(Metric):
    """Accumulates detections against ground truth, image by image; sums up per object.

    Args:
        parts: The objects that are scored. Instances of other objects are not ground truth here;
            detections of other objects are an error.
        method: Name of what produces the poses, shown in the rows.
        **kwargs: As of :class:`torchmetrics.Metric`.

    Raises:
        UserError: There are no parts, or two share a name.
    """

    is_differentiable = False
    higher_is_better = None
    full_state_update = False

    poses: list[Tensor]
    false_positives: Tensor

    def __init__(self, parts: Sequence[Part], method: str = "estimate", **kwargs: Any) -> None:
        super().__init__(**kwargs)
        names = [part.name for part in parts]
        if not names or len(set(names)) < len(names) or MEAN in names:
            raise UserError(
                f"parts {names}", f"one or more parts of different names, none {MEAN!r}", "rename"
            )
        self.parts = {part.name: part for part in parts}
        self.method = method
        self.set_dtype(torch.float64)
        # Flat, because torchmetrics lets a rank without images send an empty vector.
        self.add_state("poses", default=[], dist_reduce_fx="cat")
        counts = torch.zeros(len(parts), dtype=torch.float64)
        self.add_state("false_positives", default=counts, dist_reduce_fx="sum")
        self._gathered: dict[str, _Errors] = {}

    def update(self, detections: Sequence[PredictedPose], instances: Sequence[TruePose]) -> None:
        """Add one image.

        Raises:
            UserError: A detection's object is none of the parts.
        """
        for detection in detections:
            if detection.object not in self.parts:
                raise UserError(
                    f"a detection of {detection.object!r}",
                    f"the scored parts {', '.join(self.parts)}",
                    "score it with a PoseMetrics that knows this part",
                )
        for index, part in enumerate(self.parts.values()):
            rows, num_false = _match_image(
                part.cuboid[CENTROID],
                [d for d in detections if d.object == part.name],
                [i for i in instances if i.label == part.name],
            )
            self.false_positives[index] += num_false
            if len(rows):
                state = np.insert(rows, 0, index, axis=1).ravel()
                self.poses.append(torch.from_numpy(state).to(self.device))

    def compute(self) -> dict[str, PoseRow]:
        """Return a row per object, then their :data:`MEAN`; see :mod:`dopepp.metrics.row`.

        An object without an instance that counts has None for everything but its counts.
        """
        state = dim_zero_cat(self.poses) if len(self.poses) else torch.empty(0)
        table = state.detach().cpu().double().reshape(-1, _WIDTH)
        rows = {}
        for index, (name, part) in enumerate(self.parts.items()):
            errors = _Errors.of(part, table[table[:, 0] == index, 1:])
            self._gathered[name] = errors
            rows[name] = errors.row(part, self.method, int(self.false_positives[index]))
        rows[MEAN] = mean_row(list(rows.values()), self.method)
        return rows

    def errors(self, name: str) -> Float[np.ndarray, "instances"]:
        """Return ADD of every instance of a part, metres, infinite where it was missed.

        Like ``compute``, all ranks must call it, unless they have called ``compute`` since the
        last update.
        """
        self.compute()
        return np.asarray(self._gathered[name].add.numpy())

    def references(self, seed: int = 0) -> dict[str, dict[str, PoseRow]]:
        """Return the reference rows on the instances seen: reference, then object or mean.

        All ranks must call it, as :meth:`errors`.
        """
        self.compute()
        by_part = [
            reference_rows(part, self._gathered[name].T_gt.numpy(), seed)
            for name, part in self.parts.items()
        ]
        table = {}
        for reference in REFERENCES:
            rows = [rows[reference] for rows in by_part]
            table[reference] = {row.object: row for row in rows}
            table[reference][MEAN] = mean_row(rows, reference)
        return table

    def plot(self) -> tuple[Figure, Axes]:
        """Draw each object's ADD accuracy-threshold curve up to 0.1 m."""
        curves = {name: self.errors(name) for name in self.parts}
        figure = accuracy_figure(curves, title=self.method)
        return figure, figure.axes[0]


class _Errors:
    """Errors of all instances of one object, infinite where missed."""

    def __init__(self, part: Part, T_est: Tensor, T_gt: Tensor) -> None:
        poses = T_est[:, :3, :3], T_est[:, :3, 3], T_gt[:, :3, :3], T_gt[:, :3, 3]
        points = torch.from_numpy(np.asarray(part.points, np.float64))
        self.T_gt = T_gt
        self.add = add(*poses, points)
        self.add_s = add_s(*poses, points)
        self.rotation_deg = rotation_error_deg(poses[0], poses[2])
        self.translation = translation_error(poses[1], poses[3])

    @classmethod
    def of(cls, part: Part, table: Float[Tensor, "instances 32"]) -> _Errors:
        return cls(part, *table.reshape(-1, 2, 4, 4).unbind(dim=1))

    def row(self, part: Part, method: str, false_positives: int) -> PoseRow:
        """Sum up; only the false positives of an object without ground truth mean anything."""
        if len(self.add) == 0:
            return PoseRow(part.name, method, num_instances=0, false_positives=false_positives)
        row = summarise(part.name, method, part.diameter, self.add, self.add_s, self.rotation_deg)
        matched = int(self.add.isfinite().sum())
        row.median_translation = finite_median(self.translation)
        row.miss_rate = 1 - matched / len(self.add)
        row.precision = matched / max(matched + false_positives, 1)
        row.false_positives = false_positives
        return row


def _match_image(
    centre: Float[np.ndarray, "3"],
    detections: Sequence[PredictedPose],
    instances: Sequence[TruePose],
) -> tuple[Float[np.ndarray, "counted 32"], int]:
    """Match one object on one image.

    Instances that count are matched first; predictions left over may then explain themselves by
    instances that do not, and are ignored; the rest are false positives.

    Returns:
        T_est (NaN where missed) and T_gt of each instance that counts, and the false positives.
    """
    counted = [i for i in instances if i.visible_fraction >= MIN_VISIBLE_FRACTION]
    hidden = [i for i in instances if not i.visible_fraction >= MIN_VISIBLE_FRACTION]
    matches = _match(centre, detections, counted)
    left = [d for d, instance in zip(detections, matches, strict=True) if instance < 0]
    num_false = int((_match(centre, left, hidden) < 0).sum())
    rows = np.full((len(counted), 2, 4, 4), np.nan)
    for row, instance in zip(rows, counted, strict=True):
        row[1] = instance.T_cam_obj
    for detection, index in zip(detections, matches, strict=True):
        if index >= 0:
            rows[index, 0] = detection.T_cam_obj
    return rows.reshape(-1, 32), num_false


def _match(
    centre: Float[np.ndarray, "3"],
    detections: Sequence[PredictedPose],
    instances: Sequence[TruePose],
) -> Tensor:
    """Match by the distance between the centres of the objects' cuboids."""
    # Infinity times zero would warn; as NaN throughout, such a pose just matches nothing.
    estimates = [np.asarray(d.T_cam_obj, np.float64) for d in detections]
    predicted = [transform(np.where(np.isfinite(T), T, np.nan), centre) for T in estimates]
    true = [transform(np.asarray(i.T_cam_obj, np.float64), centre) for i in instances]
    offsets = np.reshape(predicted, (-1, 1, 3)) - np.reshape(true, (1, -1, 3))
    scores = torch.tensor([float(d.score) for d in detections], dtype=torch.float64)
    return match(scores, torch.from_numpy(np.linalg.norm(offsets, axis=2)))
