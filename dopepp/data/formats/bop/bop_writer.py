"""Write BOP's scenewise layout item by item, and finalize it scene by scene.

``train_pbr/000012/`` holds images 12,000 – 12,999. The scene's hidden folder ``.items`` keeps an
image's records until the scene is finalized.
"""

from __future__ import annotations

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import UInt16
from PIL import Image

from dopepp.core.errors import UserError
from dopepp.core.files import encode_image, write_file
from dopepp.core.json import read_json
from dopepp.data.formats import (
    STAGING,
    encode_by_key,
    locked,
    read_object,
    stage_item,
    staged_items,
)
from dopepp.data.formats.bop import MAX_SCENE_BYTES, MM
from dopepp.data.formats.bop.bop_models import INFO_FILE, MODEL_FOLDERS, model_numbers, write_models
from dopepp.data.formats.images import depth_units
from dopepp.data.formats.invariants import Box
from dopepp.data.sample import Instance, Sample
from dopepp.drawing.pictures import Mask
from dopepp.geometry.camera import Transform, invert_transform
from dopepp.parts.part import Part
from dopepp.virtual.renderers.raster import Silhouette, silhouette
from dopepp.virtual.scene import SceneObject
from dopepp.virtual.surface import Surface, make_surface

SCENE_FIELDS: Final = ("gt", "gt_info", "camera")
"""Fields of a staged item, each for a file ``scene_FIELD.json``. The cameras list the finalized
images, so their file is written last."""

Record = dict[str, Any]


class BopFolder(ABC):
    """Base of writers of a BOP data set: models, numbered by :func:`model_numbers`, and a split.

    Each item is staged as ``NUMBER`` and :attr:`suffix`, until its chunk is finalized.
    """

    chunk_size = 1000  # images in a scene, as in the rendered training sets of BOP
    split = "train_pbr"
    suffix: str

    def __init__(self, root: str | Path, parts: Sequence[Part]) -> None:
        self.root, self._parts = Path(root), tuple(parts)

    @abstractmethod
    def staging(self, chunk: int) -> Path:
        """Return the folder of a chunk's staged items."""

    @abstractmethod
    def finalized(self, chunk: int) -> Iterable[int]:
        """Return the numbers of a chunk's finalized images."""

    @abstractmethod
    def merge(self, chunk: int, staged: Mapping[int, Path]) -> None:
        """Add staged images, by number, to the files of a chunk."""

    def prepare(self) -> None:
        """Write the parts' models, if they are not there yet.

        Raises:
            UserError: The split has images, and the models are missing or of other parts.
        """
        info = f"{MODEL_FOLDERS[0]}/{INFO_FILE}"
        if (self.root / self.split).exists() and not (self.root / info).exists():
            problem = f"{self.root}, which has {self.split}/ and no {info}"
            allowed = "an empty folder, or a data set begun by this command"
            raise UserError(problem, allowed, "pass another folder")
        write_models(self.root, self._parts)

    def written(self, chunk: int) -> set[int]:
        """Return the indices of the chunk's images that are staged or finalized."""
        images = {*self._staged(chunk), *self.finalized(chunk)}
        return {chunk * self.chunk_size + image for image in images}

    def finalize(self, chunk: int, indices: Sequence[int]) -> None:
        """Merge the staged images of a chunk into its files."""
        image_numbers = {index % self.chunk_size for index in indices}
        # Shards on several machines share the folder.
        with locked(self.root / MODEL_FOLDERS[0] / INFO_FILE):
            staged = self._staged(chunk)
            staged = {image: path for image, path in staged.items() if image in image_numbers}
            self.merge(chunk, staged)
            for path in staged.values():
                path.unlink()
            for folder in (self.staging(chunk), self.staging(chunk).parent):
                with suppress(OSError):  # the folder is missing, or has files left
                    folder.rmdir()

    def _staged(self, chunk: int) -> dict[int, Path]:
        return {int(path.stem): path for path in staged_items(self.staging(chunk), self.suffix)}

    @cached_property
    def _surfaces(self) -> dict[str, tuple[Part, Surface]]:
        return {part.name: (part, make_surface(part.mesh)) for part in self._parts if part.mesh}

    def labels(self, sample: Sample) -> Labels:
        """Return a sample's annotation, see :func:`make_labels`."""
        numbers = model_numbers([part.name for part in self._parts])
        return make_labels(sample, numbers, self._surfaces)


