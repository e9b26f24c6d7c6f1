"""Make a data set: render what is missing, finalize what is complete, and show how far it is."""

from __future__ import annotations

import logging
import pickle
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rich import progress as shown
from rich.console import Console
from rich.text import Text

from dopepp.core.errors import UserError
from dopepp.core.futures import available_cores
from dopepp.core.interrupts import stopped
from dopepp.data.jobs.job import Job, begin, is_begun
from dopepp.data.jobs.pools import ClusterPool, Pool, ProcessPool
from dopepp.data.jobs.work import Chunk, Outcome, Shard, Task, plan
from dopepp.data.sources.rendered import MAX_ITEMS

_log = logging.getLogger(__name__)

ENGINES: Final = ("local", "ray")

MAX_WORKERS: Final = 1024
"""More processes than any machine here has cores: a slip of the keyboard."""

_LINE_EVERY_S: Final = 30.0

OpenPool = Callable[[bytes, int], Pool]
"""From a pickled job with its folder and a number of tasks to a pool."""

OnProgress = Callable[[int, int], None]
"""Told how many of how many images are there, once at the start and then whenever some came."""


@dataclass(frozen=True)
class RenderRequest:
    """How much of a job is done here, and by whom; it decides none of the bytes.

    Attributes:
        num: Images of the whole job.
        shard: ``i/n``.
        workers: Processes; None for one per core.
        engine: One of :data:`ENGINES`.
    """

    out: Path
    num: int | None
    shard: str = "0/1"
    workers: int | None = None
    engine: str = "local"
    ray_address: str | None = None


@dataclass
class RenderReport:
    """What a run has done.

    Attributes:
        num_images: Images of the shard, all there now.
        num_rendered: Those that this run made.
        render_s: CPU seconds of rendering.
        write_s: CPU seconds of encoding and writing.
    """

    num_images: int
    num_rendered: int = 0
    wall_s: float = 0.0
    render_s: float = 0.0
    write_s: float = 0.0

    def __str__(self) -> str:
        if not self.num_rendered:
            return f"all {self.num_images:,} images were there"
        ms = 1000 / self.num_rendered
        return (
            f"{self.num_rendered:,} of {self.num_images:,} images rendered in {self.wall_s:.0f} s: "
            f"{self.num_rendered / self.wall_s:.1f} images/s, "
            f"{ms * (self.render_s + self.write_s):.1f} CPU-ms an image "
            f"(rendering {ms * self.render_s:.1f}, writing {ms * self.write_s:.1f})"
        )


def run(job: Job, request: RenderRequest) -> RenderReport:
    """Render what is missing and show the progress on stderr."""
    if request.num is None:
        raise UserError("no -n", "the number of images, or --preview", "add -n 1000")
    shard, open_pool = Shard.parse(request.shard), _engine(request)
    with ProgressDisplay(Console(stderr=True)) as progress:
        return render_dataset(job, request.out, request.num, open_pool, shard, progress)


def _engine(request: RenderRequest) -> OpenPool:
    """Return what opens the pool, after checking what can be checked without it."""
    workers = available_cores() if request.workers is None else request.workers
    if not 1 <= workers <= MAX_WORKERS:
        raise UserError(f"--workers {workers}", f"1 to {MAX_WORKERS}", "change --workers")
    if request.engine not in ENGINES:
        raise UserError(f"--engine {request.engine}", ", ".join(ENGINES), "choose one of them")
    if request.engine == "ray":
        return lambda content, _: ClusterPool(content, request.ray_address, workers)
    if request.ray_address is not None:
        raise UserError(
            f"--ray-address {request.ray_address} with --engine local", "it goes with ray",
            "add --engine ray",
        )  # fmt: skip
    return lambda content, num_tasks: ProcessPool(content, min(workers, max(num_tasks, 1)))


