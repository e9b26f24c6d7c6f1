"""The records of NDDS's JSON files, as :mod:`dopepp.data.ndds_writer` documents them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Integer

from dopepp.data.ndds_images import DEPTH_UNIT
from dopepp.data.sample import Instance, Sample
from dopepp.geometry.camera import transform
from dopepp.geometry.cuboid import CENTROID
from dopepp.geometry.rotation import matrix_to_quaternion
from dopepp.parts.part import Part

CM: Final = 100.0
"""Centimetres per metre."""

UNREAL_AXES: Final = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""P of ``pose_transform``: from the readme of Falling Things."""

CONVENTIONS: Final = {
    "length_unit": "cm",
    "quaternion_xyzw": "x, y, z, w",
    "camera_axes": "x right, y down, z forward",
    "object_frame": "the mesh's own",
    "bounding_box": "row, column",
    "visibility_counts_truncation": True,
    "segmentation": "segmentation_id",
    "depth_unit_m": DEPTH_UNIT,
}

CAMERA_FIELDS: Final = ("width", "height", "intrinsics")
"""What two images of one camera share in ``camera_data``."""

_FARTHEST_PX: Final = 1e6
"""Projections of points beside the camera are cut off here."""


def object_settings(parts: Sequence[Part]) -> dict[str, Any]:
    """Return ``_object_settings.json``: the classes, their ids from 1 and boxes (x, y, z, cm)."""
    return {
        "exported_object_classes": [part.name for part in parts],
        "exported_objects": [
            {
                "class": part.name,
                "segmentation_class_id": number,
                "fixed_model_transform": np.diag([CM, CM, CM, 1.0]).tolist(),
                "cuboid_dimensions": (CM * np.ptp(part.cuboid, axis=0)).tolist(),
            }
            for number, part in enumerate(parts, 1)
        ],
    }


def camera_settings(camera: dict[str, Any]) -> dict[str, Any]:
    """Return ``_camera_settings.json`` of one camera, given as an annotation's ``camera_data``."""
    width, height, values = (camera[name] for name in CAMERA_FIELDS)
    return {
        "camera_settings": [
            {
                "name": "camera",
                "horizontal_fov": float(np.rad2deg(2 * np.arctan(width / 2 / values["fx"]))),
                "intrinsic_settings": {"resX": width, "resY": height, **values, "s": 0},
                "captured_image_size": {"width": width, "height": height},
            }
        ]
    }


def camera_data(sample: Sample) -> dict[str, Any]:
    """Return an annotation's ``camera_data``."""
    K = np.asarray(sample.K, np.float64)
    return {
        "width": sample.size[0],
        "height": sample.size[1],
        # The camera frame is the world frame: a sample knows no other.
        "location_worldframe": [0.0, 0.0, 0.0],
        "quaternion_xyzw_worldframe": [0.0, 0.0, 0.0, 1.0],
        "intrinsics": dict(
            zip(("fx", "fy", "cx", "cy"), K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), strict=True)
        ),
    }


def object_record(
    number: int,
    instance: Instance,
    cuboid_obj: Float[np.ndarray, "9 3"],
    K: Float[np.ndarray, "3 3"],
) -> dict[str, Any]:
    """Return one of an annotation's ``objects``.

    Args:
        number: Its number on the image, from 1: its id and its value in ``.seg.png``.
        instance: The instance.
        cuboid_obj: Its part's cuboid, metres, object frame.
        K: Camera matrix, pixels.
    """
    cuboid = transform(instance.T_cam_obj, cuboid_obj)
    rotation, location = instance.T_cam_obj[:3, :3], CM * instance.T_cam_obj[:3, 3]
    w, x, y, z = matrix_to_quaternion(rotation).tolist()
    pose = np.eye(4)
    pose[:3, :3], pose[3, :3] = UNREAL_AXES @ rotation.T, location
    projected = _projected(cuboid, K)
    segmented = {} if instance.mask is None else {"segmentation_id": number}
    return {
        "class": instance.label,
        "name": f"{instance.label}_{number}",
        "instance_id": number,
        **segmented,
        "visibility": float(instance.visible_fraction),
        "location": location.tolist(),
        "quaternion_xyzw": [x, y, z, w],
        "pose_transform": pose.tolist(),
        "cuboid_centroid": (CM * cuboid[CENTROID]).tolist(),
        "projected_cuboid_centroid": projected[CENTROID].tolist(),
        "bounding_box": _bounding_box(instance.mask, projected[:CENTROID]),
        "cuboid": (CM * cuboid[:CENTROID]).tolist(),
        "projected_cuboid": projected[:CENTROID].tolist(),
    }


def _projected(
    points_cam: Float[np.ndarray, "9 3"], K: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "9 2"]:
    """Project through the camera's centre: a point behind it has a finite place too."""
    pixels = points_cam @ K.T
    depth = np.where(pixels[:, 2:] == 0, np.finfo(np.float64).tiny, pixels[:, 2:])
    with np.errstate(over="ignore"):
        return np.asarray(np.clip(pixels[:, :2] / depth, -_FARTHEST_PX, _FARTHEST_PX))


def _bounding_box(
    mask: Bool[np.ndarray, "height width"] | None, corners_px: Float[np.ndarray, "8 2"]
) -> dict[str, list[float]]:
    if mask is None or not mask.any():
        (left, top), (right, bottom) = corners_px.min(axis=0), corners_px.max(axis=0)
    else:
        top, bottom = np.flatnonzero(mask.any(axis=1))[[0, -1]]
        left, right = np.flatnonzero(mask.any(axis=0))[[0, -1]]
    corners = {"top_left": (top, left), "bottom_right": (bottom, right)}
    return {name: [float(row), float(column)] for name, (row, column) in corners.items()}


def segmentation_map(
    instances: Sequence[Instance], shape: tuple[int, int]
) -> Integer[np.ndarray, "height width"]:
    """Return 1, 2, … where the first, second, … instance is visible, 0 elsewhere."""
    labels = np.zeros(shape, np.uint8 if len(instances) <= np.iinfo(np.uint8).max else np.uint16)
    for number, instance in enumerate(instances, 1):
        if instance.mask is not None:
            labels[instance.mask] = number
    return labels
