"""What the tests of every layout share: rendered samples, and what is asked of a set of files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.data.check import check_dataset
from dopepp.data.sample import Sample
from dopepp.data.sources.rendered import rendered_sample
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.parts.part import Part
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets.preset import PRESETS


@pytest.fixture(scope="session")
def parts() -> list[Part]:
    return [servoholder(), pivconnector()]


@pytest.fixture(scope="session")
def samples(parts: list[Part]) -> list[Sample]:
    """Four images of bins, with many instances each."""
    factory = Factory(parts, PRESETS["bin"].resized(160, 120), seed=4)
    return [rendered_sample(factory.render(0, i), "virtual", str(i)) for i in range(4)]


@pytest.fixture(scope="session")
def contents() -> Callable[[Path], dict[str, bytes]]:
    def read(root: Path) -> dict[str, bytes]:
        return {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file()}

    return read


@pytest.fixture(scope="session")
def assert_read_back() -> Callable[[Sample, Sample], None]:
    def compare(read: Sample, sample: Sample) -> None:
        """Compare what was read with what was written; depth has steps of 0.1 mm."""
        np.testing.assert_array_equal(read.image, sample.image)
        np.testing.assert_array_equal(read.K, sample.K)
        assert read.depth is not None
        assert sample.depth is not None
        assert np.abs(read.depth - sample.depth).max() <= 0.51e-4
        for instance, expected in zip(read.instances, sample.instances, strict=True):
            assert instance.label == expected.label
            np.testing.assert_allclose(instance.T_cam_obj, expected.T_cam_obj, atol=1e-12)
            np.testing.assert_allclose(instance.keypoints, expected.keypoints, atol=1e-4)
            np.testing.assert_array_equal(instance.mask, expected.mask)
            assert instance.visible_fraction == expected.visible_fraction

    return compare


@pytest.fixture(scope="session")
def assert_found() -> Callable[[Path, str], None]:
    def compare(root: Path, expected: str) -> None:
        """Check a damaged set: the damage is among the defects, with its file and field."""
        report = check_dataset(root)
        lines = [str(defect) for defect in report.defects]
        assert any(expected in line for line in lines), lines
        assert not report.ok

    return compare


@pytest.fixture(scope="session")
def assert_refused() -> Callable[[Callable[[], Any], str], None]:
    def compare(read: Callable[[], Any], expected: str) -> None:
        """Read a damaged set: a source says in one line what a check finds, with file and field."""
        with pytest.raises(UserError) as caught:
            read()
        file, field = expected.split(": ")[:2]
        line = str(caught.value)
        assert file in line
        assert field in line
        assert "\n" not in line
        assert len(line) < 800

    return compare
