"""The result of a method on a test set, as stored in ``metrics.json``.

A report holds a fingerprint of its test images, because results on different images cannot be
compared.
"""

from __future__ import annotations

import hashlib
import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from dopepp.data.sample import Sample
from dopepp.experiment.results.frame import shown_rows
from dopepp.metrics.pose import MEAN, MIN_VISIBLE_FRACTION
from dopepp.metrics.row import PoseRow, mean_row
from dopepp.parts.part import Parts

Errors = dict[str, Float[np.ndarray, "instances"]]  # by object; infinite for missed instances


@dataclass(frozen=True)
class Cost:
    """Cost of a method; None if unknown."""

    parameters: int | None = None  # trained
    gmacs: float | None = None  # 10⁹ multiply-accumulates for one image of the input size
    ms_per_frame: float | None = None  # median time from image to poses, milliseconds


@dataclass
class Report:
    """Result of a method on a test set."""

    name: str
    rows: dict[str, PoseRow]  # by object, followed by their mean
    references: dict[str, dict[str, PoseRow]]  # of guesses that ignore the image's content
    errors: Errors  # ADD of every instance, metres
    cost: Cost
    num_images: int
    details: dict[str, Any] = field(default_factory=dict)  # further values for metrics.json
    rotation_deg: Errors = field(default_factory=dict)  # rotation error of every instance
    diameters: dict[str, float] = field(default_factory=dict)  # metres
    test_set: str = ""  # fingerprint; empty if unknown
    refined: Report | None = None  # result of the refined poses

    @property
    def mean(self) -> PoseRow:
        """Row with the mean of each measure over the objects."""
        return self.rows[MEAN]

    @property
    def tables(self) -> dict[str, list[PoseRow]]:
        """Rows by object or ``mean``: of the method, of its refined poses, and of references."""
        refined = [] if self.refined is None else [self.refined.rows]
        return {
            name: [row, *(rows[name] for rows in (*refined, *self.references.values()))]
            for name, row in shown_rows(self.rows).items()
        }

    def to_record(self) -> dict[str, Any]:
        """Return the content of ``metrics.json``."""
        return {
            "name": self.name,
            "num_images": self.num_images,
            "objects": {name: asdict(row) for name, row in self.rows.items()},
            "references": {
                reference: {name: asdict(row) for name, row in rows.items()}
                for reference, rows in self.references.items()
            },
            "add": _listed(self.errors),
            "rotation_deg": _listed(self.rotation_deg),
            "diameters": self.diameters,
            "test_set": self.test_set,
            "cost": asdict(self.cost),
            **({} if self.refined is None else {"refined": self.refined.to_record()}),
            **self.details,
        }

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Report:
        """Restore a report from the content of ``metrics.json``."""
        refined = record.get("refined")
        report = cls(
            name=record["name"],
            rows=_rows(record["objects"]),
            references={name: _rows(rows) for name, rows in record["references"].items()},
            errors=_unlisted(record["add"]),
            cost=Cost(**record["cost"]),
            num_images=record["num_images"],
            rotation_deg=_unlisted(record["rotation_deg"]),
            diameters=dict(record["diameters"]),
            test_set=record["test_set"],
            refined=None if refined is None else cls.from_record(refined),
        )
        fields = report.to_record()
        report.details = {key: value for key, value in record.items() if key not in fields}
        return report

    @classmethod
    def joined(cls, reports: Sequence[Report]) -> Report:
        """Join the results of networks that differ only in their parts into one report."""
        reports = sorted(reports, key=lambda report: list(report.rows))
        first = reports[0]
        times = [time for report in reports if (time := report.cost.ms_per_frame) is not None]
        refined = [report.refined for report in reports if report.refined is not None]
        return replace(
            first,
            rows=_joined_rows([report.rows for report in reports]),
            references={
                reference: _joined_rows([report.references[reference] for report in reports])
                for reference in first.references
            },
            errors={name: e for report in reports for name, e in report.errors.items()},
            cost=replace(first.cost, ms_per_frame=statistics.mean(times) if times else None),
            num_images=sum(report.num_images for report in reports),
            rotation_deg={n: e for report in reports for n, e in report.rotation_deg.items()},
            diameters={name: d for report in reports for name, d in report.diameters.items()},
            test_set=" ".join(report.test_set for report in reports),
            refined=cls.joined(refined) if len(refined) == len(reports) else None,
        )


def _rows(record: Mapping[str, Mapping[str, Any]]) -> dict[str, PoseRow]:
    return {name: PoseRow(**row) for name, row in record.items()}


def _joined_rows(groups: Sequence[Mapping[str, PoseRow]]) -> dict[str, PoseRow]:
    """Join the rows of several tables of different objects, and recompute the mean."""
    rows = {name: row for group in groups for name, row in group.items() if name != MEAN}
    return {**rows, MEAN: mean_row(list(rows.values()), groups[0][MEAN].method)}


def _listed(errors: Errors) -> dict[str, list[float | None]]:
    """Convert errors to JSON values; missed instances become null."""
    return {
        name: [float(error) if np.isfinite(error) else None for error in values]
        for name, values in errors.items()
    }


def _unlisted(record: Mapping[str, Sequence[float | None]]) -> Errors:
    """Undo :func:`_listed`."""
    return {
        name: np.array([np.inf if error is None else error for error in values], np.float64)
        for name, values in record.items()
    }


class Fingerprint:
    """Hash over the objects of a test set and the name, camera and ground truth of every image.

    Pixels are excluded because they may differ slightly between machines. The name of the source
    distinguishes renderers; the covered share distinguishes shaded images.
    """

    def __init__(self, parts: Parts) -> None:
        self._hash = hashlib.sha256()
        self._add(sorted((part.name, part.mesh_hash) for part in parts))

    def add(self, sample: Sample) -> None:
        """Add an image's source, name, size, camera and true poses to the hash."""
        truths = []
        for instance in sample.instances:
            counts = bool(instance.visible_fraction >= MIN_VISIBLE_FRACTION)
            covered = round(instance.masked_fraction, 2)
            truths.append([instance.label, _rounded(instance.T_cam_obj), counts, covered])
        self._add([sample.source, sample.key, sample.size, _rounded(sample.K), truths])

    def hexdigest(self) -> str:
        """Return the hash of all images added so far."""
        return self._hash.hexdigest()

    def _add(self, facts: object) -> None:
        self._hash.update(json.dumps(facts).encode() + b"\n")


def _rounded(values: Float[np.ndarray, "rows columns"]) -> list[float]:
    """Round pixels or metres, whose further digits differ between machines; avoid −0."""
    return [float(value) + 0.0 for value in np.round(values, 6).ravel()]
