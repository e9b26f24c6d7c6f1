"""ViewsResult: the parts that several views of a static scene show, in the world."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from dopepp.geometry.camera import Transform
from dopepp.inference.pose_result import PoseResult
from dopepp.inference.refinement.solver import PoseMatrix, Prior
from dopepp.recovery.detection import Detection

WORLD_FRAME: Final = "world, the frame of the camera poses; metres"
"""Frame of ``T_world_obj``, which maps from the mesh's frame to this frame."""

Status = Literal["supports", "hidden", "outside"]
"""What a view shows at a part's pose: the part, something else, or nothing, for the pose is not on
the picture."""


@dataclass(frozen=True, eq=False)
class ViewEvidence:
    """A part as one view shows it."""

    view: str  # name of the view
    status: Status
    probability: float  # that the pose is right, from this view alone
    detection: Detection  # the part's pose in this camera, for drawing


@dataclass(frozen=True, eq=False)
class WorldDetection:
    """A part found by several views."""

    object: str  # the part's name
    score: float  # confidence in the pose, in [0, 1]; as of Detection
    probability: float  # that ADD(-S) is below a tenth of the diameter, from all views
    T_world_obj: Transform
    # Covariance of a rotation vector about the object's origin (radians) and a shift (metres), in
    # world axes; it contains the errors of the camera poses
    covariance: PoseMatrix
    evidence: Sequence[ViewEvidence]  # of each view
    # Largest distance of a view's evidence from the others', or least distance of the joint pose
    # from a view's own, whichever is larger; standard deviations per √degree of freedom
    disagreement: float = 0.0

    @property
    def pose(self) -> Prior:
        """Pose and information in the world."""
        return Prior(self.T_world_obj, np.linalg.inv(self.covariance))

    @property
    def views(self) -> list[str]:
        """Names of the views that show the part."""
        return [item.view for item in self.evidence if item.status == "supports"]

    def to_record(self) -> dict[str, Any]:
        """Return plain values for JSON."""
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
    """The parts in a static scene."""

    detections: Sequence[WorldDetection]  # best score first
    findings: Sequence[str]  # contradictions between the views, and what to do about them
    views: Sequence[PoseResult]  # each view, with the detections that it shows
    weaker: Sequence[WorldDetection] = ()  # below the threshold, or contradicted; best score first
    joint_ms: float = 0.0  # time of association, joint refinement and verification, milliseconds

    @property
    def summary(self) -> str:
        """Number of parts, and in how many of the views each is."""
        count, shares = len(self.detections), [len(item.views) for item in self.detections]
        shown = ", ".join(f"{share} of {len(self.views)} views" for share in shares)
        return f"{count} part{'s' * (count > 1)}: {shown}" if count else "nothing found"

    def records(self) -> list[dict[str, Any]]:
        """Return each detection as plain values."""
        return [detection.to_record() for detection in self.detections]

    def to_json(self) -> str:
        """Return detections and findings as a line of JSON."""
        images = [view.name for view in self.views]
        content = {"images": images, "findings": list(self.findings), "detections": self.records()}
        return json.dumps(content, ensure_ascii=False, allow_nan=False)

    def save(self, folder: Path | str) -> None:
        """Write a picture with the drawn poses for each view, named like the view.

        Raises:
            UserError: A picture cannot be written.
        """
        for number, view in enumerate(self.views):
            stem = Path(view.name).stem or f"view_{number}"
            view.save(Path(folder) / f"{number}_{stem}.png")
