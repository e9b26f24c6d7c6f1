"""Makers of poses, meshes, changed records and archives; the layouts of data sets."""

import io
import json
import tarfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dopepp.data.formats.bop.bop_reader import BopReader
from dopepp.data.formats.bop.bop_writer import BopWriter
from dopepp.data.formats.ndds.ndds_reader import NddsReader
from dopepp.data.formats.ndds.ndds_writer import NddsWriter
from dopepp.data.formats.webdataset.webdataset_reader import WebdatasetReader
from dopepp.data.formats.webdataset.webdataset_writer import WebdatasetWriter
from dopepp.data.render_job import RenderJob, make_job
from dopepp.data.sample import Sample, SourceInfo
from dopepp.geometry.camera import make_transform
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.parts.part import Part


@dataclass(eq=False)
class MadeSource:
    """A source whose samples a function of index and epoch makes; it records its requests."""

    make: Callable[[int, int], Sample]
    num_items: int
    name: str = "made"
    identity: Mapping[str, object] = field(default_factory=dict)
    requests: list[tuple[int, int]] = field(default_factory=list)

    def __len__(self) -> int:
        return self.num_items

    def sample(self, index: int, epoch: int = 0) -> Sample:
        assert 0 <= index < self.num_items
        self.requests.append((index, epoch))
        return self.make(index, epoch)

    def describe(self) -> list[SourceInfo]:
        return [SourceInfo(self.name, self.num_items, dict(self.identity))]

    def contains(self, label: str) -> bool:
        return label == self.name


def pose_at(x: float, y: float, z: float) -> np.ndarray:
    """Return the pose of an object that is moved and not rotated, metres."""
    return make_transform(np.eye(3), np.array([x, y, z], np.float64))


def edit_json(path: Path, change: Callable[[Any], Any]) -> None:
    """Replace the content of a JSON file, or change it in place if the function returns None."""
    content = json.loads(path.read_text())
    changed = change(content)
    path.write_text(json.dumps(content if changed is None else changed))


def contents(root: Path) -> dict[str, bytes]:
    """Read the files of a folder by relative path; subfolders have empty content."""
    return {
        str(path.relative_to(root)): path.read_bytes() if path.is_file() else b""
        for path in root.rglob("*")
    }


def block(number: int) -> Part:
    """Make a block of 40 × 20 × 10 mm, named like BOP's files."""
    half = np.array([0.02, 0.01, 0.005])
    cuboid = cuboid_keypoints(-half, half)
    return Part(f"obj_{number:06d}", cuboid, float(2 * np.linalg.norm(half)), cuboid[:8])


def small_job(layout: str = "bop", **options: Any) -> RenderJob:
    """Make a job of small images with other options."""
    defaults = {"preset": "quickstart", "size": "32x24", "layout": layout}
    return make_job(["servoholder"], **defaults | options)


def write_tar(path: Path, files: Iterable[tuple[Any, bytes]], **options: Any) -> Path:
    """Write a tar file of pairs (name or TarInfo, content) and return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tarfile.open(path, "w", **options) as archive:
        for name, content in files:
            info = name if isinstance(name, tarfile.TarInfo) else tarfile.TarInfo(name)
            info.size = len(content) if info.isreg() else 0
            archive.addfile(info, io.BytesIO(content))
    return path


def write_set(writer_class: Any, root: Path, parts: Any, samples: Any, first: int = 0) -> Path:
    """Write samples from an index on, finalize every chunk, and return the folder."""
    writer = writer_class(root, parts)
    writer.prepare()
    indices = range(first, first + len(samples))
    for index, sample in zip(indices, samples, strict=True):
        writer.write(index, sample)
    size = writer.chunk_size
    for chunk in sorted({index // size for index in indices}):
        writer.finalize(chunk, [index for index in indices if index // size == chunk])
    return root


def _of_train_pbr(reader: Any) -> Callable[[Path, list[Part]], Any]:
    return lambda root, parts: reader(root, parts, "train_pbr")


LAYOUTS: dict[str, tuple[Any, Callable[[Path, list[Part]], Any]]] = {
    "BOP": (BopWriter, _of_train_pbr(BopReader)),
    "BOP-WebDataset": (WebdatasetWriter, _of_train_pbr(WebdatasetReader)),
    "NDDS": (NddsWriter, NddsReader),
}
"""Writer and reader of a layout, by the name that ``dopepp check`` prints."""


def assert_same(read: Sample, sample: Sample, *, T_atol: float = 0, px_atol: float = 0) -> None:
    """Compare image, camera and instances, with their poses and keypoints within tolerances."""
    np.testing.assert_array_equal(read.image, sample.image)
    np.testing.assert_array_equal(read.K, sample.K)
    for instance, expected in zip(read.instances, sample.instances, strict=True):
        stated = (expected.label, expected.visible_fraction)
        assert (instance.label, instance.visible_fraction) == stated
        np.testing.assert_allclose(instance.T_cam_obj, expected.T_cam_obj, rtol=0, atol=T_atol)
        np.testing.assert_allclose(instance.keypoints, expected.keypoints, rtol=0, atol=px_atol)
        assert (instance.mask is None) == (expected.mask is None)
        if expected.mask is not None:
            np.testing.assert_array_equal(instance.mask, expected.mask)
