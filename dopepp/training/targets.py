"""Target maps of a batch, with a unique choice of pose for symmetric parts.

If a symmetry S maps the part onto itself, the poses T and T·S look alike, and a network trained on
both learns their mean. Targets therefore use the equivalent pose that is nearest to a reference
orientation relative to the line of sight. If another pose is almost as near, at the border of a
sector, the network may choose. Metrics use the labelled poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dopepp.core.errors import UserError
from dopepp.core.validation import Checked, Range
from dopepp.data.batch import PADDING, Batch
from dopepp.geometry.cuboid import CENTROID
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.maps.codec import Beliefs, Fields, MapGeometry, encode
from dopepp.metrics.functional.distances import project_points
from dopepp.metrics.pose import MIN_VISIBLE_FRACTION
from dopepp.models.heads import Stage
from dopepp.models.losses import MapLoss
from dopepp.parts.part import Part

Keypoints = Float[Tensor, "batch instances 9 2"]
Targets = tuple[Beliefs, Fields]  # Target belief maps and vector fields

FACING: Final = np.diag([1.0, -1.0, -1.0])  # Reference orientation: +z to the camera, +y up
UP: Final = np.array([0.0, -1.0, 0.0])  # Axis of a round part in the reference orientation


@dataclass(frozen=True)
class SymmetryOptions(Checked):
    """Options for targets of symmetric parts.

    Attributes:
        canonical: Whether targets use the equivalent pose nearest to the reference orientation.
        border_deg: Margin, degrees. An equivalent pose with a lower loss may be used if its angle
            to the reference is within this margin of the smallest angle.
    """

    canonical: bool = True
    border_deg: Annotated[float, Range(0, 360, "degrees")] = 30.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.border_deg > 0 and not self.canonical:
            problem = f"symmetry.border_deg={self.border_deg} with symmetry.canonical=false"
            fix = "set symmetry=none, or symmetry.canonical=true"
            raise UserError(problem, "symmetry.border_deg=0 with symmetry.canonical=false", fix)


def draw_maps(
    batch: Batch, keypoints: Keypoints, num_objects: int, geometry: MapGeometry
) -> Targets:
    """Encode keypoints (input pixels) as target maps, without instances less than 10 % visible."""
    height, width = batch.images.shape[-2:]
    map_size = height // geometry.stride, width // geometry.stride
    is_visible = batch.visible_fraction >= MIN_VISIBLE_FRACTION
    index = torch.where(is_visible, batch.object_index, PADDING)
    return encode(keypoints, index, num_objects, map_size, geometry)


def choose_keypoints(
    batch: Batch,
    stages: Sequence[Stage] | None,
    symmetry: SymmetryHandling,
    loss: MapLoss,
    geometry: MapGeometry,
) -> Keypoints:
    """Return the keypoints (input pixels) of each instance in the equivalent pose to train on.

    Among the allowed poses, the one whose own maps have the lowest loss against the network's
    ``stages`` is chosen; without stages, the pose nearest to the reference orientation.
    """
    choices, allowed = symmetry.equivalents(batch)
    if stages is None:
        return choices[:, :, 0]
    is_open = allowed[:, :, 1:].any(dim=-1) & (batch.visible_fraction >= MIN_VISIBLE_FRACTION)
    losses = torch.full(allowed.shape, torch.inf, device=allowed.device)
    index = (allowed & is_open[..., None]).nonzero()
    # As many maps as the batch has images at a time, for bounded memory.
    for start in range(0, len(index), len(batch)):
        rows, slots, numbers = index[start : start + len(batch)].unbind(-1)
        outputs = [(logits[rows].detach(), field[rows].detach()) for logits, field in stages]
        height, width = outputs[0][0].shape[-2:]
        keypoints, objects = choices[rows, slots, numbers, None], batch.object_index[rows, slots]
        maps = encode(keypoints, objects[:, None], symmetry.num_objects, (height, width), geometry)
        losses[rows, slots, numbers] = loss.per_image(outputs, *maps)
    best = losses.argmin(-1)[..., None, None, None].expand(*choices.shape[:2], 1, 9, 2)
    return choices.gather(2, best)[:, :, 0]


class Equivalents(NamedTuple):
    """Equivalent poses by increasing angle to the reference orientation."""

    keypoints: Float[Tensor, "batch instances choices 9 2"]  # input pixels
    allowed: Bool[Tensor, "batch instances choices"]  # may be used as targets; the first always


class SymmetryHandling:
    """Computes the poses that are equivalent to a label by symmetry; parts are in channel order."""

    def __init__(self, parts: Sequence[Part], options: SymmetryOptions) -> None:
        self.options, self.num_objects = options, len(parts)
        rows = [_symmetry_row(part) for part in parts]
        longest = max(len(row["transforms"]) for row in rows)
        for row in rows:
            count = len(row["transforms"])
            row["is_pose"] = np.arange(longest) < count
            padding = [np.eye(4)[None]] * (longest - count)
            row["transforms"] = np.concatenate([row["transforms"], *padding])
        self.active = options.canonical and any(row["symmetric"] for row in rows)
        self._tables = {
            name: torch.from_numpy(np.stack([row[name] for row in rows])) for name in rows[0]
        }

    def equivalents(self, batch: Batch) -> Equivalents:
        """Return the keypoints of all poses that are equivalent to the labels of a batch."""
        poses, angles = self._poses(batch)  # angles to the reference orientation
        order = angles.argsort(dim=-1, stable=True)
        nearest = angles.gather(-1, order)
        poses = poses.gather(2, order[..., None, None].expand_as(poses))
        index = batch.object_index.clamp(min=0)
        tables = self._on(batch.T_cam_obj.device)
        symmetric = tables["symmetric"][index] & (batch.object_index != PADDING)
        cuboids, K = tables["cuboids"][index][:, :, None], batch.K.double()[:, None, None]
        keypoints = project_points(poses[..., :3, :3], poses[..., :3, 3], cuboids, K)
        keypoints = keypoints.to(batch.keypoints.dtype)
        labelled = batch.keypoints[:, :, None].expand_as(keypoints)
        border = np.radians(self.options.border_deg)
        allowed = symmetric[..., None] & (nearest - nearest[..., :1] < border)
        allowed[..., 0] = True
        return Equivalents(
            torch.where(symmetric[..., None, None, None], keypoints, labelled), allowed
        )

    def _poses(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return T·S·C for each label T and discrete symmetry S, and its angle to the reference.

        C is the rotation about a round part's axis that minimises this angle. Poses have the shape
        (batch, instances, choices, 4, 4), angles (batch, instances, choices), radians, infinite in
        padding.
        """
        tables = self._on(batch.T_cam_obj.device)
        index = batch.object_index.clamp(min=0)
        poses = batch.T_cam_obj.double()[:, :, None] @ tables["transforms"][index]
        sight = _line_of_sight(batch.T_cam_obj.double(), tables["fixed"][index])
        towards = (sight @ tables["references"][index]).mT[:, :, None]
        axes = tables["axes"][index][:, :, None]
        about_axis = _best_axis_rotation(towards @ poses[..., :3, :3], axes)
        offset = tables["offsets"][index][:, :, None]
        shifts = offset - (about_axis @ offset[..., None])[..., 0]
        moved = poses[..., :3, 3] + (poses[..., :3, :3] @ shifts[..., None])[..., 0]
        rotations = poses[..., :3, :3] @ about_axis
        poses = poses.clone()
        poses[..., :3, :3], poses[..., :3, 3] = rotations, moved
        trace = (towards @ rotations).diagonal(dim1=-2, dim2=-1).sum(-1)
        angle = ((trace - 1) / 2).clamp(-1, 1).arccos()
        return poses, torch.where(tables["is_pose"][index], angle, torch.inf)

    def _on(self, device: torch.device) -> dict[str, Tensor]:
        """Return the rows of all parts (``_symmetry_row``), stacked by name, on a device."""
        if self._tables["axes"].device != device:
            self._tables = {name: table.to(device) for name, table in self._tables.items()}
        return self._tables


