"""The one way from maps to poses; callbacks, estimators and exported runtimes all call it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dopepp.errors import UserError
from dopepp.geometry.camera import project_keypoints
from dopepp.geometry.cuboid import CENTROID, NUM_CORNERS, NUM_KEYPOINTS
from dopepp.maps.encode import MapGeometry
from dopepp.maps.peaks import Peaks, find_peaks
from dopepp.recovery.association import ChannelPeaks, KeypointGroup, associate
from dopepp.recovery.detection import Detection
from dopepp.recovery.solve import solve_group


@dataclass(frozen=True)
class RecoveryOptions:
    """Thresholds of the way from maps to poses; stored in the checkpoint.

    Attributes:
        sigma: Width of a perfect belief peak, cells.
        peak_threshold: Belief below which a corner's maximum is no peak.
        centroid_threshold: Belief below which there is no instance.
        max_angle_deg: Largest angle between a corner's vector and its centroid, degrees.
        max_peaks: Most peaks kept per channel.
        min_score: Detections below this score are dropped.
    """

    sigma: float = 1.0
    peak_threshold: float = 0.02
    centroid_threshold: float = 0.05
    max_angle_deg: float = 45.0
    max_peaks: int = 16
    min_score: float = 0.0

    def __post_init__(self) -> None:
        limits = {
            "sigma": (0.1, 100.0),
            "peak_threshold": (1e-6, 1.0),
            "centroid_threshold": (1e-6, 1.0),
            "max_angle_deg": (1e-3, 180.0),
            "max_peaks": (1, 1000),
            "min_score": (0.0, 1.0),
        }
        for name, (lowest, highest) in limits.items():
            value = getattr(self, name)
            if not lowest <= value <= highest:
                raise UserError(
                    f"recovery option {name}={value}", f"{lowest:g} to {highest:g}", "change it"
                )


def recover(
    belief: Float[Tensor, "beliefs height width"],
    field: Float[Tensor, "fields height width"],
    cuboids: Float[np.ndarray, "objects 9 3"],
    K: Float[np.ndarray, "3 3"],
    stride: int = 8,
    names: Sequence[str] | None = None,
    **options: float,
) -> list[Detection]:
    """Recover the poses of all objects on one image from its maps.

    Args:
        belief: 9·C belief maps, peaks of 1.
        field: 16·C vector-field maps.
        cuboids: Nine keypoints of each object, metres.
        K: Camera matrix of the network's input, pixels.
        stride: Input pixels per cell.
        names: The objects' names; their indices where not given.
        **options: Fields of :class:`RecoveryOptions`.

    Returns:
        Detections of all objects, best score first.
    """
    return recover_batch(
        belief[None], field[None], cuboids, np.asarray(K)[None], stride, names, **options
    )[0]


def recover_batch(
    belief: Float[Tensor, "batch beliefs height width"],
    field: Float[Tensor, "batch fields height width"],
    cuboids: Float[np.ndarray, "objects 9 3"],
    K: Float[np.ndarray, "batch 3 3"],
    stride: int = 8,
    names: Sequence[str] | None = None,
    **options: float,
) -> list[list[Detection]]:
    """Recover the poses on every image of a batch; see :func:`recover`.

    Peaks are found and read on the maps' device; only they come to the host.

    Raises:
        ValueError: The channels do not match the number of cuboids, maps differ in size, or there
            are not as many cameras as images or names as objects.
        UserError: An option is out of range.
    """
    chosen = RecoveryOptions(**options)  # type: ignore[arg-type]
    cuboids, K = np.asarray(cuboids, np.float64), np.asarray(K, np.float64)
    num_objects = len(cuboids)
    _check_shapes(belief, field, num_objects, K)
    geometry = MapGeometry(stride, chosen.sigma)
    peaks = find_peaks(belief, geometry, chosen.peak_threshold, int(chosen.max_peaks))
    channels = _read_channels(peaks, field, geometry)
    labels = [str(c) for c in range(num_objects)] if names is None else list(names)
    if len(labels) != num_objects:
        raise ValueError(f"{num_objects} objects need as many names, got {labels}")
    batch = []
    for image_channels, camera in zip(channels, K, strict=True):
        detections = [
            detection
            for c in range(num_objects)
            for detection in _recover_object(
                image_channels[c * NUM_KEYPOINTS : (c + 1) * NUM_KEYPOINTS],
                cuboids[c],
                camera,
                labels[c],
                chosen,
                stride,
            )
        ]
        batch.append(sorted(detections, key=lambda detection: -detection.score))
    return batch


def _check_shapes(
    belief: Float[Tensor, "batch beliefs height width"],
    field: Float[Tensor, "batch fields height width"],
    num_objects: int,
    K: Float[np.ndarray, "batch 3 3"],
) -> None:
    expected = (num_objects * NUM_KEYPOINTS, num_objects * NUM_CORNERS * 2)
    got = (belief.shape[1], field.shape[1])
    if got != expected or belief.shape[2:] != field.shape[2:] or len(belief) != len(field):
        raise ValueError(
            f"{num_objects} objects need {expected} belief and field channels of one size, "
            f"got {tuple(belief.shape)} and {tuple(field.shape)}"
        )
    if K.shape != (len(belief), 3, 3):
        raise ValueError(f"{len(belief)} images need as many camera matrices, got {K.shape}")


def _recover_object(
    channels: list[ChannelPeaks],
    cuboid: Float[np.ndarray, "9 3"],
    K: Float[np.ndarray, "3 3"],
    name: str,
    options: RecoveryOptions,
    stride: int,
) -> list[Detection]:
    """Recover all instances of one object."""
    strong = channels[CENTROID].score >= options.centroid_threshold
    centroid = ChannelPeaks(*(values[strong] for values in vars(channels[CENTROID]).values()))
    groups = associate(
        [*channels[:NUM_CORNERS], centroid], math.radians(options.max_angle_deg), float(stride)
    )
    detections = []
    for group in groups:
        detection = _detect(group, cuboid, K, name, options.sigma * stride)
        if detection is not None and detection.score >= options.min_score:
            detections.append(detection)
    return detections


def _detect(
    group: KeypointGroup,
    cuboid: Float[np.ndarray, "9 3"],
    K: Float[np.ndarray, "3 3"],
    name: str,
    target_sigma_px: float,
) -> Detection | None:
    """Turn one group into a detection where PnP finds a pose."""
    result = solve_group(group, cuboid, K, target_sigma_px)
    if result.T_cam_obj is None:
        return None
    return Detection(
        object=name,
        score=float(np.clip(group.score, 0.0, 1.0).mean()),
        T_cam_obj=result.T_cam_obj,
        keypoints=project_keypoints(cuboid, result.T_cam_obj, K),
        peaks=group.position,
        reprojection_error_px=result.reprojection_error_px,
    )


def _read_channels(
    peaks: Peaks, field: Float[Tensor, "batch fields height width"], geometry: MapGeometry
) -> list[list[ChannelPeaks]]:
    """Read the field under every corner peak and bring all peaks to the host in one transfer."""
    batch, num_channels, count = peaks.score.shape
    height, width = field.shape[-2:]
    num_objects = num_channels // NUM_KEYPOINTS
    cell = geometry.to_cells(peaks.position.nan_to_num()).round().long()
    index = cell[..., 1].clamp(0, height - 1) * width + cell[..., 0].clamp(0, width - 1)
    corner_index = index.view(batch, num_objects, NUM_KEYPOINTS, 1, count)[:, :, :NUM_CORNERS]
    vectors = field.float().reshape(batch, num_objects, NUM_CORNERS, 2, -1)
    read = vectors.gather(-1, corner_index.expand(-1, -1, -1, 2, -1)).transpose(-1, -2)
    toward = torch.zeros(
        batch, num_objects, NUM_KEYPOINTS, count, 2, dtype=read.dtype, device=read.device
    )
    toward[:, :, :NUM_CORNERS] = read
    columns = [
        peaks.found[..., None].float(),
        peaks.position,
        peaks.score[..., None],
        peaks.spread_px,
        toward.view(batch, num_channels, count, 2),
    ]
    table = torch.cat(columns, -1).double().cpu().numpy()
    return [[_channel(rows[rows[:, 0] > 0, 1:]) for rows in image] for image in table]


def _channel(rows: Float[np.ndarray, "peaks 7"]) -> ChannelPeaks:
    return ChannelPeaks(rows[:, :2], rows[:, 2], rows[:, 3:5], rows[:, 5:7])
