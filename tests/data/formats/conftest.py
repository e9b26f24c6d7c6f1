"""What the tests of every layout share: rendered samples, and what is asked of a set of files."""

import io
import json
import tarfile

import cv2
import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.data.check import check_dataset
from dopepp.data.sources.rendered import rendered_sample
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.parts.part import Part
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import PRESETS


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
def assert_read_back():
    def compare(read, sample):
        """Compare what was read with what was written; depth has steps of 0.1 mm."""
        np.testing.assert_array_equal(read.image, sample.image)
        np.testing.assert_array_equal(read.K, sample.K)
        assert np.abs(read.depth - sample.depth).max() <= 0.51e-4
        for instance, expected in zip(read.instances, sample.instances, strict=True):
            assert instance.label == expected.label
            np.testing.assert_allclose(instance.T_cam_obj, expected.T_cam_obj, atol=1e-12)
            np.testing.assert_allclose(instance.keypoints, expected.keypoints, atol=1e-4)
            np.testing.assert_array_equal(instance.mask, expected.mask)
            assert instance.visible_fraction == expected.visible_fraction

    return compare


@pytest.fixture(scope="session")
def assert_found():
    def compare(root, *expected):
        """Check a damaged set: each damage is among the defects, with its file and field."""
        report = check_dataset(root)
        lines = [str(defect) for defect in report.defects]
        for one in expected:
            assert any(one in line for line in lines), (one, lines)
        assert not report.ok

    return compare


@pytest.fixture(scope="session")
def spoilt():
    def change(content, keys, value):
        """Return a file with another content, or with another value in its JSON.

        ``keys`` lead to the value (``"0.1.obj_id"``). None takes it away, a function changes it.
        """
        if not keys:
            new = value(content) if callable(value) else value
            return cv2.imencode(".png", new)[1].tobytes() if isinstance(new, np.ndarray) else new
        tree = node = json.loads(content)
        *path, last = keys.split(".")
        for name in path:
            node = node[int(name) if isinstance(node, list) else name]
        key = int(last) if isinstance(node, list) else last
        if value is None:
            del node[key]
        else:
            node[key] = value(node[key]) if callable(value) else value
        return json.dumps(tree).encode()

    return change


@pytest.fixture(scope="session")
def assert_refused():
    def compare(make_source, expected):
        """Read a damaged set: a source says in one line what a check finds, with file and field."""

        def read():
            source = make_source()
            for index in range(len(source)):
                source.sample(index)

        with pytest.raises(UserError) as caught:
            read()
        line = str(caught.value)
        assert all(part in line for part in expected.split(": ")[:2])
        assert "\n" not in line
        assert len(line) < 800

    return compare


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
