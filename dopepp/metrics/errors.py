"""Every error of one object's poses at once, and which measure each row needs of them.

To add an error, give :class:`PoseErrors` a field and :meth:`PoseErrors.of` its function.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dopepp.geometry.symmetry import symmetry_group
from dopepp.metrics.functional import (
    add,
    add_s,
    mspd,
    mssd,
    rotation_error_deg,
    translation_error,
)
from dopepp.parts.part import Part


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
        translation: Distance between the object frame's origins, metres.
    """

    add: Float[Tensor, "n"]
    add_s: Float[Tensor, "n"]
    mssd: Float[Tensor, "n"]
    mspd: Float[Tensor, "n"] | None
    rotation_deg: Float[Tensor, "n"]
    rotation_s_deg: Float[Tensor, "n"]
    translation: Float[Tensor, "n"]

    @classmethod
    def of(
        cls,
        part: Part,
        T_est: Float[Tensor, "n 4 4"],
        T_gt: Float[Tensor, "n 4 4"],
        K: Float[Tensor, "n 3 3"],
        width: Float[Tensor, "n"],
    ) -> PoseErrors:
        """Compute them.

        Args:
            part: The object.
            T_est: Estimated poses, metres; NaN for a miss.
            T_gt: True poses, metres.
            K: Camera matrices, pixels; NaN where unknown.
            width: Width of the images, pixels; NaN where unknown.
        """
        poses = T_est[:, :3, :3], T_est[:, :3, 3], T_gt[:, :3, :3], T_gt[:, :3, 3]
        points = torch.from_numpy(np.asarray(part.points, np.float64))
        vertices, group = extreme_points(part), symmetries(part)
        has_cameras = bool(K.isfinite().all() & width.isfinite().all())
        return cls(
            add=add(*poses, points),
            add_s=add_s(*poses, points),
            mssd=mssd(*poses, vertices, group),
            mspd=mspd(*poses, vertices, K, group) * (640 / width) if has_cameras else None,
            rotation_deg=rotation_error_deg(poses[0], poses[2]),
            rotation_s_deg=rotation_error_deg(poses[0], poses[2], group),
            translation=translation_error(poses[1], poses[3]),
        )


def symmetries(part: Part) -> Float[Tensor, "s 4 4"]:
    """Return the part's symmetry transforms, the identity first."""
    group = symmetry_group(part.symmetries_discrete, part.symmetries_continuous)
    return torch.from_numpy(group)


def extreme_points(part: Part) -> Float[Tensor, "v 3"]:
    """Return what MSSD and MSPD look at: the mesh's vertices as in BOP, else the ADD points.

    The surface samples of a CAD part miss its corners, where the largest distances are.
    """
    points = part.points if part.mesh is None else part.mesh.vertices
    return torch.from_numpy(np.asarray(points, np.float64))
