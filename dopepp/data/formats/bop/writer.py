"""BOP's scenewise layout, written item by item and finalized scene by scene.

``train_pbr/000012/`` holds images 12,000 – 12,999: rgb, depth, mask and mask_visib as PNG, and
``scene_camera.json``, ``scene_gt.json`` and ``scene_gt_info.json``. An image's records lie in the
scene's hidden folder ``.items`` until the scene is finalized.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from PIL import Image

from dopepp.core.errors import UserError
from dopepp.core.files import write_whole
from dopepp.core.json import read_json
from dopepp.data.formats import STAGING, finalizing, stage, staged_items
from dopepp.data.formats.bop.images import encode_png
from dopepp.data.formats.bop.labels import Labels, make_labels
from dopepp.data.formats.bop.models import INFO_FILE, MODEL_FOLDERS, write_models
from dopepp.data.formats.bop.scene import MAX_SCENE_BYTES
from dopepp.data.sample import Sample
from dopepp.parts.part import Part
from dopepp.virtual.surface import Surface, make_surface

IMAGES_A_SCENE: Final = 1000
"""As in BOP's own rendered training sets."""

SCENE_FILES: Final = {
    "scene_gt.json": "gt",
    "scene_gt_info.json": "gt_info",
    "scene_camera.json": "camera",
}
"""A scene's files and the field of a staged item that goes into each; the last one lists what is
finalized, so it is written last."""


class PartSurfaces:
    """The parts a writer numbers 1, 2, …, with the surfaces that give their silhouettes."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self.parts = tuple(parts)

    @cached_property
    def _surfaces(self) -> dict[str, tuple[Part, Surface]]:
        return {
            part.name: (part, make_surface(part.mesh))
            for part in self.parts
            if part.mesh is not None
        }

    def labels(self, sample: Sample) -> Labels:
        """Annotate a sample, see :func:`~dopepp.data.formats.bop.labels.make_labels`."""
        ids = {part.name: number for number, part in enumerate(self.parts, start=1)}
        return make_labels(sample, ids, self._surfaces)


def prepare_models(root: Path, split: str, parts: Sequence[Part]) -> None:
    """Write the models, unless the split holds images that were made without them.

    Raises:
        UserError: The folder holds something else.
    """
    if (root / split).exists() and not (root / MODEL_FOLDERS[0] / INFO_FILE).exists():
        raise UserError(
            f"{root}, which has {split}/ and no {MODEL_FOLDERS[0]}/{INFO_FILE}",
            "an empty folder, or one that this layout was begun in",
            "choose another folder",
        )
    write_models(root, parts)


class BopFolder:
    """What the writers of BOP's layouts share: a folder with models beside a split of images.

    Args:
        root: The data set's folder.
        parts: The objects, numbered from 1 in this order.
        split: Name of the split's folder.
    """

    chunk_size = IMAGES_A_SCENE

    def __init__(self, root: str | Path, parts: Sequence[Part], split: str = "train_pbr") -> None:
        self.root, self.split = Path(root), split
        self._parts = PartSurfaces(parts)

    def prepare(self) -> None:
        """Write the models.

        Raises:
            UserError: The folder holds something else, or a part has no mesh.
        """
        prepare_models(self.root, self.split, self._parts.parts)


class BopWriter(BopFolder):
    """A :class:`~dopepp.data.formats.Writer` of the scenewise layout."""

    name = "bop"

    def write(self, index: int, sample: Sample) -> None:
        """Write an image's files, its records last."""
        labels = self._parts.labels(sample)
        chunk, image = divmod(index, self.chunk_size)
        scene = self._scene(chunk)
        write_whole(scene / "rgb" / f"{image:06d}.png", encode_png(sample.image))
        write_whole(scene / "depth" / f"{image:06d}.png", encode_png(labels.depth))
        for folder, masks in (("mask", labels.masks), ("mask_visib", labels.visible_masks)):
            for number, mask in enumerate(masks):
                path = scene / folder / f"{image:06d}_{number:06d}.png"
                write_whole(path, encode_png(mask.astype("uint8") * 255))
        item = {
            "camera": labels.camera,
            "gt": labels.truths,
            "gt_info": labels.infos,
        }
        stage(scene / STAGING / f"{image:06d}.json", json.dumps(item).encode())

    def written(self, chunk: int) -> set[int]:
        """Return the indices of the scene's complete images."""
        scene = self._scene(chunk)
        images = {int(path.stem) for path in _staged(scene)}
        images |= {int(image) for image in _read_scene(scene / "scene_camera.json")}
        return {chunk * self.chunk_size + image for image in images}

    def finalize(self, chunk: int, indices: Sequence[int]) -> None:
        """Merge the staged records into the scene's files, and the first camera into the root's."""
        scene = self._scene(chunk)
        wanted = {index % self.chunk_size for index in indices}
        with finalizing(scene / STAGING):
            staged = [path for path in _staged(scene) if int(path.stem) in wanted]
            items: dict[int, Any] = {int(path.stem): read_json(path) for path in staged}
            for name, field in SCENE_FILES.items():
                merged = {int(key): value for key, value in _read_scene(scene / name).items()}
                merged |= {image: item[field] for image, item in items.items()}
                if items:
                    write_whole(scene / name, _by_image(merged))
            if items:
                self._write_camera(chunk, min(merged), merged[min(merged)])
            for path in staged:
                path.unlink()

    def _scene(self, chunk: int) -> Path:
        return self.root / self.split / f"{chunk:06d}"

    def _write_camera(self, chunk: int, image: int, camera: Mapping[str, Any]) -> None:
        """Write ``camera.json``, which tells tools about the sensor: that of the first image."""
        folders = (self.root / self.split).iterdir()
        if chunk > min(int(path.name) for path in folders if path.name.isdecimal()):
            return
        with Image.open(self._scene(chunk) / "rgb" / f"{image:06d}.png") as picture:
            width, height = picture.size
        K = camera["cam_K"]
        record = {"cx": K[2], "cy": K[5], "depth_scale": camera["depth_scale"]}
        record |= {"fx": K[0], "fy": K[4], "height": height, "width": width}
        write_whole(self.root / "camera.json", (json.dumps(record, indent=2) + "\n").encode())


def _staged(scene: Path) -> list[Path]:
    return staged_items(scene / STAGING, ".json")


def _read_scene(path: Path) -> Mapping[str, Any]:
    if not path.exists():
        return {}
    records = read_json(path, MAX_SCENE_BYTES)
    if not isinstance(records, dict):
        raise UserError(f"{path}, no object of images", "what this writer wrote", "restore it")
    return records


def _by_image(records: Mapping[int, object]) -> bytes:
    """Return one line an image, in order: the bytes do not depend on who wrote what first."""
    lines = [f'  "{image}": {json.dumps(record)}' for image, record in sorted(records.items())]
    return ("{\n" + ",\n".join(lines) + "\n}\n").encode()
