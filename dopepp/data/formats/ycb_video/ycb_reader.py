"""Read YCB-Video: ``data/SSSS/NNNNNN-*`` (real) or ``data_syn/NNNNNN-*`` (synthetic).

A reader reads one of the two subsets; :mod:`dopepp.data.hybrid` mixes them.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dopepp.core.errors import UserError
from dopepp.data.formats import make_instance, ycb_video
from dopepp.data.formats.ycb_video import FrameMeta, Subset
from dopepp.data.sample import Purpose, Sample, SourceInfo, item_rng
from dopepp.drawing.pictures import RGBImage
from dopepp.geometry.camera import camera_matrix, check_camera
from dopepp.parts.part import Part
from dopepp.virtual.backgrounds import Backgrounds

_log = logging.getLogger(__name__)

_MAX_COUNTED_FRAMES: Final = 1000  # reading this many meta.mat files takes about a second

_FIRST_SCENE_OF_SECOND_CAMERA: Final = 60
_CAMERAS: Final = (
    camera_matrix(1066.778, 1067.487, 312.9869, 241.3109),
    camera_matrix(1077.836, 1078.189, 323.7872, 279.6921),
)
"""Colour cameras of the data set: scenes 0000–0059 and data_syn; scenes 0060–0091."""


class YcbVideoReader:
    """Reader of the real or the synthetic frames of a YCB-Video folder.

    The visible fraction is the number of label pixels divided by the area of the convex hull of the
    projected ADD points, which is too small for a concave object (drill, mug). Some releases label
    only some objects, so a posed object without a label pixel has no mask on a real frame, and its
    fraction accounts for the image border only. In ``data_syn``, its fraction is 0.

    Args:
        parts: Objects to return, named as in ``classes.txt``.
        image_set: Name of the list in ``image_sets/``, or its frames: ``0050/000003`` (real) or
            ``000000`` (synthetic).
        backgrounds: Images for the transparent background of synthetic frames, which need them;
            they change with ``seed`` and epoch.

    Raises:
        UserError: The folder, the list or a part's class is missing, or no frame is on disk.
    """

    def __init__(
        self,
        root: Path,
        parts: Sequence[Part],
        image_set: str | Sequence[str],
        subset: Subset = "real",
        backgrounds: Backgrounds | None = None,
        seed: int = 0,
        read_depth: bool = True,
    ) -> None:
        self.root, self.subset = Path(root), subset
        self.name = f"ycb_video/{ycb_video.FOLDERS[subset]}"
        classes = ycb_video.read_classes(self.root)
        unknown = [part.name for part in parts if part.name not in classes]
        if unknown:
            allowed = f"the names in classes.txt: {classes}"
            fix = "set data.objects to one or more of these names"
            raise UserError(f"objects {unknown}", allowed, fix)
        self._parts = {classes.index(part.name) + 1: part for part in parts}
        self._backgrounds, self._seed, self._read_depth = backgrounds, seed, read_depth
        list_name, listed = "frames", image_set
        if isinstance(image_set, str):
            list_name = f"{image_set}.txt"
            listed = ycb_video.read_image_set(self.root, image_set, subset)
        self.frames = [f for f in listed if Path(f"{self._start(f)}-color.png").is_file()]
        num_absent = len(listed) - len(self.frames)
        if not self.frames:
            problem = f"no frame of {list_name} under {self._start('')} ({num_absent:,} listed)"
            fix = "unpack all archives of the data set into it, or set another image set"
            raise UserError(problem, "at least one listed frame on disk", fix)
        if num_absent:
            counts = f"{num_absent:,} of {len(listed):,}"
            _log.warning("%s: %s frames listed in %s are absent", self.name, counts, list_name)

    def __len__(self) -> int:
        return len(self.frames)

    def sample(self, index: int, epoch: int = 0) -> Sample:
        """Read a frame; only the background of a synthetic frame depends on the epoch."""
        name, is_real = self.frames[index], self.subset == "real"
        frame = ycb_video.read_frame(self._start(name), self.subset, read_depth=self._read_depth)
        assert frame.image is not None
        shape, meta, depth = frame.image.shape[:2], frame.meta, frame.depth
        if depth is not None:
            depth = depth / np.float32(meta.factor_depth)
        scene = int(name.partition("/")[0]) if is_real else 0
        K = _CAMERAS[scene >= _FIRST_SCENE_OF_SECOND_CAMERA] if meta.K is None else meta.K
        K = check_camera(K, (shape[1], shape[0]), f"{self._start(name)}-meta.mat")
        instances = []
        for class_index, part in self._parts.items():
            if class_index in meta.poses:
                labelled = np.asarray(frame.labels == class_index)
                mask = None if is_real and not labelled.any() else labelled
                pose = meta.poses[class_index]
                instances.append(make_instance(part, pose, K, np.nan, mask, shape))
        image = frame.image if is_real else self._composite(frame.image, name, epoch)
        return Sample(image, K, instances, depth, self.name, name)

    def _start(self, frame: str) -> str:
        """Return the common start of the paths of a frame's files, ``ROOT/data/0050/000003``."""
        return str(self.root / ycb_video.FOLDERS[self.subset] / frame)

    def _meta(self, frame: str) -> FrameMeta:
        return ycb_video.read_meta(Path(f"{self._start(frame)}-meta.mat"))

    def _composite(self, image: NDArray[Any], frame: str, epoch: int) -> RGBImage:
        """Return a synthetic frame on the background of (seed, epoch, frame)."""
        assert self._backgrounds is not None
        rng = item_rng(self._seed, Purpose.BACKGROUND, epoch, int(frame))
        background = self._backgrounds.draw(rng, image.shape[1], image.shape[0])
        alpha = image[..., 3:].astype(np.float32) / 255
        blend = alpha * image[..., :3] + (1 - alpha) * background
        return np.asarray(np.rint(blend), np.uint8)

    def contains(self, label: str) -> bool:
        """Return whether the object is annotated on any frame; read annotations until it is."""
        class_indices = {index for index, part in self._parts.items() if part.name == label}
        return bool(class_indices) and any(
            not class_indices.isdisjoint(self._meta(frame).poses) for frame in self.frames
        )

    def files(self) -> Iterator[Path]:
        """Yield the image, the labels and the poses of each frame."""
        for frame in self.frames:
            for name in ("color.png", "label.png", "meta.mat"):
                yield Path(f"{self._start(frame)}-{name}")

    def describe(self) -> list[SourceInfo]:
        """Return one entry: hashes and, for at most 1,000 frames, the numbers of instances."""
        identity: dict[str, object] = {
            "frames": hashlib.sha256("\n".join(self.frames).encode()).hexdigest(),
            "objects": {part.name: part.mesh_hash for part in self._parts.values()},
        }
        if self._backgrounds is not None and self.subset == "synthetic":
            identity["background_seed"] = self._seed
            identity["backgrounds"] = self._backgrounds.identity()
        is_counted = len(self.frames) <= _MAX_COUNTED_FRAMES
        metas = [self._meta(frame) for frame in self.frames] if is_counted else []
        instances = {
            part.name: sum(class_index in meta.poses for meta in metas)
            for class_index, part in self._parts.items()
        }
        return [SourceInfo(self.name, len(self.frames), identity, instances if is_counted else {})]
