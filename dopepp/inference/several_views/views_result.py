"""ViewsResult: the parts detected in several views of a static scene, with poses in the world."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import cv2
import numpy as np

from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import Step, Transform
from dopepp.inference.pose_result import PoseResult
from dopepp.inference.refinement.solver import PoseMatrix, Prior
from dopepp.recovery.detection import Detection

WORLD_FRAME: Final = "world, the frame of the camera poses; metres"
"""Frame of ``T_world_obj``, which maps from the mesh's frame to this frame."""

Status = Literal["supports", "hidden", "outside"]
"""``supports``: the view shows the part at its pose. ``hidden``: the view shows something else at
this position. ``outside``: the pose is outside the image."""


@dataclass(frozen=True, eq=False)
class ViewEvidence:
    """Visibility and probability of a part's pose in one view."""

    view: str  # name of the view
    status: Status
    probability: float  # probability that the pose is correct, from this view alone
    detection: Detection  # the part's pose in this camera, for drawing


@dataclass(frozen=True, eq=False)
class WorldDetection:
    """A part detected in several views of a scene."""

    object: str  # name of the part
    score: float  # confidence in the pose, in [0, 1]; see Detection
    probability: float  # probability that ADD(-S) is below a tenth of the diameter, from all views
    T_world_obj: Transform
    # Covariance of a rotation vector about the object's origin (radians) and a shift (metres), in
    # world axes; it includes the errors of the camera poses
    covariance: PoseMatrix
    evidence: Sequence[ViewEvidence]  # one entry per view
    # Mahalanobis distance per √degree of freedom, the larger of two distances: the largest between
    # the measurements of one view and of all other views, and the smallest between the joint pose
    # and the pose from a single view
    disagreement: float = 0.0

    @property
    def pose(self) -> Prior:
        """Pose in the world, with its information (inverse covariance)."""
        return Prior(self.T_world_obj, np.linalg.inv(self.covariance))

    @property
    def agreement(self) -> float:
        """Mean agreement of the outline in the views that show the part; 0 if none does."""
        shown = [item.detection for item in self.evidence if item.status == "supports"]
        return float(np.mean([item.agreement or 0.0 for item in shown])) if shown else 0.0

    @property
    def views(self) -> list[str]:
        """Names of the views that show the part."""
        return [item.view for item in self.evidence if item.status == "supports"]

    def to_record(self) -> dict[str, Any]:
        """Return the detection as a dictionary for JSON (metres, radians)."""
        return {
            "object": self.object,
            "score": self.score,
            "probability": self.probability,
            "frame": WORLD_FRAME,
            "T_world_obj": self.T_world_obj.tolist(),
            "covariance": self.covariance.tolist(),
            "views": [
                {
                    "image": item.view,
                    "status": item.status,
                    "probability": item.probability,
                    "T_cam_obj": item.detection.T_cam_obj.tolist(),
                }
                for item in self.evidence
            ],
        }


@dataclass(frozen=True, eq=False)
class ViewsResult:
    """Parts detected in several views of a static scene."""

    detections: Sequence[WorldDetection]  # best score first; from a tracker, sorted by identity
    findings: Sequence[str]  # contradictions between the views, and how to resolve them
    views: Sequence[PoseResult]  # result of each view, with the detections that it supports
    # Detections below the threshold or rejected by a contradiction, best score first
    weaker: Sequence[WorldDetection] = ()
    identities: Sequence[int] | None = None  # tracked instances; None without a tracker
    # Motion of each tracked part per set of images, in world axes; see Track
    velocities: Sequence[Step] | None = None
    number: int | None = None  # index of the set of images, from 0; None without a tracker

    @property
    def num_weaker(self) -> int:
        """Number of weaker detections."""
        return len(self.weaker)

    @property
    def summary(self) -> str:
        """Number of parts, and the number of views that show each part, in words."""
        count, shares = len(self.detections), [len(item.views) for item in self.detections]
        shown = ", ".join(f"{share} of {len(self.views)} views" for share in shares)
        return f"{count} part{'s' * (count > 1)}: {shown}" if count else "nothing found"

    def plot(self) -> RGBImage:
        """Return the drawn images of all views side by side, each as high as the first."""
        images = [view.plot() for view in self.views]
        height = images[0].shape[0]
        sizes = [(round(image.shape[1] * height / image.shape[0]), height) for image in images]
        resized = [cv2.resize(image, size) for image, size in zip(images, sizes, strict=True)]
        return np.ascontiguousarray(np.hstack(resized))

    def records(self) -> list[dict[str, Any]]:
        """Return each detection as a dictionary for JSON, with number and identity if tracked."""
        records = [detection.to_record() for detection in self.detections]
        if self.identities is None:
            return records
        pairs = zip(self.identities, records, strict=True)
        shared = {"number": self.number}
        return [{**shared, "identity": identity, **record} for identity, record in pairs]

    def to_json(self) -> str:
        """Return image names, contradictions ("findings") and detections as a line of JSON."""
        images, findings = [view.name for view in self.views], list(self.findings)
        number = {} if self.number is None else {"number": self.number}
        content = {**number, "images": images, "findings": findings, "detections": self.records()}
        return json.dumps(content, ensure_ascii=False, allow_nan=False)

    def save(self, folder: Path | str) -> None:
        """Draw the poses on the image of each view, and write the images to a folder.

        Raises:
            UserError: An image cannot be written.
        """
        for number, view in enumerate(self.views):
            stem = Path(view.name).stem or f"view_{number}"
            view.save(Path(folder) / f"{number}_{stem}.png")
