"""Accumulator of pose errors for validation, for evaluation and for the poses of other methods.

The state of the accumulator consists of poses, so all errors of an object are computed in a single
batch, and a new measure needs no new state.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Literal, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from dopepp.core.errors import UserError
from dopepp.drawing.curves import accuracy_figure
from dopepp.geometry.camera import CameraMatrix, Transform, transform
from dopepp.geometry.cuboid import CENTROID
from dopepp.metrics.functional import average_precision, match
from dopepp.metrics.references import REFERENCES, reference_rows
from dopepp.metrics.row import PoseErrors, PoseRow, mean_row, summarise
from dopepp.parts.part import Part

MEAN: Final = "mean"
MAX_MATCHING_RADIUS: Final = 0.1  # Largest matching radius of any part, metres
MIN_VISIBLE_FRACTION: Final = 0.1  # Smallest visible share of an evaluated instance's silhouette
CurveMeasure = Literal["add", "add_s", "mssd"]  # Error in metres, for accuracy-threshold curves

InstanceError = Literal["add", "add_s", "mssd", "rotation_deg", "rotation_s_deg", "translation"]
"""Error of every instance, degrees or metres."""

_WIDTH: Final = 81
_T_EST, _T_GT, _CAMERA = slice(1, 17), slice(17, 33), slice(33, 43)
_VISIBLE, _SCORE, _COVARIANCE = 43, 44, slice(45, 81)
"""State columns of an instance: object index, T_est, T_gt, K and image width, visible fraction,
score, covariance. Missed and unknown values are NaN."""


class PredictedPose(Protocol):
    """Attributes of a detection that :class:`PoseMetrics` reads."""

    @property
    def object(self) -> str:
        """Name of the part."""

    @property
    def score(self) -> float:
        """Confidence; higher scores are matched first."""

    @property
    def T_cam_obj(self) -> Transform:  # noqa: N802
        """Estimated rigid transform from object to camera frame, metres."""

    @property
    def covariance(self) -> Float[np.ndarray, "6 6"] | None:
        """Covariance as in :class:`~dopepp.recovery.detection.Detection`; None if unknown."""


class TruePose(Protocol):
    """Attributes of a ground-truth instance that :class:`PoseMetrics` reads."""

    label: str  # Name of the part
    T_cam_obj: Transform  # True pose, metres
    visible_fraction: float  # Visible share of the full silhouette, in [0, 1]
    wanted: bool | None  # Whether a list of targets names the instance; None without a list


def matching_radius(part: Part) -> float:
    """Return the largest distance between the centres of a detection and its instance, metres.

    The radius is half of the part's diameter and at most :data:`MAX_MATCHING_RADIUS`.
    """
    return min(MAX_MATCHING_RADIUS, float(part.diameter) / 2)


def assign(
    part: Part, detections: Sequence[PredictedPose], instances: Sequence[TruePose]
) -> Int[np.ndarray, "detections"]:
    """Match the detections of a part in an image with the part's instances, one to one.

    Cuboid centres within :func:`matching_radius` match, by
    :func:`~dopepp.metrics.functional.match`: first evaluated instances, then the others.

    Returns:
        Index of each detection's instance; −1 if it matches none.
    """
    # NaN poses match no instance. Infinite poses are set to NaN, because ∞ · 0 would warn.
    estimates = [np.asarray(d.T_cam_obj, np.float64) for d in detections]
    centre, radius = part.cuboid[CENTROID], matching_radius(part)
    predicted = [transform(np.where(np.isfinite(T), T, np.nan), centre) for T in estimates]
    true = [transform(np.asarray(i.T_cam_obj, np.float64), centre) for i in instances]
    offsets = np.reshape(predicted, (-1, 1, 3)) - np.reshape(true, (1, -1, 3))
    distances = torch.from_numpy(np.linalg.norm(offsets, axis=2))
    scores = torch.tensor([float(d.score) for d in detections], dtype=torch.float64)
    counts = np.array([is_evaluated(i) for i in instances], bool)
    assigned = np.full(len(detections), -1)
    for group in (counts, ~counts):
        left, numbers = np.flatnonzero(assigned < 0), np.flatnonzero(group)
        matches = match(scores[left], distances[left][:, numbers], radius).numpy()
        hit = matches >= 0
        assigned[left[hit]] = numbers[matches[hit]]
    return assigned


def is_evaluated(instance: TruePose) -> bool:
    """Return whether an instance is a listed target or, without a list, at least 10 % visible."""
    if instance.wanted is not None:
        return instance.wanted
    return instance.visible_fraction >= MIN_VISIBLE_FRACTION


class PoseMetrics(Metric):
    """Accumulates detections and ground truth, image by image, and computes a row per object.

    Instances of objects other than ``parts`` are ignored. ``method`` names the rows.

    Raises:
        UserError: There are no parts, or names are not distinct.
    """

    is_differentiable = False
    higher_is_better = None
    full_state_update = False

    poses: list[Tensor]
    false_positives: list[Tensor]
    num_images: Tensor

    def __init__(self, parts: Sequence[Part], method: str = "estimate", **kwargs: Any) -> None:
        super().__init__(**kwargs)
        names = [part.name for part in parts]
        if not names or len(set(names)) < len(names) or MEAN in names:
            allowed = f"one or more parts with distinct names other than {MEAN!r}"
            raise UserError(f"parts {names}", allowed, "add a part, or rename parts")
        self.parts = {part.name: part for part in parts}
        self.method = method
        self.set_dtype(torch.float64)
        # States are flat, because torchmetrics lets a rank without images send an empty vector.
        self.add_state("poses", default=[], dist_reduce_fx="cat")
        # Object index and score of every false positive.
        self.add_state("false_positives", default=[], dist_reduce_fx="cat")
        self.add_state("num_images", default=torch.tensor(0), dist_reduce_fx="sum")
        self._gathered: dict[str, EvaluatedInstances] = {}

    def update(
        self,
        detections: Sequence[PredictedPose],
        instances: Sequence[TruePose],
        K: CameraMatrix | None = None,
        width: float | None = None,
    ) -> None:
        """Add the detections and the ground truth of one image.

        MSPD needs K and the width of every image, pixels.

        Raises:
            UserError: A detection is of another object.
            ValueError: K or width is invalid, or given without the other.
        """
        for detection in detections:
            if detection.object not in self.parts:
                raise UserError(
                    f"a detection of {detection.object!r}",
                    f"detections of the evaluated parts {', '.join(self.parts)}",
                    "pass this part to PoseMetrics, or drop the detection",
                )
        camera = _camera(K, width)
        self.num_images += 1
        for index, part in enumerate(self.parts.values()):
            candidates = [d for d in detections if d.object == part.name]
            true = [i for i in instances if i.label == part.name]
            assigned = assign(part, candidates, true)
            table = np.full((len(true), _WIDTH), np.nan)
            table[:, 0], table[:, _CAMERA] = index, camera
            for row, instance in zip(table, true, strict=True):
                row[_T_GT], row[_VISIBLE] = np.ravel(instance.T_cam_obj), instance.visible_fraction
            for number, detection in zip(assigned, candidates, strict=True):
                if number >= 0:
                    table[number, _T_EST] = np.ravel(detection.T_cam_obj)
                    table[number, _SCORE] = detection.score
                    if detection.covariance is not None:
                        table[number, _COVARIANCE] = np.ravel(detection.covariance)
            self._keep(self.poses, table[[is_evaluated(instance) for instance in true]])
            strays = [(index, candidates[k].score) for k in np.flatnonzero(assigned < 0)]
            self._keep(self.false_positives, np.array(strays, np.float64))

    def _keep(self, state: list[Tensor], rows: Float[np.ndarray, "rows columns"]) -> None:
        """Append rows, flattened, to a state on the metric's device."""
        if rows.size:
            state.append(torch.from_numpy(rows.ravel()).to(self.device))

    def compute(self) -> dict[str, PoseRow]:
        """Return a row (:mod:`dopepp.metrics.row`) for each object, then their :data:`MEAN`.

        An object without evaluated instances has counts only; its other measures are None.
        """
        poses, false_positives = _table(self.poses, _WIDTH), _table(self.false_positives, 2)
        rows, num_images = {}, int(self.num_images)
        for index, (name, part) in enumerate(self.parts.items()):
            false = false_positives[false_positives[:, 0] == index, 1]
            table = poses[poses[:, 0] == index]
            self._gathered[name] = EvaluatedInstances(part, table, false, num_images)
            rows[name] = self._gathered[name].row(self.method)
        rows[MEAN] = mean_row(list(rows.values()), self.method)
        return rows

    def errors(self, name: str, measure: InstanceError = "add") -> Float[np.ndarray, "instances"]:
        """Return the error of every instance of a part, infinite for a miss.

        All ranks must call this method, like ``compute``.
        """
        self.compute()
        return np.asarray(getattr(self._gathered[name].errors, measure).numpy())

    def references(self) -> dict[str, dict[str, PoseRow]]:
        """Return, by reference, the rows of objects and :data:`MEAN` on the evaluated instances.

        All ranks must call this method, like ``compute``.
        """
        self.compute()
        table: dict[str, dict[str, PoseRow]] = {reference: {} for reference in REFERENCES}
        for name, part in self.parts.items():
            rows = reference_rows(part, self._gathered[name].T_gt.numpy())
            for reference, row in rows.items():
                table[reference][name] = row
        for reference, by_part in table.items():
            by_part[MEAN] = mean_row(list(by_part.values()), reference)
        return table

    def instances(self, name: str) -> EvaluatedInstances:
        """Return the evaluated instances of a part, in the order of :meth:`errors`.

        All ranks must call this method, like ``compute``.
        """
        self.compute()
        return self._gathered[name]

    def plot(self, measure: CurveMeasure = "add") -> tuple[Figure, Axes]:
        """Draw the accuracy-threshold curve of each object up to 0.1 m."""
        curves = {name: self.errors(name, measure) for name in self.parts}
        figure = accuracy_figure(curves, title=self.method)
        return figure, figure.axes[0]


