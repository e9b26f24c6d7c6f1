"""YCB-Video in its own layout: ``data/SSSS/NNNNNN-*`` (real) and ``data_syn/NNNNNN-*`` (synthetic).

One source reads one of the two subsets; :mod:`dopepp.data.sources.hybrid` mixes them.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dopepp.core.errors import UserError
from dopepp.data.formats.ycb_video.frame import (
    FOLDERS,
    Subset,
    read_classes,
    read_frame,
    read_image_set,
    read_meta,
)
from dopepp.data.rng import Purpose, item_rng
from dopepp.data.sample import Instance, Sample, SourceInfo, hull_areas
from dopepp.drawing.pictures import Mask, Picture
from dopepp.geometry.camera import CameraMatrix, Transform, project, project_keypoints, transform
from dopepp.parts.part import Part
from dopepp.virtual.backgrounds import Backgrounds

_log = logging.getLogger(__name__)

_MAX_COUNTED_FRAMES: Final = 1000
"""Reading this many meta.mat files takes about a second."""


class YcbVideoSource:
    """Real or synthetic frames of a YCB-Video folder.

    Visible fractions: label pixels over the area of the convex hull of the projected ADD points,
    border ignored. The hull is more than the silhouette of a concave object (drill, mug), so its
    fraction comes out too small there. An object with a pose but without one label pixel is
    unlabelled on a real frame (some releases label only some objects): it gets no mask, and only
    the image border counts. In ``data_syn`` labels are complete, so it is hidden: fraction 0.

    Args:
        parts: The objects to return, named as in ``classes.txt``.
        image_set: Name of the list in ``image_sets/``; exclusive with ``frames``.
        subset: ``real`` reads ``data/``, ``synthetic`` reads ``data_syn/``.
        frames: Frames instead of a list: ``0050/000003`` (real) or ``000000`` (synthetic).
        backgrounds: Pictures behind synthetic frames, whose own background is transparent.
        seed: Seed of those backgrounds; they change with the epoch.

    Raises:
        UserError: The folder is wrong, an object is unknown, or none of the frames is on disk.
        ValueError: Neither or both of ``image_set`` and ``frames``, or synthetic frames without
            ``backgrounds``.
    """

    def __init__(
        self,
        root: Path,
        parts: Sequence[Part],
        image_set: str | None = None,
        subset: Subset = "real",
        frames: Sequence[str] | None = None,
        backgrounds: Backgrounds | None = None,
        seed: int = 0,
        read_depth: bool = True,
    ) -> None:
        if (image_set is None) == (frames is None):
            raise ValueError("give either image_set or frames")
        if subset == "synthetic" and backgrounds is None:
            raise ValueError("synthetic frames are transparent: give backgrounds")
        self.root, self.subset = Path(root), subset
        self.name = f"ycb_video/{FOLDERS[subset]}"
        classes = read_classes(self.root)
        unknown = [part.name for part in parts if part.name not in classes]
        if unknown:
            raise UserError(
                f"objects {unknown}", f"those of classes.txt: {classes}", "correct them"
            )
        self._parts = {classes.index(part.name) + 1: part for part in parts}
        if image_set is not None:
            frames = read_image_set(self.root, image_set, subset)
        self.frames = self._present(
            list(frames or ()), f"{image_set}.txt" if image_set else "frames"
        )
        self._backgrounds, self._seed, self._read_depth = backgrounds, seed, read_depth

    def _present(self, listed: list[str], where: str) -> list[str]:
        present = [frame for frame in listed if self._path(frame, "color.png").is_file()]
        absent = len(listed) - len(present)
        if not present:
            raise UserError(
                f"no frame of {where} under {self.root / FOLDERS[self.subset]} ({absent:,} listed)",
                "at least one listed frame on disk",
                "unpack the data set fully, or choose another image set",
            )
        if absent:
            first = next(f for f in listed if not self._path(f, "color.png").is_file())
            _log.warning(
                "%s: %s of %s frames listed in %s are absent; first: %s",
                self.name,
                f"{absent:,}",
                f"{len(listed):,}",
                where,
                first,
            )
        return present

    def __len__(self) -> int:
        return len(self.frames)

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Read a frame; only the background of a synthetic one depends on the epoch."""
        frame = self.frames[index]
        raw = read_frame(self.root, self.subset, frame, self._read_depth)
        instances = [
            self._instance(part, raw.poses[class_index], raw.K, raw.label == class_index)
            for class_index, part in self._parts.items()
            if class_index in raw.poses
        ]
        image = self._rgb(raw.image, frame, epoch)
        return Sample(image, raw.K, instances, raw.depth, self.name, frame)

    def _path(self, frame: str, what: str) -> Path:
        return self.root / FOLDERS[self.subset] / f"{frame}-{what}"

    def _rgb(self, image: NDArray[Any], frame: str, epoch: int) -> Picture:
        """Composite a synthetic frame on a background drawn for (seed, epoch, frame)."""
        if self.subset == "real" or self._backgrounds is None:
            return image
        rng = item_rng(self._seed, Purpose.BACKGROUND, epoch, int(frame))
        background = self._backgrounds.draw(rng, image.shape[1], image.shape[0])
        alpha = image[..., 3:].astype(np.float32) / 255
        blend = alpha * image[..., :3] + (1 - alpha) * background
        return np.asarray(np.rint(blend), np.uint8)

    def _instance(self, part: Part, T_cam_obj: Transform, K: CameraMatrix, mask: Mask) -> Instance:
        inside, whole = hull_areas(project(transform(T_cam_obj, part.points), K), mask.shape)
        num_pixels = int(np.count_nonzero(mask))
        unlabelled = num_pixels == 0 and self.subset == "real"
        visible = inside if unlabelled else num_pixels
        return Instance(
            label=part.name,
            T_cam_obj=T_cam_obj,
            keypoints=project_keypoints(part.cuboid, T_cam_obj, K),
            visible_fraction=min(1.0, visible / whole) if whole > 0 else 0.0,
            mask=None if unlabelled else mask,
        )

    def contains(self, label: str) -> bool:
        """Tell whether a frame holds this object, reading frames until one does."""
        wanted = {index for index, part in self._parts.items() if part.name == label}
        return bool(wanted) and any(
            not wanted.isdisjoint(read_meta(self._path(frame, "meta.mat")).poses)
            for frame in self.frames
        )

    def describe(self) -> list[SourceInfo]:
        """Return the frame list's hash and the objects; instances of a small list are counted."""
        digest = hashlib.sha256("\n".join(self.frames).encode()).hexdigest()
        identity: dict[str, object] = {
            "frames": digest,
            "objects": {part.name: part.mesh_hash for part in self._parts.values()},
        }
        if self._backgrounds is not None and self.subset == "synthetic":
            identity["background_seed"] = self._seed
            identity["backgrounds"] = self._backgrounds.identity()
        return [SourceInfo(self.name, len(self.frames), identity, self._count_instances())]

    def _count_instances(self) -> dict[str, int]:
        if len(self.frames) > _MAX_COUNTED_FRAMES:
            return {}
        metas = [read_meta(self._path(frame, "meta.mat")) for frame in self.frames]
        return {
            part.name: sum(class_index in meta.poses for meta in metas)
            for class_index, part in self._parts.items()
        }
