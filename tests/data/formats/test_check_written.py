"""What the renderer makes and the writers write: read back and checked, and nothing is wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from dopepp.data.check import check_dataset
from dopepp.data.formats import Writer
from dopepp.data.formats.bop.writer import BopWriter
from dopepp.data.formats.ndds.writer import NddsWriter
from dopepp.data.formats.webdataset.writer import WebdatasetWriter
from dopepp.data.sample import Sample
from dopepp.data.sources.rendered import rendered_sample
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets.preset import PRESETS

PARTS = [servoholder(), pivconnector()]
NUM_IMAGES = 4


@pytest.fixture(scope="module")
def samples() -> list[Sample]:
    preset = replace(PRESETS["paper"].resized(128, 96), targets_per_image=(1, 3))
    factory = Factory(PARTS, preset, seed=5)
    return [rendered_sample(factory.render(0, i), "virtual", str(i)) for i in range(NUM_IMAGES)]


@pytest.mark.render
@pytest.mark.parametrize("writer_class", [NddsWriter, BopWriter, WebdatasetWriter])
def test_written_sets_are_clean(
    tmp_path: Path, samples: list[Sample], writer_class: type[Writer]
) -> None:
    writer = writer_class(tmp_path / "set", PARTS)  # type: ignore[call-arg]
    writer.prepare()
    for index, sample in enumerate(samples):
        writer.write(index, sample)
    writer.finalize(0, range(NUM_IMAGES))
    report = check_dataset(tmp_path / "set")
    assert [str(defect) for defect in report.defects] == []
    assert report.num_images == NUM_IMAGES
    assert report.notes == []
