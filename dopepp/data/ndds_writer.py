"""Write NDDS: ``000000.png``, ``.depth.png``, ``.seg.png`` and, last, ``000000.json``.

What NDDS documents is written as NDDS writes it, and every annotation repeats it under
``conventions``, which other readers ignore:

- Lengths are centimetres. The camera frame is OpenCV's. ``quaternion_xyzw`` is x, y, z, w.
- The object frame is the mesh frame, so ``fixed_model_transform`` is the identity times 100 (mesh
  metres to centimetres), transposed as NDDS transposes it.
- ``pose_transform`` is NDDS's: with R and t the pose, its rows are ``P·Rᵀ`` and t, where P maps
  (x, y, z) to (z, x, −y) (Unreal's axes). ``R = (first 3×3)ᵀ·P`` inverts it.
- ``bounding_box`` corners are (row, column): of the visible pixels or, without one, of the
  projected cuboid.
- ``projected_cuboid`` of a corner behind the camera is its projection through the camera's centre.
- ``visibility`` is the visible share of the whole silhouette; occlusion and border both count.
- ``.depth.png`` holds 0.1 mm a step as in FAT, 0 for unknown or beyond 6.55 m; ``.seg.png`` holds
  an object's ``segmentation_id``, 0 elsewhere.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Integer

from dopepp.data.json_file import read_json
from dopepp.data.ndds_files import CAMERA_SETTINGS, OBJECT_SETTINGS
from dopepp.data.ndds_images import DEPTH_UNIT
from dopepp.data.ndds_record import (
    CAMERA_FIELDS,
    CONVENTIONS,
    camera_data,
    camera_settings,
    object_record,
    object_settings,
    segmentation_map,
)
from dopepp.data.sample import Sample
from dopepp.drawing.png import write_png, write_whole
from dopepp.errors import UserError
from dopepp.parts.part import Part

_DATA_SUFFIXES: Final = (".json", ".png", ".jpg", ".tar")
"""A folder that holds such files, or folders, is somebody's data set."""


class NddsWriter:
    """Writes samples as one NDDS folder.

    Args:
        root: The folder.
        parts: The parts that the samples' instances may be of.
    """

    name = "ndds"
    chunk_size = 1000

    def __init__(self, root: Path, parts: Sequence[Part]) -> None:
        self._root = Path(root)
        self._parts = {part.name: part for part in parts}

    def prepare(self) -> None:
        """Write ``_object_settings.json``; idempotent.

        Raises:
            UserError: The folder holds something else.
        """
        path = self._root / OBJECT_SETTINGS
        settings = _encode(object_settings(list(self._parts.values())))
        if path.is_file():
            if path.read_bytes() != settings:
                raise self._occupied(f"{path} of other parts")
            return
        present = sorted(self._root.glob("[!._]*")) if self._root.is_dir() else []
        foreign = [path for path in present if path.is_dir() or path.suffix in _DATA_SUFFIXES]
        if foreign:
            got = f"{foreign[0].name} in {self._root}, which no NDDS writer prepared"
            raise self._occupied(got)
        write_whole(path, settings)

    def _occupied(self, got: str) -> UserError:
        return UserError(got, "an empty folder, or one begun with the same parts", "name another")

    def write(self, index: int, sample: Sample) -> None:
        """Write an item's images and then its annotation, which marks it as complete.

        Raises:
            KeyError: An instance is of none of the parts.
        """
        segmentation = segmentation_map(sample.instances, sample.image.shape[:2])
        record = {
            "conventions": CONVENTIONS,
            "camera_data": camera_data(sample),
            "objects": [
                object_record(number, instance, self._parts[instance.label].cuboid, sample.K)
                for number, instance in enumerate(sample.instances, 1)
            ],
        }
        write_png(self._path(index, ".png"), sample.image)
        if sample.depth is not None:
            steps = np.nan_to_num(np.rint(sample.depth.astype(np.float64) / DEPTH_UNIT))
            steps[(steps < 0) | (steps > np.iinfo(np.uint16).max)] = 0
            _write_map(self._path(index, ".depth.png"), steps.astype(np.uint16))
        _write_map(self._path(index, ".seg.png"), segmentation)
        write_whole(self._path(index, ".json"), _encode(record))

    def _path(self, index: int, suffix: str) -> Path:
        return self._root / f"{index:06d}{suffix}"

    def written(self, chunk: int) -> set[int]:
        """Return the chunk's indices with an annotation."""
        indices = range(chunk * self.chunk_size, (chunk + 1) * self.chunk_size)
        return {index for index in indices if self._path(index, ".json").is_file()}

    def seal(self, chunk: int, indices: Sequence[int]) -> None:
        """Write ``_camera_settings.json`` when the chunk's images share one camera.

        Every annotation has its own intrinsics; this file is for readers that look only here. A
        preset has one camera, so every chunk writes the same bytes.
        """
        cameras = []
        for index in sorted(indices):
            record: Any = read_json(self._path(index, ".json"))
            cameras.append(record["camera_data"])
            if any(cameras[0][name] != cameras[-1][name] for name in CAMERA_FIELDS):
                return
        if cameras:
            write_whole(self._root / CAMERA_SETTINGS, _encode(camera_settings(cameras[0])))


def _write_map(path: Path, image: Integer[np.ndarray, "height width"]) -> None:
    write_whole(path, cv2.imencode(".png", image)[1].tobytes())


def _encode(record: dict[str, Any]) -> bytes:
    return (json.dumps(record, indent=1, allow_nan=False) + "\n").encode()
