"""Writers: without defects, without torch, and safe with several processes in one folder."""

import multiprocessing
import pickle
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from dopepp.data.check import check_dataset
from dopepp.data.formats import STAGING, locked, stage_item, staged_items
from tests.data.makers import LAYOUTS, assert_same, contents, write_set


@pytest.mark.render
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_written_data_set_is_sound_and_read_back(tmp_path, parts, samples, layout):
    writer, make_reader = LAYOUTS[layout]
    root = write_set(writer, tmp_path / "set", parts, samples)
    report = check_dataset(root)
    assert (report.defects, report.notes, report.num_images) == ([], [], len(samples))
    reader = pickle.loads(pickle.dumps(make_reader(root, parts)))
    assert len(reader) == len(samples)
    for index in (2, 0, 3, 1):  # at random
        read, sample = reader.sample(index, epoch=7), samples[index]
        assert_same(read, sample, T_atol=1e-12, px_atol=1e-4)
        assert np.abs(read.depth - sample.depth).max() <= 0.51e-4  # steps of 0.1 mm
    assert (reader.contains("servoholder"), reader.contains("else")) == (True, False)


def die(*_):
    raise KeyboardInterrupt


@pytest.mark.parametrize("layout", LAYOUTS)
def test_bytes_depend_neither_on_order_nor_on_kills(tmp_path, boxes, layout):
    writer_class, (parts, samples) = LAYOUTS[layout][0], boxes
    whole = write_set(writer_class, tmp_path / "whole", parts, samples, 998)
    root = tmp_path / "killed"
    writer = writer_class(root, parts)
    for _ in range(2):
        writer.prepare()
    writer.write(1000, samples[2])
    for _ in range(2):
        writer.finalize(1, [1000])
    writer.write(999, samples[1])
    with pytest.MonkeyPatch.context() as patch:  # after some files of an item, before its marker
        module = writer_class.__module__
        for name in ("stage_item", "_encode"):
            patch.setattr(f"{module}.{name}", die, raising=False)
        with pytest.raises(KeyboardInterrupt):
            writer.write(998, samples[0])
    assert writer_class(root, parts).written(0) == {999}
    if layout != "NDDS":
        # After some of a chunk's files, before the last.
        last = "BopWriter._write_camera" if layout == "BOP" else "encode_by_key"
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(f"{module}.{last}", die)
            with pytest.raises(KeyboardInterrupt):
                writer.finalize(0, [999])
    again = writer_class(root, parts)
    assert (again.written(0), again.written(1), again.written(2)) == ({999}, {1000}, set())
    again.write(998, samples[0])
    again.write(999, samples[1])
    again.finalize(0, [998, 999])
    assert contents(root) == contents(whole)
    assert not list(root.rglob(STAGING))


ITEMS = 300


def _stage_and_finalize(staging: Path, finalized: Path, first: int) -> None:
    for index in range(first, first + ITEMS):
        stage_item(staging / f"{index:06d}.json", b"{}")
        with locked(finalized.with_name("lock")):
            for path in staged_items(staging, ".json"):
                path.rename(finalized / path.name)
            with suppress(OSError):
                staging.rmdir()


@pytest.mark.ddp
def test_processes_stage_while_others_remove_the_folder(tmp_path):
    staging, finalized = tmp_path / STAGING, tmp_path / "finalized"
    finalized.mkdir()
    (tmp_path / "lock").touch()
    context = multiprocessing.get_context("fork")
    arguments = [(staging, finalized, first) for first in (0, ITEMS, 2 * ITEMS)]
    processes = [context.Process(target=_stage_and_finalize, args=args) for args in arguments]
    for process in processes:
        process.start()
    while any(process.is_alive() for process in processes):
        assert all(path.suffix == ".json" for path in staged_items(staging, ".json"))
    assert [process.exitcode for process in processes] == [0, 0, 0]
    numbers = [int(path.stem) for path in staged_items(finalized, ".json")]
    assert numbers == list(range(3 * ITEMS))
    assert not staging.exists()
