"""Render jobs in one process: resuming, shards, records and a full disk."""

import errno
import json
import os
import shutil
from concurrent.futures import Future
from functools import partial
from io import StringIO
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from dopepp.core.errors import StoppedError, UserError
from dopepp.core.files import partial_path
from dopepp.core.pool import PickledFunction, Pool, unpickle_answer
from dopepp.data.formats import RECORD_FILE
from dopepp.data.formats.ndds.ndds_writer import NddsWriter
from dopepp.data.render_job import WRITERS, make_job, named_part
from dopepp.data.render_run import ProgressDisplay, RenderReport, Shard, plan_chunks, render_dataset
from tests.data.makers import contents, small_job

NUM = 10


class InlinePool(Pool):
    """Performs tasks in this process; may be interrupted after some tasks."""

    batch_size = 2

    def __init__(self, content: bytes, dies_after: int | None = None) -> None:
        self._function, self._left = PickledFunction(content), dies_after

    def __exit__(self, *_: object) -> None: ...

    def capacity(self) -> int:
        return 1

    def submit(self, item: object) -> Future[object]:
        if self._left == 0:
            raise KeyboardInterrupt
        self._left = None if self._left is None else self._left - 1
        future: Future[object] = Future()
        try:
            future.set_result(unpickle_answer(self._function(item)))
        except Exception as error:
            future.set_exception(error)
        return future


