"""Makers of miniature data sets that the tests of every layout share."""

import io
import tarfile

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from dopepp.data.rendered import rendered_sample
from dopepp.data.sample import Instance, Sample
from dopepp.geometry.camera import camera_matrix, make_transform, project_keypoints
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.parts.part import Mesh, Part, make_part
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import PRESETS
from dopepp.virtual.renderers.raster import silhouette
from dopepp.virtual.scene import SceneObject
from dopepp.virtual.surface import make_surface

BOX = trimesh.creation.box((60.0, 40.0, 24.0))  # mm, with its centre beside the origin
BOX.apply_translation((4.0, -6.0, 2.0))


@pytest.fixture(scope="session")
def parts():
    return [servoholder(), pivconnector()]


@pytest.fixture(scope="session")
def samples(parts):
    """Four images of bins, with many instances each."""
    factory = Factory(parts, PRESETS["bin"].resized(160, 120), seed=4)
    return [rendered_sample(factory.render(0, i), "virtual", str(i)) for i in range(4)]


@pytest.fixture(scope="session")
def write_set():
    def write(writer_class, root, parts, samples, first=0):
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

    return write


@pytest.fixture(scope="session")
def boxes():
    """Two boxes of 60 × 40 × 24 mm, and three images of both, the second in front of the first."""
    mesh = Mesh(np.asarray(BOX.vertices) / 1000, np.asarray(BOX.faces, np.int32))
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])[None]
    axis = ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    parts = [
        make_part("obj_000001", mesh, symmetries_discrete=half_turn),
        make_part("obj_000002", mesh, symmetries_continuous=(axis,)),
    ]
    return parts, [_boxes_at(parts, image) for image in range(3)]


def _boxes_at(parts, image):
    rng, K, size = np.random.default_rng(image), camera_matrix(150.0, 150.0, 64.0, 63.0), (128, 128)
    poses, wholes = [], []
    for number, part in enumerate(parts):
        rotation = Rotation.random(rng=rng).as_matrix()
        place = np.array([0.05 * number - 0.03, 0.005 * image, 0.4 - 0.06 * number])
        poses.append(make_transform(rotation, place))
        shown = SceneObject(make_surface(part.mesh), poses[-1], part=part)
        wholes.append(silhouette(shown, K, size).mask)
    seen = [wholes[0] & ~wholes[1], wholes[1]]
    instances = [
        Instance(part.name, T, project_keypoints(part.cuboid, T, K), mask.sum() / all_.sum(), mask)
        for part, T, mask, all_ in zip(parts, poses, seen, wholes, strict=True)
    ]
    picture = rng.integers(0, 256, (128, 128, 3), np.uint8)
    return Sample(picture, K, instances, np.full((128, 128), 0.4, np.float32))


@pytest.fixture(scope="session")
def block():
    """Make a 40 × 20 × 10 mm block called as BOP's files are."""
    half = np.array([0.02, 0.01, 0.005])
    cuboid, diameter = cuboid_keypoints(-half, half), float(2 * np.linalg.norm(half))
    return lambda number: Part(f"obj_{number:06d}", cuboid, diameter, cuboid[:8])


@pytest.fixture(scope="session")
def write_shard():
    """Write a tar file of pairs (name or TarInfo, content); return its path."""

    def write(path, files, **options):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tarfile.open(path, "w", **options) as archive:
            for name, content in files:
                info = name if isinstance(name, tarfile.TarInfo) else tarfile.TarInfo(name)
                info.size = len(content) if info.isreg() else 0
                archive.addfile(info, io.BytesIO(content))
        return path

    return write
