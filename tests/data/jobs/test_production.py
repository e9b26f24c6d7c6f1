"""Render jobs in one process: resuming, shards, records, a full disk. Processes: see the others."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from dopepp.core.errors import UserError
from dopepp.core.files import partial_path
from dopepp.core.interrupts import StoppedError
from dopepp.data.formats.bop.writer import BopWriter
from dopepp.data.formats.ndds.writer import NddsWriter
from dopepp.data.jobs.folder import RECORD_FILE
from dopepp.data.jobs.job import Job, make_job, named_part
from dopepp.data.jobs.progress import ProgressDisplay
from dopepp.data.jobs.render_dataset import RenderReport, render_dataset
from dopepp.data.jobs.work import WRITERS, Outcome, Shard, Task, Worker, plan

LAYOUTS = tuple(WRITERS)


class InlinePool:
    """Does every task at once, here; dies after some."""

    images_per_task = 3

    def __init__(self, content: bytes, dies_after: int | None = None) -> None:
        self._worker, self._left = Worker(content), dies_after

    def run(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        for task in tasks:
            if self._left == 0:
                raise KeyboardInterrupt
            self._left = None if self._left is None else self._left - 1
            yield self._worker.perform(task)


def inline(content: bytes, num_tasks: int) -> AbstractContextManager[InlinePool]:
    return nullcontext(InlinePool(content))


def small_job(layout: str = "bop", **options: Any) -> Job:
    return make_job(
        ["servoholder"], **{"preset": "quickstart", "size": "32x24", "layout": layout} | options
    )


def contents(root: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()
    }


@pytest.fixture(autouse=True)
def _small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    for module, name in WRITERS.values():
        monkeypatch.setattr(f"{module}.{name}.chunk_size", 8)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_whatever_stops_a_job_it_ends_with_the_same_files(layout: str, tmp_path: Path) -> None:
    job = small_job(layout)
    whole = render_dataset(job, tmp_path / "whole", 20, inline)
    assert (whole.num_images, whole.num_rendered, whole.num_unsealed) == (20, 20, 0)
    root = tmp_path / "stopped"
    for dies_after in (0, 2, 3):
        with pytest.raises(KeyboardInterrupt):
            render_dataset(
                job,
                root,
                20,
                lambda content, _: nullcontext(InlinePool(content, dies_after)),  # noqa: B023
            )
    last = render_dataset(job, root, 20, inline)
    assert 0 < last.num_rendered < 20
    assert contents(root) == contents(tmp_path / "whole")
    again = render_dataset(job, root, 20, inline)
    assert again.num_rendered == 0
    assert str(again) == "all 20 images were there"
    assert contents(root) == contents(tmp_path / "whole")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_job_grows(layout: str, tmp_path: Path) -> None:
    job = small_job(layout)
    render_dataset(job, tmp_path / "once", 19, inline)
    for num in (3, 11, 5, 19):
        render_dataset(job, tmp_path / "grown", num, inline)
    assert contents(tmp_path / "grown") == contents(tmp_path / "once")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_shards_share_a_folder_at_the_same_time(layout: str, tmp_path: Path) -> None:
    job, root = small_job(layout), tmp_path / "shards"
    render_dataset(job, tmp_path / "whole", 21, inline)
    reports: list[RenderReport] = []

    def others(done: int, total: int) -> None:
        if done == 3 and not reports:  # the first shard has begun: now run the others
            for number in (2, 1):
                reports.append(RenderReport(0))
                reports[-1] = render_dataset(job, root, 21, inline, Shard(number, 3))

    reports.append(render_dataset(job, root, 21, inline, Shard(0, 3), others))
    assert [report.num_images for report in reports] == [7, 7, 7]
    # 7 and 14 lie within chunks: the last to finish finalizes what it shares with its neighbours.
    assert [report.num_unsealed for report in reports] == [1, 1, 0]
    assert contents(root) == contents(tmp_path / "whole")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_shards_of_separate_folders_are_merged_by_copying(layout: str, tmp_path: Path) -> None:
    job = small_job(layout)
    merged: dict[str, bytes] = {}
    for number in range(2):  # each finalizes a chunk of its own, and they share one
        render_dataset(job, tmp_path / str(number), 24, inline, Shard(number, 2))
        merged |= contents(tmp_path / str(number))
    for name, content in merged.items():
        path = tmp_path / "merged" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    assert render_dataset(job, tmp_path / "merged", 24, inline).num_rendered == 0
    render_dataset(job, tmp_path / "whole", 24, inline)
    assert contents(tmp_path / "merged") == contents(tmp_path / "whole")


def test_a_full_disk_is_one_line_and_leaves_no_half_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, write = small_job("ndds"), Path.write_bytes
    render_dataset(job, tmp_path / "whole", 10, inline)
    room = [20_000]

    def write_what_fits(path: Path, content: bytes) -> int:
        room[0] -= len(content)
        if room[0] < 0:
            write(path, content[: len(content) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        return write(path, content)

    root = tmp_path / "full"
    monkeypatch.setattr(Path, "write_bytes", write_what_fits)
    with pytest.raises(StoppedError, match=r"no space left for .*full: free some; the same comm"):
        render_dataset(job, root, 10, inline)
    there, whole = contents(root), contents(tmp_path / "whole")
    assert 2 < len(there) < len(whole)
    assert all(whole[name] == content for name, content in there.items())
    monkeypatch.setattr(Path, "write_bytes", write)
    render_dataset(job, root, 10, inline)
    assert contents(root) == whole


def test_another_job_in_the_folder_is_refused_by_its_field(tmp_path: Path) -> None:
    render_dataset(small_job("ndds"), tmp_path, 2, inline)
    before = contents(tmp_path)
    for change, field in (
        ({"seed": 1}, "seed is 0 there and 1 now"),
        ({"layout": "bop"}, 'format is "ndds" there and "bop" now'),
        ({"size": "24x24"}, r"preset\.width is 32 there and 24 now"),
        ({"changes": ["lighting.tint=0.5"]}, r"preset\.lighting\.tint is .* now"),
        ({"preset": "paper"}, r'preset\.name is "quickstart" there and "paper" now'),
        ({"negatives": ["x=pivconnector"]}, r"negatives"),
    ):
        with pytest.raises(UserError, match=f"{RECORD_FILE} of another job: .*{field}"):
            render_dataset(small_job(**{"layout": "ndds"} | change), tmp_path, 2, inline)
    assert contents(tmp_path) == before


def test_changed_photos_and_meshes_are_another_job(tmp_path: Path) -> None:
    import cv2

    photos, mesh = tmp_path / "photos", tmp_path / "box.stl"
    photos.mkdir()
    picture = np.random.default_rng(0).integers(0, 255, (40, 40, 3), np.uint8)
    cv2.imwrite(str(photos / "a.png"), picture)
    triangles = [[(0, 0, 0), (90, 0, 0), (0, 80, 0)], [(0, 0, 0), (0, 80, 0), (0, 0, 70)]]

    def write_mesh(scale: float) -> None:
        lines = ["solid box"]
        for triangle in triangles:
            lines += ["facet normal 0 0 0", "outer loop"]
            lines += ["vertex {} {} {}".format(*(scale * x for x in v)) for v in triangle]
            lines += ["endloop", "endfacet"]
        mesh.write_text("\n".join([*lines, "endsolid box"]))

    def job(unit: str = "mm") -> Job:
        options: dict[str, Any] = {"preset": "quickstart", "size": "32x24", "layout": "ndds"}
        return make_job([str(mesh)], unit=unit, backgrounds=photos, **options)

    write_mesh(1)
    render_dataset(job(), tmp_path / "out", 1, inline)
    for action, field in (
        (lambda: write_mesh(1.1), r"parts\[0\]\.diameter is 0\.12.* there and 0\.13.* now"),
        (
            lambda: cv2.imwrite(str(photos / "b.png"), picture),
            r'backgrounds\[1\] is "1" there and "2" now',
        ),
    ):
        action()
        with pytest.raises(UserError, match=field):
            render_dataset(job(), tmp_path / "out", 1, inline)
    write_mesh(1)
    with pytest.raises(UserError, match='unit is "mm" there and "cm" now'):
        render_dataset(job("cm"), tmp_path / "out", 1, inline)


@pytest.mark.parametrize(
    "content", ["", "[1]", '{"seed": NaN}', '{"seed": 1, "seed": 2}', "[" * 100_000, "{}"]
)
def test_a_damaged_record_is_a_user_error(content: str, tmp_path: Path) -> None:
    (tmp_path / RECORD_FILE).write_text(content)
    with pytest.raises(UserError, match=RECORD_FILE):
        render_dataset(small_job(), tmp_path, 2, inline)


def test_a_folder_with_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.pdf").touch()
    with pytest.raises(UserError, match=r"holds 'thesis\.pdf' and no"):
        render_dataset(small_job(), tmp_path, 2, inline)
    with pytest.raises(UserError, match="Not a directory"):
        render_dataset(small_job(), tmp_path / "thesis.pdf" / "x", 2, inline)


def test_only_abandoned_partial_files_are_removed(tmp_path: Path) -> None:
    job = small_job("ndds")
    render_dataset(job, tmp_path, 2, inline)
    mine = partial_path(tmp_path / "000009.png")
    dead = mine.with_name(mine.name.replace(f"-{os.getpid()}.", "-999999999."))
    elsewhere = tmp_path / f".000009.png.0123abcd-{os.getpid()}.partial"
    old = tmp_path / ".000009.json.0123abcd-7.partial"
    for path in (mine, dead, elsewhere, old):
        path.touch()
    os.utime(old, (0, 0))
    render_dataset(job, tmp_path, 2, inline)
    assert mine.exists()  # its process runs
    assert elsewhere.exists()  # on another machine somebody may be writing it
    assert not dead.exists()
    assert not old.exists()


@given(st.integers(1, 300), st.integers(1, 40))
def test_shards_cover_every_image_once(num_items: int, total: int) -> None:
    spans = [Shard(number, total).span(num_items) for number in range(total)]
    assert [index for span in spans for index in span] == list(range(num_items))
    assert max(map(len, spans)) - min(map(len, spans)) <= 1


@given(st.integers(1, 60), st.integers(1, 5), st.sets(st.integers(0, 70)))
def test_a_plan_has_what_is_missing(num_items: int, total: int, written: set[int]) -> None:
    writer = NddsWriter(Path("unused"), [])
    size = writer.chunk_size
    writer.written = lambda chunk: {i for i in written if i // size == chunk}  # type: ignore[method-assign]
    planned: list[int] = []
    for number in range(total):
        chunks = list(plan(writer, Shard(number, total), num_items))
        planned += [index for chunk in chunks for index in chunk.missing]
        for chunk in chunks:
            assert set(chunk.required) == {i for i in range(num_items) if i // size == chunk.number}
    assert planned == sorted(set(range(num_items)) - written)


@pytest.mark.parametrize("text", ["3/2", "2/2", "1", "-1/2", "1/0", "0/0", "a/b", "", "1/2/3"])
def test_a_shard_that_is_none(text: str) -> None:
    with pytest.raises(UserError, match="i/n with 0 <= i < n"):
        Shard.parse(text)


@pytest.mark.parametrize("num", [0, -5, 10**9 + 1])
def test_a_count_that_cannot_be(num: int, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=f"-n {num}; allowed: 1 to 1,000,000,000"):
        render_dataset(small_job(), tmp_path / "out", num, inline)
    assert not (tmp_path / "out").exists()


def test_a_part_can_be_given_a_name(tmp_path: Path) -> None:
    assert named_part("left=servoholder", None).name == "left"
    names = [part.name for part in make_job(["a=servoholder", "b=pivconnector"]).factory.parts]
    assert names == ["a", "b"]
    with pytest.raises(UserError, match="no such file"):
        named_part("left=/nowhere/x.stl", "mm")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["lighting"], "allowed: FIELD.FIELD=VALUE"),
        (["lighting.=1"], "allowed: FIELD.FIELD=VALUE"),
        (["lighting.tint=["], "allowed: FIELD.FIELD=VALUE"),
        (["lighting.tint=0.1", "lighting.tint=0.2"], "after another --set"),
        (["lighting.tint=0.1", "lighting=1"], "after another --set"),
        (["width=64", "width.x=1"], "after another --set"),
        (["lighting.colour=1"], "'colour' in"),
        (["lighting.tint=blue"], "'blue' for tint"),
    ],
)
def test_changes_that_cannot_be_made(changes: list[str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        make_job(["servoholder"], changes=changes)


def test_changes_reach_the_preset() -> None:
    preset = small_job(changes=["lighting.num_lights=[2,3]", "min_visible_fraction=0.25"])
    assert preset.factory.preset.lighting.num_lights == (2, 3)
    assert preset.factory.preset.min_visible_fraction == 0.25
    assert preset.record["preset"]["lighting"]["num_lights"] == [2, 3]
    json.dumps(preset.record, allow_nan=False)


def test_a_defect_comes_with_its_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(NddsWriter, "write", lambda *_: dict[str, str]()["defect"])
    with pytest.raises(RuntimeError, match=r"(?s)test_production\.py.*KeyError: 'defect'"):
        render_dataset(small_job("ndds"), tmp_path, 2, inline)


def test_a_part_that_the_preset_cannot_show_is_one_line(tmp_path: Path) -> None:
    small = ["horizontal_fov_deg=5", "placement.lateral=0", "min_visible_fraction=0.95"]
    job = small_job(preset="paper", changes=small)
    with pytest.raises(UserError, match="part servoholder"):
        render_dataset(job, tmp_path / "out", 2, inline)
    assert not (tmp_path / "out").exists()


def test_a_folder_that_a_machine_does_not_see(tmp_path: Path) -> None:
    import pickle

    from dopepp.data.jobs.work import Work

    worker = Worker(pickle.dumps(Work(small_job().factory, "bop", tmp_path)))
    outcome = worker.perform(Task(0, range(1)))
    assert isinstance(outcome.error, UserError)
    assert "as one of the workers sees it" in str(outcome.error)


def test_the_bar_shows_count_rate_and_time_left() -> None:
    console = Console(file=StringIO(), force_terminal=True, width=120)
    with ProgressDisplay(console) as progress:
        progress(3, 10)
        progress(7, 10)
    assert isinstance(console.file, StringIO)
    shown = console.file.getvalue()
    assert "7/10" in shown
    assert "left" in shown


def test_without_a_terminal_lines_go_to_the_log(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([100.0, 100.0, 110.0, 140.0, 145.0])
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    with caplog.at_level("INFO"), ProgressDisplay(Console(file=StringIO())) as progress:
        for done in (20, 20, 100, 110):
            progress(done, 1300)
    (message,) = caplog.messages
    assert "100 of 1,300" in message
    assert "10 min" in message


def test_a_report_says_what_it_cost() -> None:
    said = str(RenderReport(100, 50, 0, 10.0, 1.0, 0.5))
    assert "50 of 100" in said
    assert "5.0 images/s" in said
    assert "30.0 CPU-ms" in said


def test_writers_agree_on_the_names() -> None:
    assert {BopWriter.name, NddsWriter.name} <= set(LAYOUTS)
