"""What the writers write: clean, without torch, and whole with several processes in one folder."""

import multiprocessing
import subprocess
import sys
from pathlib import Path

import pytest

from dopepp.data.check import check_dataset
from dopepp.data.formats import STAGING, finalizing, stage, staged_items
from dopepp.data.formats.bop.writer import BopWriter
from dopepp.data.formats.ndds.writer import NddsWriter
from dopepp.data.formats.webdataset.writer import WebdatasetWriter


@pytest.mark.render
@pytest.mark.parametrize("writer_class", [NddsWriter, BopWriter, WebdatasetWriter])
def test_written_sets_are_clean(tmp_path, parts, samples, writer_class, write_set):
    report = check_dataset(write_set(writer_class, tmp_path / "set", parts, samples))
    assert (report.defects, report.notes, report.num_images) == ([], [], len(samples))


def test_data_sets_are_read_written_and_checked_without_torch(tmp_path):
    modules = (
        "check", "formats.bop.reader", "formats.bop.writer", "formats.ndds.reader",
        "formats.ndds.writer", "formats.ycb_video.reader", "sources.hybrid", "sources.rendered",
        "transforms.masking", "transforms.augment",
    )  # fmt: skip
    code = (
        f"import sys, {', '.join(f'dopepp.data.{name}' for name in modules)}\n"
        "import numpy as np\n"
        "from dopepp.data.formats.webdataset.reader import WebdatasetReader\n"
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


ITEMS = 300


def _stage_and_seal(staging: Path, finalized: Path, first: int) -> None:
    for index in range(first, first + ITEMS):
        stage(staging / f"{index:06d}.json", b"{}")
        with finalizing(staging):
            for path in staged_items(staging, ".json"):
                path.rename(finalized / path.name)


@pytest.mark.ddp
def test_nobody_stumbles_over_a_folder_that_vanishes(tmp_path):
    staging, finalized = tmp_path / STAGING, tmp_path / "finalized"
    finalized.mkdir()
    context = multiprocessing.get_context("fork")
    processes = [
        context.Process(target=_stage_and_seal, args=(staging, finalized, first))
        for first in (0, ITEMS, 2 * ITEMS)
    ]
    for process in processes:
        process.start()
    while any(process.is_alive() for process in processes):
        assert all(path.suffix == ".json" for path in staged_items(staging, ".json"))
    assert [process.exitcode for process in processes] == [0, 0, 0]
    assert [path.stem for path in staged_items(finalized, ".json")] == [
        f"{index:06d}" for index in range(3 * ITEMS)
    ]
    assert not staging.exists()


def test_a_file_in_the_way_is_an_error(tmp_path):
    (tmp_path / STAGING).write_text("not a folder")
    with pytest.raises(FileExistsError), finalizing(tmp_path / STAGING):
        pass