@pytest.fixture(scope="module", params=WRITERS)
def layout(request):
    """A layout, with chunks of four images."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(WRITERS[request.param], "chunk_size", 4)
        yield request.param


@pytest.fixture(scope="module")
def job(layout):
    return small_job(layout)


@pytest.fixture(scope="module")
def whole(job, tmp_path_factory):
    """The files of a job that ran without an interruption."""
    root = tmp_path_factory.mktemp("whole")
    report = render_dataset(job, root, NUM, InlinePool)
    assert (report.num_images, report.num_rendered) == (NUM, NUM)
    return contents(root)


def test_an_interrupted_job_writes_the_same_files(job, tmp_path, whole):
    for dies_after in (0, 2, 3):
        with pytest.raises(KeyboardInterrupt):
            render_dataset(job, tmp_path, NUM, partial(InlinePool, dies_after=dies_after))
    assert 0 < render_dataset(job, tmp_path, NUM, InlinePool).num_rendered < NUM
    assert contents(tmp_path) == whole
    again = render_dataset(job, tmp_path, NUM, InlinePool)
    assert (again.num_rendered, str(again)) == (0, f"all {NUM} images exist already")
    assert contents(tmp_path) == whole


def test_a_job_can_be_extended(job, tmp_path, whole):
    for num in (2, 5, 3, NUM):
        render_dataset(job, tmp_path, num, InlinePool)
    assert contents(tmp_path) == whole


def test_simultaneous_shards_share_a_folder(job, tmp_path, whole):
    # Shards begin and end within chunks; the last shard of a chunk finalizes it.
    others = []

    def run_others(done, total):
        if done == 2 and not others:  # the first shard has begun
            for number in (2, 1):
                others.append(RenderReport(0))
                others[-1] = render_dataset(job, tmp_path, NUM, InlinePool, Shard(number, 3))

    first = render_dataset(job, tmp_path, NUM, InlinePool, Shard(0, 3), run_others)
    assert [report.num_rendered for report in (first, *others)] == [3, 4, 3]
    assert contents(tmp_path) == whole


def test_shards_of_separate_folders_are_merged_by_copying(job, tmp_path, whole):
    for number in range(2):  # each finalizes a chunk of its own, and they share one
        render_dataset(job, tmp_path / str(number), NUM, InlinePool, Shard(number, 2))
        shutil.copytree(tmp_path / str(number), tmp_path / "merged", dirs_exist_ok=True)
    assert render_dataset(job, tmp_path / "merged", NUM, InlinePool).num_rendered == 0
    assert contents(tmp_path / "merged") == whole


def test_a_full_disk_is_one_line_and_no_partial_file(job, tmp_path, monkeypatch, whole):
    # Enough space for the parts' meshes and for half of the other files.
    write = Path.write_bytes
    room = [sum(len(whole[name]) for name in whole if not name.startswith("models")) // 2]

    def write_what_fits(path, content):
        room[0] -= 0 if path.parent.name == "models" else len(content)
        if room[0] >= 0:
            return write(path, content)
        write(path, content[: len(content) // 2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(Path, "write_bytes", write_what_fits)
    message = rf"no space left for {tmp_path}: .* run the same command again"
    with pytest.raises(StoppedError, match=message):
        render_dataset(job, tmp_path, NUM, InlinePool)
    monkeypatch.undo()
    assert len(contents(tmp_path)) > 2
    assert not list(tmp_path.rglob("*.partial"))
    assert 0 < render_dataset(job, tmp_path, NUM, InlinePool).num_rendered < NUM
    assert contents(tmp_path) == whole


def test_another_job_in_the_folder_is_rejected_with_the_field(tmp_path):
    render_dataset(small_job("ndds"), tmp_path, 2, InlinePool)
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
            render_dataset(small_job(**{"layout": "ndds"} | change), tmp_path, 2, InlinePool)
    assert contents(tmp_path) == before


def test_changed_photos_and_meshes_are_another_job(tmp_path):
    photos, mesh = tmp_path / "photos", tmp_path / "box.stl"
    photos.mkdir()

    def add_photo(name):
        image = np.random.default_rng(0).integers(0, 255, (40, 40, 3), np.uint8)
        cv2.imwrite(str(photos / name), image)

    def render(scale=1.0, unit="mm"):
        trimesh.creation.box(np.array([90, 80, 70]) * scale).export(mesh)
        options = {"preset": "quickstart", "size": "32x24", "layout": "ndds", "unit": unit}
        job = make_job([str(mesh)], backgrounds=photos, **options)
        render_dataset(job, tmp_path / "out", 1, InlinePool)

    add_photo("a.png")
    render()
    with pytest.raises(UserError, match=r"parts\[0\]\.diameter is 0\.139.* there and 0\.153.* now"):
        render(1.1)
    with pytest.raises(UserError, match='unit is "mm" there and "cm" now'):
        render(unit="cm")
    add_photo("b.png")
    with pytest.raises(UserError, match=r'backgrounds\[1\] is "1" there and "2" now'):
        render()


@pytest.mark.parametrize(
    "content", ["", "[1]", '{"seed": NaN}', '{"seed": 1, "seed": 2}', "[" * 100_000, "{}"]
)
def test_a_damaged_record_is_a_user_error(content, tmp_path):
    (tmp_path / RECORD_FILE).write_text(content)
    with pytest.raises(UserError, match=RECORD_FILE):
        render_dataset(small_job(), tmp_path, 2, InlinePool)


def test_a_folder_of_other_files_is_rejected(tmp_path):
    (file := tmp_path / "thesis.pdf").touch()
    for folder, message in (tmp_path, r"holds 'thesis\.pdf' and no"), (file / "x", "Not a dir"):
        with pytest.raises(UserError, match=message):
            render_dataset(small_job(), folder, 2, InlinePool)


def test_only_abandoned_partial_files_are_removed(tmp_path):
    job = small_job("ndds")
    render_dataset(job, tmp_path, 2, InlinePool)
    mine = partial_path(tmp_path / "000009.png")
    dead = mine.with_name(mine.name.replace(f"-{os.getpid()}.", "-999999999."))
    elsewhere = tmp_path / f".000009.png.0123abcd-{os.getpid()}.partial"
    old = tmp_path / ".000009.json.0123abcd-7.partial"
    for path in (mine, dead, elsewhere, old):
        path.touch()
    os.utime(old, (0, 0))
    render_dataset(job, tmp_path, 2, InlinePool)
    # The process of the first file runs. Another machine may still write the third file.
    assert [path.exists() for path in (mine, dead, elsewhere, old)] == [True, False, True, False]


@given(st.integers(1, 300), st.integers(1, 40))
def test_shards_cover_every_image_once(num_items, total):
    spans = [Shard(number, total).span(num_items) for number in range(total)]
    assert [index for span in spans for index in span] == list(range(num_items))
    assert max(map(len, spans)) - min(map(len, spans)) <= 1


@given(st.integers(1, 60), st.integers(1, 5), st.sets(st.integers(0, 70)))
def test_a_plan_lists_the_missing_images(num_items, total, written):
    writer = NddsWriter(Path("unused"), [])
    size = writer.chunk_size
    writer.written = lambda chunk: {i for i in written if i // size == chunk}
    planned = []
    for number in range(total):
        chunks = list(plan_chunks(writer, Shard(number, total), num_items))
        planned += [index for chunk in chunks for index in chunk.missing]
        for chunk in chunks:
            assert set(chunk.required) == {i for i in range(num_items) if i // size == chunk.number}
    assert planned == sorted(set(range(num_items)) - written)


@pytest.mark.parametrize("text", ["3/2", "2/2", "1", "-1/2", "1/0", "0/0", "a/b", "", "1/2/3"])
def test_an_invalid_shard_is_rejected(text):
    with pytest.raises(UserError, match="i/n with 0 <= i < n"):
        Shard.parse(text)


def test_a_part_can_be_given_a_name(tmp_path):
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
        (["lighting.tint=blue"], "lighting.tint='blue'"),
    ],
)
def test_invalid_changes_are_rejected(changes, message):
    with pytest.raises(UserError, match=message):
        make_job(["servoholder"], changes=changes)


def test_changes_reach_the_preset():
    job = small_job(changes=["lighting.num_lights=[2,3]", "min_visible_fraction=0.25"])
    preset = job.factory.preset
    assert (preset.lighting.num_lights, preset.min_visible_fraction) == ((2, 3), 0.25)
    assert tuple(job.record["preset"]["lighting"]["num_lights"]) == (2, 3)
    json.dumps(job.record, allow_nan=False)


def test_an_internal_error_keeps_its_traceback(tmp_path, monkeypatch):
    monkeypatch.setattr(NddsWriter, "write", lambda *_: dict[str, str]()["defect"])
    with pytest.raises(RuntimeError, match=r"(?s)test_rendering\.py.*KeyError: 'defect'"):
        render_dataset(small_job("ndds"), tmp_path, 2, InlinePool)


def test_the_bar_shows_count_rate_and_time_left():
    shown = StringIO()
    with ProgressDisplay(Console(file=shown, force_terminal=True, width=120)) as progress:
        for done in (3, 7):
            progress(done, 10)
    assert all(text in shown.getvalue() for text in ("7/10", "left"))


def test_without_a_terminal_lines_go_to_the_log(caplog, monkeypatch):
    clock = iter([100.0, 110.0, 140.0, 145.0])
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    with caplog.at_level("INFO"), ProgressDisplay(Console(file=StringIO())) as progress:
        for done in (20, 20, 100, 110):
            progress(done, 1300)
    (message,) = caplog.messages
    assert all(text in message for text in ("100 of 1,300", "10 min"))