def render_dataset(
    job: Job,
    root: Path,
    num_items: int,
    open_pool: OpenPool,
    shard: Shard | None = None,
    on_progress: OnProgress = lambda done, total: None,
) -> RenderReport:
    """Bring a folder to ``num_items`` images, or to one shard of them.

    What is there is kept: whatever stopped an earlier run, this one goes on. Several shards may
    share the folder at the same time; whoever completes a chunk finalizes it. A StoppedError: the
    disk is full or a worker died.
    """
    if not 1 <= num_items <= MAX_ITEMS:
        raise UserError(f"-n {num_items}", f"1 to {MAX_ITEMS:,} images", "change -n")
    root, shard = root.resolve(), shard or Shard()
    if not is_begun(root):
        # A preset that cannot show the part is found out before anything is written.
        job.factory.scene(0, 0)
    begin(root, job.record)
    start = time.monotonic()
    try:
        writer = job.writer(root)
        writer.prepare()
        run = _Run(list(plan(writer, shard, num_items)), RenderReport(len(shard.span(num_items))))
        on_progress(run.num_there, run.report.num_images)
        with open_pool(pickle.dumps((job, root)), run.num_tasks) as pool:
            # Renders and, between them, finalizes; then the finalizes of what was rendered last.
            for tasks in (run.tasks(pool.images_per_task), run.finalizes()):
                for outcome in pool.run(tasks):
                    run.note(outcome)
                    on_progress(run.num_there, run.report.num_images)
    except OSError as error:
        raise stopped(error, root) from error
    run.report.wall_s = time.monotonic() - start
    return run.report


class _Run:
    """What is left to do, and what has been done."""

    def __init__(self, chunks: list[Chunk], report: RenderReport) -> None:
        self.report = report
        self._chunks = {chunk.number: chunk for chunk in chunks}
        self._left = {chunk.number: len(chunk.missing) for chunk in chunks}
        # Complete already, but maybe not finalized: finalizing is idempotent.
        self._complete = deque(number for number, left in self._left.items() if not left)
        self.num_tasks = sum(self._left.values()) + len(self._complete)
        self.num_there = report.num_images - sum(self._left.values())

    def tasks(self, images_per_task: int) -> Iterator[Task]:
        """Yield all renders and, between them, the finalizes of chunks that are complete."""
        for chunk in self._chunks.values():
            for first in range(0, len(chunk.missing), images_per_task):
                yield from self.finalizes()
                yield Task(chunk.number, chunk.missing[first : first + images_per_task])

    def finalizes(self) -> Iterator[Task]:
        """Yield the finalizes of chunks that are complete by now."""
        while self._complete:
            number = self._complete.popleft()
            yield Task(number, self._chunks[number].required, finalizes=True)

    def note(self, outcome: Outcome) -> None:
        """Count an outcome."""
        task, report = outcome.task, self.report
        if outcome.error is not None:
            raise outcome.error
        if task.finalizes:
            return
        report.render_s += outcome.render_s
        report.write_s += outcome.write_s
        report.num_rendered += len(task.indices)
        self.num_there += len(task.indices)
        self._left[task.chunk] -= len(task.indices)
        if not self._left[task.chunk]:
            self._complete.append(task.chunk)


class ProgressDisplay:
    """An :data:`OnProgress`, while it is entered: a bar, or without a terminal lines in the log."""

    def __init__(self, console: Console) -> None:
        self._bar = shown.Progress(
            "rendering", shown.BarColumn(), shown.MofNCompleteColumn(), _RateColumn(),
            shown.TimeElapsedColumn(), "left", shown.TimeRemainingColumn(),
            console=console, disable=not console.is_terminal,
        )  # fmt: skip
        self._first: int | None = None
        self._start = self._last = 0.0

    def __enter__(self) -> ProgressDisplay:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def __call__(self, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` images are there."""
        now = time.monotonic()
        if self._first is None:
            # What an earlier run made is no part of this one's rate.
            self._first, self._start, self._last = done, now, now
            self._bar.add_task("", completed=done, total=total)
        self._bar.update(self._bar.task_ids[0], completed=done)
        if self._bar.disable and now - self._last >= _LINE_EVERY_S and done > self._first:
            self._last = now
            rate = (done - self._first) / (now - self._start)
            left = (total - done) / rate / 60
            _log.info(
                "%s of %s images, %.1f/s, %.0f min left", f"{done:,}", f"{total:,}", rate, left
            )


class _RateColumn(shown.ProgressColumn):
    """Images per second, of the last half minute; nothing while it is unknown."""

    def render(self, task: shown.Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{speed:.1f}/s" if speed else "", style="progress.data.speed")
