"""Render a data set: render missing images, finalize complete chunks, and show the progress.

Finalizing a complete chunk writes the files that its images share. A shard is a contiguous part of
the job, which may begin and end within a chunk.
"""

from __future__ import annotations

import logging
import os
import pickle
import re
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import cv2
from rich import progress as rich_progress
from rich.console import Console
from rich.text import Text

from dopepp.core.errors import StoppedError, UserError, check_choice, system_failure
from dopepp.core.pool import ClusterPool, LostWorkerError, Pool, ProcessPool, available_cores
from dopepp.core.validation import Range, check
from dopepp.data.formats import RECORD_FILE, Writer
from dopepp.data.render_job import RenderJob, claim, is_claimed
from dopepp.data.rendered import MAX_ITEMS
from dopepp.virtual.renderers.photoreal import THREADS_SETTING

_log = logging.getLogger(__name__)

ENGINES: Final = ("local", "ray")
MAX_WORKERS: Final = 1024  # no machine has more cores: a larger number is a typing error
_LINE_EVERY_S: Final = 30.0  # interval of progress lines in the log

OpenPool = Callable[[bytes], Pool]
"""Opens a pool for the pickled :class:`RenderTasks` of a job."""

OnProgress = Callable[[int, int], None]
"""Receives the numbers of finished and of all images, at the start and after each task."""


@dataclass
class RenderReport:
    """Numbers of images and times of a rendering run."""

    num_images: int  # images of the shard
    num_rendered: int = 0  # images rendered by this run
    wall_s: float = 0.0
    render_s: float = 0.0  # CPU seconds of rendering
    write_s: float = 0.0  # CPU seconds of encoding and writing

    def __str__(self) -> str:
        if not self.num_rendered:
            return f"all {self.num_images:,} images exist already"
        render_ms, write_ms = (
            1000 * seconds / self.num_rendered for seconds in (self.render_s, self.write_s)
        )
        return (
            f"{self.num_rendered:,} of {self.num_images:,} images rendered in {self.wall_s:.0f} s: "
            f"{self.num_rendered / self.wall_s:.1f} images/s, {render_ms + write_ms:.1f} CPU-ms an "
            f"image (rendering {render_ms:.1f}, writing {write_ms:.1f})"
        )


def run(
    job: RenderJob,
    out: Path,
    num: int | None,
    shard: str = "0/1",
    workers: int | None = None,
    engine: str = "local",
    ray_address: str | None = None,
) -> RenderReport:
    """Render the images of a job that its folder lacks, and show the progress on stderr.

    The arguments are the options of ``dopepp render``: ``num`` images in the whole job, of which
    the part ``shard`` (``i/n``) is rendered by ``workers`` processes (default: one per core).
    Without an address (``host:port``), the engine ``ray`` starts a cluster on this machine.

    Raises:
        UserError: An argument is invalid, or the folder holds another job or other files.
        StoppedError: The disk is full, or a worker has died.
    """
    if num is None:
        raise UserError("no number of images", "-n NUMBER, or --preview", "add e.g. -n 1000")
    part, workers = Shard.parse(shard), available_cores() if workers is None else workers
    num_workers = check("--workers", workers, int, Range(1, MAX_WORKERS))
    check_choice("--engine", engine, ENGINES)
    if engine != "ray" and ray_address is not None:
        problem = f"--ray-address {ray_address} with --engine {engine}"
        raise UserError(problem, "an address together with --engine ray", "add --engine ray")

    def open_pool(content: bytes) -> Pool:
        if engine == "ray":
            return ClusterPool(content, ray_address, num_workers)
        return ProcessPool(content, num_workers)

    with ProgressDisplay(Console(stderr=True)) as progress:
        return render_dataset(job, out, num, open_pool, part, progress)


