"""What is tried, by whose poses, and what came of it: plain values, to be sent to a process."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

BLOCK: Final = 50  # trials after which another robot is calibrated, as Table 9 counts them
EXACT: Final = "exact poses"

FAILURES: Final = ("not seen", "wrong pose", "no plan", "collided", "slipped")


@dataclass(frozen=True)
class Source:
    """Where the poses come from that a part is gripped by: an arm of the experiment.

    Attributes:
        kind: ``network``; ``exact``, the simulation's truth; or ``random``, any that the layout
            could have.
        matrices: Whether the network's poses go through the calibrated matrices or the true ones.
        error: By how much exact poses are off, in a random direction and about a random axis:
            millimetres and degrees.
    """

    kind: str = "network"
    matrices: str = "calibrated"
    error: tuple[float, float] = (0.0, 0.0)

    @property
    def name(self) -> str:
        """How reports call it."""
        if any(self.error):
            return f"{EXACT}, off by {self.error[0]:g} mm and {self.error[1]:g}°"
        true = ", true matrices" if self.matrices == "true" else ""
        return {"network": "network", "exact": EXACT, "random": "random poses"}[self.kind] + true


@dataclass(frozen=True)
class Task:
    """What is tried; plain values, to be sent to a process.

    Attributes:
        part: A built-in part or a mesh file, and
        unit: the file's.
        grasps: File of grasps; None takes the built-in part's.
        network: Checkpoint; None where no source needs one.
        refine: Whether its poses are refined.
        layout: Of :data:`~dopepp.robot.grasping.layouts.LAYOUTS`.
        renderer: Of the camera's pictures.
        yaw_deg: How far parts are turned, and
        rest: on which faces they lie; see :class:`~dopepp.robot.grasping.layouts.Layout`.
    """

    part: str = "pivconnector"
    unit: str | None = None
    grasps: Path | None = None
    network: str | None = None
    refine: bool = True
    layout: str = "single"
    renderer: str = "raster"
    yaw_deg: float = 180.0
    rest: str = "front"
    seed: int = 0
    sources: tuple[Source, ...] = (Source(),)


@dataclass(frozen=True)
class Record:
    """What came of one trial with one source of poses.

    Attributes:
        number: The trial's, from 0; trials of one number are of one scene.
        source: The source's name.
        off: By how much the pose was put off on purpose, millimetres and degrees.
        seen: Whether there was a pose.
        recognised: Whether it was right: ADD below a tenth of the diameter.
        add_mm: ADD of it, millimetres; NaN without one. Like the others in the arm's base frame,
            so that the calibration's error is in it.
        error_mm: How far the part's origin was off, before the part was laid flat, millimetres, and
        error_deg: how it was turned, degrees.
        caught: Whether the part was held after lift and shake.
        failure: Which of :data:`FAILURES` it was; empty for none.
        hand_eye_mm: How far the calibration was off at the part's distance, and
        hand_eye_deg: by how much it was turned.
    """

    number: int
    source: str
    off: float
    seen: bool
    recognised: bool
    add_mm: float
    error_mm: float
    error_deg: float
    caught: bool
    failure: str
    hand_eye_mm: float
    hand_eye_deg: float