class EvaluatedInstances:
    """All evaluated instances of one object, and the scores of its false positives.

    Attributes:
        T_gt: True poses, metres.
        K: Camera matrices, pixels; NaN if unknown.
        visible_fractions: Visible share of each silhouette, in [0, 1].
        scores: Score of each instance's prediction; NaN for a miss.
        errors: Pose errors of the instances, infinite for a miss.
        false_positives: Scores of the false positives.
        num_images: Number of images, with or without the object.
    """

    def __init__(
        self,
        part: Part,
        table: Float[Tensor, "n 81"],
        false_positives: Float[Tensor, "false_positives"],
        num_images: int,
    ) -> None:
        self.part, self.false_positives, self.num_images = part, false_positives, num_images
        T_est, self.T_gt = (table[:, columns].reshape(-1, 4, 4) for columns in (_T_EST, _T_GT))
        self.visible_fractions, self.scores = table[:, _VISIBLE], table[:, _SCORE]
        camera = table[:, _CAMERA]
        self.K = camera[:, :9].reshape(-1, 3, 3)
        covariance = table[:, _COVARIANCE].reshape(-1, 6, 6)
        self.errors = PoseErrors.of(part, T_est, self.T_gt, self.K, camera[:, 9], covariance)

    def row(self, method: str) -> PoseRow:
        """Return the row of the object; without evaluated instances, it has counts only."""
        errors, num_false = self.errors, len(self.false_positives)
        if len(errors.add) == 0:
            row = PoseRow(self.part.name, method, 0, num_symmetries=errors.num_symmetries)
        else:
            row = summarise(self.part.name, method, errors)
            matched = int(errors.add.isfinite().sum())
            row.miss_rate = 1 - matched / len(errors.add)
            row.matching_radius = matching_radius(self.part)
            if matched + num_false:
                row.precision = int(self._correct.sum()) / (matched + num_false)
            row.average_precision = self._average_precision()
        row.false_per_frame = num_false / max(self.num_images, 1)
        return row

    @property
    def _correct(self) -> Bool[Tensor, "n"]:
        """Return which instances have a pose with ADD(-S) below a tenth of the diameter."""
        return self.errors.add_or_s < 0.1 * self.part.diameter

    def _average_precision(self) -> float:
        """Return the average precision of detections; ADD(-S) below 0.1 diameters is correct."""
        hits = self._correct
        misses = ~hits & self.errors.add.isfinite()
        # Wrong predictions precede correct ones of equal score, so that AP does not depend on the
        # order of images and ranks.
        scores = torch.cat([self.false_positives, self.scores[misses], self.scores[hits]])
        correct = torch.arange(len(scores)) >= len(scores) - int(hits.sum())
        return average_precision(scores, correct, len(hits))


def _table(state: list[Tensor], width: int) -> Float[Tensor, "rows columns"]:
    """Join the chunks of a metric's state into a table with ``width`` columns."""
    flat = dim_zero_cat(state) if len(state) else torch.empty(0)
    return flat.detach().cpu().double().reshape(-1, width)


def _camera(K: CameraMatrix | None, width: float | None) -> Float[np.ndarray, "10"]:
    """Return K and the width as one row, NaN if neither is given."""
    if K is None and width is None:
        return np.full(10, np.nan)
    K = np.asarray(np.nan if K is None else K, np.float64)
    if K.shape != (3, 3) or not np.isfinite(K).all() or width is None or not 0 < width < np.inf:
        raise ValueError(f"K must be (3, 3), width positive, and both given, got {K} and {width}")
    return np.append(K.ravel(), float(width))