@dataclass(frozen=True)
class Shard:
    """Part ``number`` (from 0) of ``total`` equal and contiguous parts of a job."""

    number: int = 0
    total: int = 1

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Parse ``i/n`` with i from 0 to n − 1.

        Raises:
            UserError: The text has another form, or i is not below n.
        """
        match = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
        if match is None or int(match[1]) >= int(match[2]):
            allowed = "i/n with 0 <= i < n: 0/2 and 1/2 are the two halves"
            raise UserError(f"shard {text!r}", allowed, "count the shards from 0")
        return cls(int(match[1]), int(match[2]))

    def span(self, num_items: int) -> range:
        """Return the shard's indices in a job of ``num_items`` images."""
        first, last = num_items * self.number, num_items * (self.number + 1)
        return range(first // self.total, last // self.total)


@dataclass(frozen=True)
class Chunk:
    """The part of a chunk that a shard renders."""

    number: int
    required: range  # the job's images in the chunk, from all shards, needed to finalize the chunk
    missing: Sequence[int]  # the shard's images in the chunk that are not rendered


def plan_chunks(writer: Writer, shard: Shard, num_items: int) -> Iterator[Chunk]:
    """Yield the chunks that a shard overlaps, in order, including complete chunks."""
    span, size = shard.span(num_items), writer.chunk_size
    for number in range(span.start // size, -(-span.stop // size) if span else 0):
        required = range(number * size, min((number + 1) * size, num_items))
        part = range(max(span.start, required.start), min(span.stop, required.stop))
        written = writer.written(number)
        missing = [index for index in part if index not in written] if written else part
        yield Chunk(number, required, missing)


@dataclass(frozen=True)
class RenderTask:
    """Images to render and write, or a chunk to finalize."""

    chunk: int
    indices: Sequence[int]  # images to render, or images required for finalizing
    finalizes: bool = False


class RenderTasks:
    """Callable that performs the tasks of a job in a process of a pool, on one thread."""

    def __init__(self, job: RenderJob, root: Path) -> None:
        self._job, self._root = job, root

    def __call__(self, task: RenderTask) -> tuple[float, float]:
        """Perform a task; return the CPU seconds of rendering and of encoding and writing."""
        writer = self._writer
        if task.finalizes:
            written = writer.written(task.chunk)
            # Otherwise other shards still render images of the chunk.
            if written.issuperset(task.indices):
                writer.finalize(task.chunk, sorted(written))
            return 0.0, 0.0
        render_s = write_s = 0.0
        for index in task.indices:
            start = time.process_time()
            sample = self._job.sample(index)
            middle = time.process_time()
            writer.write(index, sample)
            render_s += middle - start
            write_s += time.process_time() - middle
        return render_s, write_s

    @cached_property
    def _writer(self) -> Writer:
        cv2.setNumThreads(1)
        os.environ.setdefault(THREADS_SETTING, "1")
        if not is_claimed(self._root):
            problem = f"{self._root}, in which a worker finds no {RECORD_FILE}"
            allowed = "a folder with the same path on every machine of the cluster"
            raise UserError(problem, allowed, "pass an --out on a shared file system")
        return self._job.writer(self._root)


def render_dataset(
    job: RenderJob,
    root: Path,
    num_items: int,
    open_pool: OpenPool,
    shard: Shard | None = None,
    on_progress: OnProgress = lambda done, total: None,
) -> RenderReport:
    """Render the missing ones of a job's ``num_items`` images, or of a shard, into a folder.

    Existing images are kept, so a run resumes after any interruption. Several shards may share the
    folder simultaneously; the shard that completes a chunk finalizes it.

    Raises:
        UserError: The number is out of range, or the folder holds another job or other files.
        StoppedError: The disk is full, or a worker has died.
    """
    if not 1 <= num_items <= MAX_ITEMS:
        raise UserError(f"-n {num_items}", f"1 to {MAX_ITEMS:,} images", "pass e.g. -n 1000")
    root, shard = root.resolve(), shard or Shard()
    if not is_claimed(root):
        # This fails before anything is written if the preset cannot show the part.
        job.factory.scene(0, 0)
    claim(root, job.record)
    start = time.monotonic()
    try:
        writer = job.writer(root)
        writer.prepare()
        chunks = list(plan_chunks(writer, shard, num_items))
        run = _Run(chunks, RenderReport(len(shard.span(num_items))))
        on_progress(run.num_done, run.report.num_images)
        with open_pool(pickle.dumps(RenderTasks(job, root))) as pool:
            # Render tasks with finalizing tasks in between, then the remaining finalizing tasks.
            for tasks in (run.render_tasks(pool.batch_size), run.finalizing_tasks()):
                for task, future in pool.run(tasks):
                    run.count(task, *future.result())
                    on_progress(run.num_done, run.report.num_images)
    except LostWorkerError as error:
        raise StoppedError(str(error)) from error
    except OSError as error:
        raise StoppedError(system_failure(error, root)) from error
    run.report.wall_s = time.monotonic() - start
    return run.report


class _Run:
    """Remaining tasks of a rendering run, and the report of finished tasks."""

    def __init__(self, chunks: list[Chunk], report: RenderReport) -> None:
        self.report = report
        self._chunks = {chunk.number: chunk for chunk in chunks}
        self._num_missing = {chunk.number: len(chunk.missing) for chunk in chunks}
        # Complete chunks may lack finalizing, which is idempotent.
        self._complete = deque(number for number, num in self._num_missing.items() if not num)
        self.num_done = report.num_images - sum(self._num_missing.values())

    def render_tasks(self, images_per_task: int) -> Iterator[RenderTask]:
        """Yield the tasks that render images, and tasks that finalize each completed chunk."""
        for chunk in self._chunks.values():
            for first in range(0, len(chunk.missing), images_per_task):
                yield from self.finalizing_tasks()
                yield RenderTask(chunk.number, chunk.missing[first : first + images_per_task])

    def finalizing_tasks(self) -> Iterator[RenderTask]:
        """Yield a task for each chunk that has been completed and not been finalized."""
        while self._complete:
            number = self._complete.popleft()
            yield RenderTask(number, self._chunks[number].required, finalizes=True)

    def count(self, task: RenderTask, render_s: float, write_s: float) -> None:
        if task.finalizes:
            return
        self.report.render_s += render_s
        self.report.write_s += write_s
        self.report.num_rendered += len(task.indices)
        self.num_done += len(task.indices)
        self._num_missing[task.chunk] -= len(task.indices)
        if not self._num_missing[task.chunk]:
            self._complete.append(task.chunk)


class ProgressDisplay:
    """Context manager that shows progress as a bar or, without a terminal, as lines in the log."""

    def __init__(self, console: Console) -> None:
        self._bar = rich_progress.Progress(
            "rendering",
            rich_progress.BarColumn(),
            rich_progress.MofNCompleteColumn(),
            _RateColumn(),
            rich_progress.TimeElapsedColumn(),
            "left",
            rich_progress.TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._first: int | None = None
        self._start = self._last = 0.0

    def __enter__(self) -> ProgressDisplay:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def __call__(self, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` images exist."""
        now = time.monotonic()
        if self._first is None:
            # Images of an earlier run do not count in the rate.
            self._first, self._start, self._last = done, now, now
            self._bar.add_task("", completed=done, total=total)
        self._bar.update(self._bar.task_ids[0], completed=done)
        if self._bar.disable and now - self._last >= _LINE_EVERY_S and done > self._first:
            self._last = now
            rate = (done - self._first) / (now - self._start)
            left = (total - done) / rate / 60
            _log.info("%s images, %.1f/s, %.0f min left", f"{done:,} of {total:,}", rate, left)


class _RateColumn(rich_progress.ProgressColumn):
    """Images per second over the last half minute; empty while unknown."""

    def render(self, task: rich_progress.Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{speed:.1f}/s" if speed else "", style="progress.data.speed")