def _symmetry_row(part: Part) -> dict[str, np.ndarray]:
    """Return a part's row of the tables of symmetries, lengths in metres.

    Arrays by name: ``transforms`` (n, 4, 4), the discrete symmetries with the identity; ``axes``
    (3,), the unit axis of a round part, or zeros; ``offsets`` (3,), a point on this axis;
    ``references`` (3, 3), the reference orientation; ``fixed`` (3,), the point that all symmetries
    keep; ``cuboids`` (9, 3), the keypoints; ``symmetric``, whether the part has symmetries.
    """
    discrete = part.symmetries_discrete
    transforms = np.eye(4)[None]
    if discrete is not None and len(discrete):
        transforms = np.concatenate([transforms, discrete])
    axis, offset, reference = np.zeros(3), np.zeros(3), FACING
    orbit = transforms[:, :3, :3] @ part.cuboid[CENTROID] + transforms[:, :3, 3]
    fixed = orbit.mean(axis=0)  # symmetries only permute the orbit
    if part.symmetries_continuous:
        # A ball has further axes, but its maps are round for any choice.
        axis, offset = map(np.array, part.symmetries_continuous[0])
        axis = axis / np.linalg.norm(axis)
        reference = _rotation_between(FACING @ axis, UP) @ FACING
        fixed = offset + axis * (axis @ (fixed - offset))
    return {
        "transforms": transforms,
        "axes": axis,
        "offsets": offset,
        "references": reference,
        "fixed": fixed,
        "cuboids": part.cuboid,
        "symmetric": np.array(bool(part.symmetries_continuous) or len(transforms) > 1),
    }


