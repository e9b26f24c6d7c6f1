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
    """Where the poses come from that a part is gripped by: an arm of the experiment."""

    # `network`; `exact`, the simulation's truth; or `random`, any that the layout could have.
    kind: str = "network"
    # Whether the network's poses go through the calibrated matrices or the true ones.
    matrices: str = "calibrated"
    # By how much exact poses are off, in a random direction and about a random axis: millimetres
    # and degrees.
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
    """What is tried; plain values, to be sent to a process."""

    part: str = "pivconnector"  # a built-in part or a mesh file
    unit: str | None = None  # of the mesh file
    grasps: Path | None = None  # file of grasps; None takes the built-in part's
    network: str | None = None  # checkpoint; None where no source needs one
    refine: bool = True  # whether its poses are refined
    layout: str = "single"  # of `LAYOUTS`
    renderer: str = "raster"  # of the camera's pictures
    yaw_deg: float = 180.0  # how far parts are turned
    # On which faces they lie; see `Layout`.
    rest: str = "front"
    seed: int = 0
    sources: tuple[Source, ...] = (Source(),)


@dataclass(frozen=True)
class Record:
    """What came of one trial with one source of poses."""

    number: int  # the trial's, from 0; trials of one number are of one scene
    source: str  # the source's name
    off: float  # by how much the pose was put off on purpose, millimetres and degrees
    seen: bool  # whether there was a pose
    recognised: bool  # whether it was right: ADD below a tenth of the diameter
    # ADD of it, millimetres; NaN without one. Like the others in the arm's base frame, so that the
    # calibration's error is in it.
    add_mm: float
    # How far the part's origin was off, before the part was laid flat, millimetres.
    error_mm: float
    error_deg: float  # how it was turned, degrees
    caught: bool  # whether the part was held after lift and shake
    failure: str  # which of `FAILURES` it was; empty for none
    hand_eye_mm: float  # how far the calibration was off at the part's distance
    hand_eye_deg: float  # by how much it was turned
