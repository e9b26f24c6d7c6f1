"""PoseResult: what was found on one picture, to look at, to save and to hand on.

All poses are in the camera's frame (:data:`FRAME`), and every output says so.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.core.files import PICTURES, check_target, write_picture
from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import CameraMatrix
from dopepp.geometry.rotation import matrix_to_quaternion
from dopepp.inference.overlay import Shape, draw_poses
from dopepp.recovery.detection import Detection

if TYPE_CHECKING:
    import pandas as pd

STEPS: Final = ("pre", "network", "decode", "refine")
"""What a picture's time is spent on: undistorting and resizing, the network, from its maps to
poses, and making these precise."""

FRAME: Final = "camera, OpenCV: x right, y down, z forward; metres"
"""The frame of all poses: ``T_cam_obj`` maps the mesh's frame into it."""


@dataclass(frozen=True, eq=False)
class PoseResult:
    """The parts on one picture."""

    image: Picture = field(repr=False)  # RGB, without lens distortion: keypoints and K refer to it
    K: CameraMatrix  # camera matrix, pixels
    # Best score first; of a tracker, in the order of their identities
    detections: Sequence[Detection]
    speed: Mapping[str, float]  # milliseconds spent in each of STEPS
    name: str  # the picture's file, or its source
    number: int = 0  # its place in the source, from 0
    # Seconds: of a video since its start, of a camera or a bag since 1970; None of a single
    # picture
    time: float | None = None
    # Of each detection, where a tracker follows them; else None
    identities: Sequence[int] | None = None
    # How each part is drawn, by its name
    shapes: Mapping[str, Shape] = field(default_factory=dict, repr=False)

    def plot(self) -> Picture:
        """Return the picture with every part's silhouette, cuboid, axes, name and score.

        A picture below 640 pixels in width is enlarged by a whole factor.
        """
        return draw_poses(self.image, self.K, self.detections, self._labels(), self.shapes)

    def save(self, path: Path | str) -> None:
        """Write :meth:`plot` as PNG or JPEG, as the suffix says; a UserError where it cannot."""
        check_target(Path(path), PICTURES)
        write_picture(Path(path), self.plot())

    def records(self) -> list[dict[str, Any]]:
        """Return each detection as plain values, with the picture's name and the poses' frame."""
        place: dict[str, Any] = {"image": self.name, "number": self.number}
        if self.time is not None:
            place["time"] = self.time
        return [
            {**place, **({} if identity is None else {"identity": identity}), **record(one)}
            for one, identity in self._identified()
        ]

    def to_json(self) -> str:
        """Return one line of JSON: the picture, its K, the speed and all detections."""
        place = {"image": self.name, "number": self.number, "time": self.time, "frame": FRAME}
        shared = {"image", "number", "time", "frame"}
        own = [{k: v for k, v in one.items() if k not in shared} for one in self.records()]
        speed = {step: round(ms, 3) for step, ms in self.speed.items()}
        content = {**place, "K": self.K.tolist(), "speed_ms": speed, "detections": own}
        return json.dumps(content, ensure_ascii=False, allow_nan=False)

    def to_dataframe(self) -> pd.DataFrame:
        """Return a table with a row a detection: place in metres, quaternion (w, x, y, z).

        A :class:`UserError`: pandas is not installed.
        """
        if find_spec("pandas") is None:
            got, fix = "to_dataframe() without the package pandas", "pip install pandas"
            raise UserError(got, "an installation with pandas", f"{fix}, or use to_json()")
        import pandas as pd

        columns = ["image", "number", "time", "identity", "object", "score", "frame", "x", "y",
                   "z", "qw", "qx", "qy", "qz", "reprojection_error_px"]  # fmt: skip
        rows = []
        for plain, one in zip(self.records(), self.detections, strict=True):
            place = dict(zip("xyz", one.T_cam_obj[:3, 3].tolist(), strict=True))
            turn = matrix_to_quaternion(one.T_cam_obj[:3, :3]).tolist()
            rows.append({**plain, **place, **dict(zip(columns[10:14], turn, strict=True))})
        return pd.DataFrame(rows, columns=columns)

    def _labels(self) -> list[str]:
        return [
            f"{one.object}{'' if identity is None else f' #{identity}'} {one.score:.2f}"
            for one, identity in self._identified()
        ]

    def _identified(self) -> list[tuple[Detection, int | None]]:
        identities: Sequence[int | None] = self.identities or [None] * len(self.detections)
        return list(zip(self.detections, identities, strict=True))


def record(one: Detection) -> dict[str, Any]:
    """Return a detection as plain values for JSON; what is no number (NaN) is None."""
    return {
        "object": one.object,
        "score": one.score,
        "frame": FRAME,
        "T_cam_obj": one.T_cam_obj.tolist(),
        "covariance": _plain(one.covariance),
        "keypoints": _plain(one.keypoints),
        "reprojection_error_px": _plain(np.array(one.reprojection_error_px)),
        "kept": one.kept or None,
    }


def speed_in_words(speed: Mapping[str, float]) -> str:
    """Say where a picture's time went, in one line."""
    return ", ".join(f"{step} {speed.get(step, 0.0):.1f}" for step in STEPS) + " ms"


def spent_between(before: Mapping[str, float], after: Mapping[str, float]) -> dict[str, float]:
    """Return the milliseconds of each step that were spent between two readings."""
    return {step: after[step] - before[step] for step in STEPS}


def _plain(values: np.ndarray[Any, Any]) -> Any:
    nested = values.tolist()
    if np.isfinite(values).all():
        return nested
    return _finite(nested)


def _finite(value: Any) -> Any:
    if isinstance(value, list):
        return [_finite(one) for one in value]
    return value if math.isfinite(value) else None