class BopWriter(BopFolder):
    """A :class:`~dopepp.data.formats.Writer` of the scenewise layout."""

    name, suffix = "bop", ".json"

    def write(self, index: int, sample: Sample) -> None:
        """Write an image's files, last the staged records, which mark it as complete."""
        labels = self.labels(sample)
        chunk, image = divmod(index, self.chunk_size)
        scene = self._scene(chunk)
        write_file(scene / "rgb" / f"{image:06d}.png", encode_image(sample.image))
        write_file(scene / "depth" / f"{image:06d}.png", encode_image(labels.depth))
        for folder, masks in (("mask", labels.masks), ("mask_visib", labels.visible_masks)):
            for number, mask in enumerate(masks):
                path = scene / folder / f"{image:06d}_{number:06d}.png"
                write_file(path, encode_image(mask.astype("uint8") * 255))
        item = {"camera": labels.camera, "gt": labels.truths, "gt_info": labels.infos}
        stage_item(self.staging(chunk) / f"{image:06d}.json", json.dumps(item).encode())

    def staging(self, chunk: int) -> Path:
        """Return the folder of a scene's staged records."""
        return self._scene(chunk) / STAGING

    def finalized(self, chunk: int) -> Iterable[int]:
        """Return the images in ``scene_camera.json``, which is written last."""
        return map(int, read_object(self._scene(chunk) / "scene_camera.json", MAX_SCENE_BYTES))

    def merge(self, chunk: int, staged: Mapping[int, Path]) -> None:
        """Add staged records to the scene's files, and write the data set's ``camera.json``."""
        if not staged:
            return
        items: dict[int, Any] = {image: read_json(path) for image, path in staged.items()}
        for field in SCENE_FIELDS:
            path = self._scene(chunk) / f"scene_{field}.json"
            merged = read_object(path, MAX_SCENE_BYTES)
            merged |= {f"{image}": item[field] for image, item in items.items()}
            # Sorted, so that the bytes do not depend on the order of writing.
            merged = dict(sorted(merged.items(), key=lambda entry: int(entry[0])))
            write_file(path, encode_by_key(merged))
        image, camera = next(iter(merged.items()))
        self._write_camera(chunk, int(image), camera)

    def _scene(self, chunk: int) -> Path:
        return self.root / self.split / f"{chunk:06d}"

    def _write_camera(self, chunk: int, image: int, camera: Mapping[str, Any]) -> None:
        """Write ``camera.json`` from an image's camera, if no earlier scene is on the disk."""
        folders = (self.root / self.split).iterdir()
        if chunk > min(int(path.name) for path in folders if path.name.isdecimal()):
            return
        with Image.open(self._scene(chunk) / "rgb" / f"{image:06d}.png") as file:
            width, height = file.size
        K = camera["cam_K"]
        record = {"cx": K[2], "cy": K[5], "depth_scale": camera["depth_scale"]}
        record |= {"fx": K[0], "fy": K[4], "height": height, "width": width}
        write_file(self.root / "camera.json", (json.dumps(record, indent=2) + "\n").encode())


@dataclass(frozen=True)
class Labels:
    """An image's annotation in BOP's format.

    Attributes:
        camera: ``cam_K``, ``depth_scale`` and, in a static scene, the pose of the world.
        truths: ``scene_gt`` records of the objects.
        infos: ``scene_gt_info`` records of the objects.
        depth: Units of ``depth_scale`` mm, 0 where unknown.
        masks: Silhouettes of the objects without occlusion.
    """

    camera: Record
    truths: list[Record]
    infos: list[Record]
    depth: UInt16[np.ndarray, "height width"]
    masks: list[Mask]
    visible_masks: list[Mask]


