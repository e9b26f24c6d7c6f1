"""Which evidence makes poses precise: the outline on the picture, or a depth image.

To add one, write a function from parts to a :data:`Refiner` and one line in :data:`REFINERS`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import CameraMatrix
from dopepp.inference.refinement.depth import DepthRefiner, Refinement
from dopepp.inference.refinement.region import RegionRefiner
from dopepp.inference.refinement.starts import poses_of_four
from dopepp.inference.refinement.visible import Depth
from dopepp.parts.part import Part
from dopepp.recovery.detection import Detection

Refiner = Callable[[Detection, Picture, CameraMatrix, Depth | None], Refinement]
"""From a detection on a picture, with its depth where there is one, to the refined pose, or to the
given one and why it was kept."""


def make_refiner(refine: str, parts: Sequence[Part]) -> Refiner:
    """Return the refiner of that name for these parts.

    A :class:`UserError`: there is none of that name, its extra is not installed, or a part has no
    mesh that it could use.
    """
    if refine not in REFINERS:
        allowed = ", ".join(REFINERS)
        raise UserError(f"refine={refine!r}", f"{allowed}, or none", "choose one of them")
    return REFINERS[refine](parts)


def _by_region(parts: Sequence[Part]) -> Refiner:
    bare = [part.name for part in parts if part.mesh is None]
    if bare:
        raise UserError(
            f"refine=region and no mesh of {bare[0]}: an earlier version wrote this checkpoint",
            "a mesh of every part of the checkpoint",
            f"add --part {bare[0]}=FILE and its --unit (parts=… in Python), or train again",
        )
    cuboids = {part.name: part.cuboid for part in parts}
    refiners = {
        part.name: RegionRefiner(part.mesh.vertices, part.mesh.faces)
        for part in parts
        if part.mesh is not None
    }

    def refined(one: Detection, image: Picture, K: CameraMatrix, depth: Depth | None) -> Refinement:
        # One that was refined before comes from a tracker, which knows how far it may have moved.
        network = one.agreement is None
        elsewhere = partial(poses_of_four, cuboids[one.object], one.peaks, K) if network else None
        return refiners[one.object].refine(image, K, one.T_cam_obj, one.covariance, elsewhere)

    return refined


def _by_depth(parts: Sequence[Part]) -> Refiner:
    refiner = DepthRefiner(parts)

    def refined(one: Detection, image: Picture, K: CameraMatrix, depth: Depth | None) -> Refinement:
        if depth is None:
            return Refinement(one.T_cam_obj, reason="no depth image was given")
        return refiner.refine(one.object, one.T_cam_obj, depth, K, one.covariance)

    return refined


REFINERS: Final[dict[str, Callable[[Sequence[Part]], Refiner]]] = {
    "region": _by_region,
    "depth": _by_depth,
}
"""What ``refine=`` may name."""
