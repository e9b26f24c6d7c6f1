"""Writers, sealers and a reader of one folder of staged items, which comes and goes."""

from __future__ import annotations

import multiprocessing
from pathlib import Path

import pytest

from dopepp.data.formats import STAGING, finalizing, stage, staged_items

ITEMS = 300


def _stage_and_seal(staging: Path, finalized: Path, first: int) -> None:
    for index in range(first, first + ITEMS):
        stage(staging / f"{index:06d}.json", b"{}")
        with finalizing(staging):
            for path in staged_items(staging, ".json"):
                path.rename(finalized / path.name)


@pytest.mark.ddp
def test_nobody_stumbles_over_a_folder_that_vanishes(tmp_path: Path) -> None:
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


def test_a_file_in_the_way_is_an_error(tmp_path: Path) -> None:
    (tmp_path / STAGING).write_text("not a folder")
    with pytest.raises(FileExistsError), finalizing(tmp_path / STAGING):
        pass
