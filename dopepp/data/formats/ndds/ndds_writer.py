"""Write NDDS: ``000000.png``, ``.depth.png``, ``.seg.png`` and, last, ``000000.json``.

Files follow the conventions of NDDS in ``docs/reference/formats_ndds.md``, and every annotation
repeats them under ``conventions``. In addition:

- ``fixed_model_transform`` is the identity times 100 (metres to centimetres).
- ``pose_transform`` has the rows ``P·Rᵀ`` and t, where P maps (x, y, z) to Unreal's (z, x, −y).
- ``bounding_box`` bounds the projected cuboid if no pixel is visible.
- ``projected_cuboid`` of a corner behind the camera is its projection through the camera's centre.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.core.files import encode_image, write_file
from dopepp.core.json import read_json
from dopepp.data.formats.invariants import Box
from dopepp.data.formats.ndds import CAMERA_SETTINGS, DEPTH_UNIT, OBJECT_SETTINGS
from dopepp.data.sample import Instance, Sample
from dopepp.geometry.camera import CameraMatrix, transform
from dopepp.geometry.cuboid import CENTROID
from dopepp.geometry.rotation import matrix_to_quaternion
from dopepp.parts.part import Part

CM: Final = 100.0  # centimetres per metre

UNREAL_AXES: Final = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""P of ``pose_transform``, from the readme of Falling Things."""

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
"""Fields of ``camera_data`` that images of one camera share."""

_FARTHEST_PX: Final = 1e6  # points near the camera's plane have huge projections

_DATA_SUFFIXES: Final = (".json", ".png", ".jpg", ".tar")
"""Suffixes of files that, like any subfolder, show that a folder holds other data."""


class NddsWriter:
    """A :class:`~dopepp.data.formats.Writer` of NDDS."""

    name = "ndds"
    chunk_size = 1000

    def __init__(self, root: Path, parts: Sequence[Part]) -> None:
        self._root = Path(root)
        self._parts = {part.name: part for part in parts}

    def prepare(self) -> None:
        """Write ``_object_settings.json``, idempotently.

        Raises:
            UserError: The folder holds other data, or settings of other parts.
        """
        path = self._root / OBJECT_SETTINGS
        settings = _encode(object_settings(list(self._parts.values())))
        present = sorted(self._root.glob("[!._]*")) if self._root.is_dir() else []
        foreign = [entry for entry in present if entry.is_dir() or entry.suffix in _DATA_SUFFIXES]
        if not path.is_file() and not foreign:
            write_file(path, settings)
        elif not path.is_file() or path.read_bytes() != settings:
            problem = f"{path} of other parts"
            if not path.is_file():
                problem = f"{foreign[0].name} in {self._root}, which is not from an NDDS writer"
            allowed = "an empty folder, or a folder begun with the same parts"
            raise UserError(problem, allowed, "pass another folder")

    def write(self, index: int, sample: Sample) -> None:
        """Write an item's images and then its annotation, which marks the item as complete."""
        # Values 1, 2, … on the visible pixels of the instances.
        kind = np.uint8 if len(sample.instances) <= np.iinfo(np.uint8).max else np.uint16
        segmentation = np.zeros(sample.image.shape[:2], kind)
        objects = []
        for number, instance in enumerate(sample.instances, 1):
            if instance.mask is not None:
                segmentation[instance.mask] = number
            cuboid = self._parts[instance.label].cuboid
            objects.append(object_record(number, instance, cuboid, sample.K))
        images = {".png": sample.image, ".seg.png": segmentation}
        if sample.depth is not None:
            steps = np.nan_to_num(np.rint(sample.depth.astype(np.float64) / DEPTH_UNIT))
            steps[(steps < 0) | (steps > np.iinfo(np.uint16).max)] = 0
            images[".depth.png"] = steps.astype(np.uint16)
        for suffix, image in images.items():
            write_file(self._path(index, suffix), encode_image(image))
        camera = camera_data(sample)
        record = {"conventions": CONVENTIONS, "camera_data": camera, "objects": objects}
        write_file(self._path(index, ".json"), _encode(record))

    def _path(self, index: int, suffix: str) -> Path:
        return self._root / f"{index:06d}{suffix}"

    def written(self, chunk: int) -> set[int]:
        """Return the indices of the chunk's items whose annotation is on disk."""
        indices = range(chunk * self.chunk_size, (chunk + 1) * self.chunk_size)
        return {index for index in indices if self._path(index, ".json").is_file()}

    def finalize(self, chunk: int, indices: Sequence[int]) -> None:
        """Write ``_camera_settings.json`` if the chunk's images share one camera.

        The file serves readers that ignore the intrinsics of annotations. A preset has one camera,
        so every chunk writes the same bytes.
        """
        records: list[Any] = [read_json(self._path(index, ".json")) for index in sorted(indices)]
        cameras = [record["camera_data"] for record in records]
        if cameras and all(cameras[0][n] == camera[n] for camera in cameras for n in CAMERA_FIELDS):
            write_file(self._root / CAMERA_SETTINGS, _encode(camera_settings(cameras[0])))