def _rotation_between(start: np.ndarray, end: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """Return the rotation with the smallest angle that turns one unit vector to another."""
    across = np.cross(start, end)
    sine, cosine = np.linalg.norm(across), start @ end
    if sine < 1e-9:  # equal, or opposite (a half turn in the image plane)
        return np.eye(3) if cosine > 0 else np.diag([-1.0, -1.0, 1.0])
    return rotation_vector_to_matrix(across / sine * np.arctan2(sine, cosine))


def _line_of_sight(
    T_cam_obj: Float[Tensor, "batch instances 4 4"], fixed: Float[Tensor, "batch instances 3"]
) -> Float[Tensor, "batch instances 3 3"]:
    """Return the smallest rotation from the optical axis to the direction of a part's fixed point.

    A part that moves across the image and rotates by this matrix keeps its appearance.
    """
    centre = (T_cam_obj[..., :3, :3] @ fixed[..., None])[..., 0] + T_cam_obj[..., :3, 3]
    x, y, z = torch.nn.functional.normalize(centre, dim=-1).unbind(-1)
    # Rodrigues' formula for the axis (−y, x, 0); parts behind the camera (z = −1) are not drawn.
    c = 1 / (1 + z).clamp(min=1e-6)
    rows = [1 - c * x * x, -c * x * y, x, -c * x * y, 1 - c * y * y, y, -x, -y, z]
    return torch.stack(rows, -1).reshape(*x.shape, 3, 3)


def _best_axis_rotation(
    offset: Float[Tensor, "*batch 3 3"], axes: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation C about an axis for which offset·C is nearest to the identity.

    For A = offset and axis a, tr(A·C(θ)) = aᵀAa + c·cos θ + s·sin θ, with c = tr A − aᵀAa and
    s = tr(A·[a]×), is largest at θ = atan2(s, c). A zero axis (no symmetry) gives the identity.
    """
    x, y, z = axes.unbind(-1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)
    along = (axes[..., None, :] @ offset @ axes[..., None])[..., 0, 0]
    cosine = offset.diagonal(dim1=-2, dim2=-1).sum(-1) - along
    sine = (offset @ skew).diagonal(dim1=-2, dim2=-1).sum(-1)
    angle = torch.atan2(sine, cosine)[..., None, None]
    identity: Tensor = torch.eye(3, dtype=offset.dtype, device=offset.device)
    return identity + angle.sin() * skew + (1 - angle.cos()) * skew @ skew