def make_labels(
    sample: Sample, object_ids: Mapping[str, int], parts: Mapping[str, tuple[Part, Surface]]
) -> Labels:
    """Return the annotation of a rendered image, as BOP's toolkit defines it.

    A box is (x, y, width, height). Width and height are differences between the coordinates of the
    outermost pixels, so that a single pixel has width 0. The box of an object without a visible
    pixel consists of −1. The silhouette includes pixels beyond the image's border. ``object_ids``
    and ``parts`` are by label.
    """
    visible = [instance.mask for instance in sample.instances if instance.mask is not None]
    assert sample.depth is not None
    covered = np.any([np.zeros(sample.depth.shape, bool), *visible], axis=0)
    depth, scale = depth_units(sample.depth, covered)
    truths, infos, masks = [], [], []
    for instance, mask in zip(sample.instances, visible, strict=True):
        part, surface = parts[instance.label]
        T: Transform = np.asarray(instance.T_cam_obj, np.float64)
        item = SceneObject(surface, instance.T_cam_obj, part=part)
        whole = silhouette(item, sample.K, sample.size)
        masks.append(whole.mask)
        infos.append(_info(instance, mask, whole, depth))
        truth = {"cam_R_m2c": T[:3, :3].ravel().tolist(), "cam_t_m2c": (T[:3, 3] * MM).tolist()}
        truths.append({**truth, "obj_id": object_ids[instance.label]})
    camera = {"cam_K": np.asarray(sample.K, np.float64).ravel().tolist(), "depth_scale": scale}
    if sample.T_world_cam is not None:
        T = invert_transform(sample.T_world_cam)
        camera |= {"cam_R_w2c": T[:3, :3].ravel().tolist(), "cam_t_w2c": (T[:3, 3] * MM).tolist()}
    return Labels(camera, truths, infos, depth, masks, visible)


def _info(
    instance: Instance, visible: Mask, whole: Silhouette, depth: UInt16[np.ndarray, "height width"]
) -> Record:
    """Return an instance's ``scene_gt_info`` record; ``whole`` is its unoccluded silhouette."""
    visible_box = Box.of_mask(visible)
    return {
        "bbox_obj": _bop_box(None if visible_box is None else _silhouette_box(whole)),
        "bbox_visib": _bop_box(visible_box),
        # A silhouette around the camera has no finite size, so its pixels in the image are counted.
        "px_count_all": int(whole.num_px if math.isfinite(whole.num_px) else whole.mask.sum()),
        "px_count_valid": int(np.count_nonzero(depth[whole.mask])),
        "px_count_visib": int(np.count_nonzero(visible)),
        "visib_fract": float(instance.visible_fraction),
    }


def _bop_box(box: Box | None) -> list[int]:
    """Return BOP's (x, y, width, height) in pixels; four times −1 without a box."""
    if box is None:
        return [-1] * 4
    return [int(n) for n in (box.left, box.top, box.right - box.left, box.bottom - box.top)]


def _silhouette_box(whole: Silhouette) -> Box | None:
    """Return the box of a silhouette, including its pixels beyond the image's border."""
    # The silhouette's box bounds the vertices; the box of pixels is exact inside the border.
    inside = Box.of_mask(whole.mask)
    if inside is None or whole.box is None:
        return inside
    height, width = whole.mask.shape
    left, top, right, bottom = whole.box[0], whole.box[1], whole.box[2] - 1, whole.box[3] - 1
    low = left if left < 0 else inside.left, top if top < 0 else inside.top
    high = right if right >= width else inside.right, bottom if bottom >= height else inside.bottom
    return Box(*low, *high)
