"""What the renderer makes and the writers write: checked and clean, and all of it without torch."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from dopepp.data.check import check_dataset
from dopepp.data.formats.bop.writer import BopWriter
from dopepp.data.formats.ndds.writer import NddsWriter
from dopepp.data.formats.webdataset.writer import WebdatasetWriter
from dopepp.data.sample import Sample
from dopepp.parts.part import Part


@pytest.mark.render
@pytest.mark.parametrize("writer_class", [NddsWriter, BopWriter, WebdatasetWriter])
def test_written_sets_are_clean(
    tmp_path: Path, parts: list[Part], samples: list[Sample], writer_class: Any, write_set: Any
) -> None:
    report = check_dataset(write_set(writer_class, tmp_path / "set", parts, samples))
    assert (report.defects, report.notes, report.num_images) == ([], [], len(samples))


def test_data_sets_are_read_written_and_checked_without_torch(tmp_path: Path) -> None:
    modules = (
        "check", "formats.bop.source", "formats.bop.writer", "formats.ndds.source",
        "formats.ndds.writer", "formats.ycb_video.source", "sources.hybrid", "sources.cache",
        "sources.rendered", "transforms.masking", "transforms.augment",
    )  # fmt: skip
    code = (
        f"import sys, {', '.join(f'dopepp.data.{name}' for name in modules)}\n"
        "import numpy as np\n"
        "from dopepp.data.formats.webdataset.source import WebdatasetSource\n"
        "from dopepp.data.formats.webdataset.writer import WebdatasetWriter\n"
        "from dopepp.data.sample import Sample\n"
        "from dopepp.parts.catalogue import servoholder\n"
        f"writer = WebdatasetWriter({str(tmp_path)!r}, [servoholder()])\n"
        "writer.prepare()\n"
        "image, depth = np.zeros((8, 8, 3), np.uint8), np.zeros((8, 8), np.float32)\n"
        "writer.write(0, Sample(image, np.eye(3), [], depth))\n"
        "assert writer.written(0) == {0}\n"
        "sys.exit(bool({'torch', 'lightning', 'webdataset'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