def object_settings(parts: Sequence[Part]) -> dict[str, Any]:
    """Return the content of ``_object_settings.json``: classes, ids from 1 and box sides in cm."""
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
    """Return the content of ``_camera_settings.json`` for an annotation's ``camera_data``."""
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
    """Return an annotation's ``camera_data``: image size, K in pixels, identity pose."""
    (fx, _, cx), (_, fy, cy), _ = np.asarray(sample.K, np.float64).tolist()
    return {
        "width": sample.size[0],
        "height": sample.size[1],
        # The camera frame serves as the world frame, since samples have no world frame.
        "location_worldframe": [0.0, 0.0, 0.0],
        "quaternion_xyzw_worldframe": [0.0, 0.0, 0.0, 1.0],
        "intrinsics": {"fx": fx, "fy": fy, "cx": cx, "cy": cy},
    }


def object_record(
    number: int, instance: Instance, cuboid_obj: Float[np.ndarray, "9 3"], K: CameraMatrix
) -> dict[str, Any]:
    """Return the entry in ``objects`` of instance ``number``, from 1, with the part's cuboid."""
    cuboid = transform(instance.T_cam_obj, cuboid_obj)
    rotation, location = instance.T_cam_obj[:3, :3], CM * instance.T_cam_obj[:3, 3]
    w, x, y, z = matrix_to_quaternion(rotation).tolist()
    pose = np.eye(4)
    pose[:3, :3], pose[3, :3] = UNREAL_AXES @ rotation.T, location
    # Projection through the camera's centre is finite even for a corner behind the camera.
    pixels = cuboid @ K.T
    depth = np.where(pixels[:, 2:] == 0, np.finfo(np.float64).tiny, pixels[:, 2:])
    with np.errstate(over="ignore"):
        projected = np.clip(pixels[:, :2] / depth, -_FARTHEST_PX, _FARTHEST_PX)
    visible_box = None if instance.mask is None else Box.of_mask(instance.mask)
    box = visible_box or Box.of_points(projected[:CENTROID])
    assert box is not None  # all corners have finite projections
    return {
        "class": instance.label,
        "name": f"{instance.label}_{number}",
        "instance_id": number,
        **({} if instance.mask is None else {"segmentation_id": number}),
        "visibility": float(instance.visible_fraction),
        "location": location.tolist(),
        "quaternion_xyzw": [x, y, z, w],
        "pose_transform": pose.tolist(),
        "cuboid_centroid": (CM * cuboid[CENTROID]).tolist(),
        "projected_cuboid_centroid": projected[CENTROID].tolist(),
        "bounding_box": {"top_left": [box.top, box.left], "bottom_right": [box.bottom, box.right]},
        "cuboid": (CM * cuboid[:CENTROID]).tolist(),
        "projected_cuboid": projected[:CENTROID].tolist(),
    }


def _encode(record: dict[str, Any]) -> bytes:
    return (json.dumps(record, indent=1, allow_nan=False) + "\n").encode()
