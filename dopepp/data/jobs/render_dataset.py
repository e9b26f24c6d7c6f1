"""What the command line asks for, checked, and who does it.

Make a data set: render what is missing, finalize what is complete.
"""

from __future__ import annotations

import pickle
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final, Protocol

from rich.console import Console

from dopepp.core.errors import UserError
from dopepp.core.interrupts import stopped
from dopepp.data.jobs.folder import begin, is_begun
from dopepp.data.jobs.job import Job
from dopepp.data.jobs.processes import ProcessPool, available_cores, check_workers
from dopepp.data.jobs.progress import ProgressDisplay
from dopepp.data.jobs.work import Chunk, Outcome, Shard, Task, Work, check_count, plan


class Pool(Protocol):
    """Does tasks somewhere, several at once."""

    images_per_task: int
    """As few as the cost of handing out a task allows: less is lost when it is interrupted."""

    def run(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        """Do tasks, in any order, and yield their outcomes; ``tasks`` is read as needed."""


OpenPool = Callable[[bytes, int], AbstractContextManager[Pool]]
"""From a pickled :class:`Work` and a number of tasks to a pool."""

Progress = Callable[[int, int], None]
"""Told how many of how many images are there, once at the start and then whenever some came."""


@dataclass
class RenderReport:
    """What a run has done.

    Attributes:
        num_images: Images of the shard, all there now.
        num_rendered: Those that this run made.
        num_unsealed: Chunks that wait for other shards.
        wall_s: Seconds it took.
        render_s: CPU seconds of rendering.
        write_s: CPU seconds of encoding and writing.
    """

    num_images: int
    num_rendered: int = 0
    num_unsealed: int = 0
    wall_s: float = 0.0
    render_s: float = 0.0
    write_s: float = 0.0

    def __str__(self) -> str:
        """Say it in a line, with the rate."""
        if not self.num_rendered:
            return f"all {self.num_images:,} images were there"
        ms = 1000 / self.num_rendered
        return (
            f"{self.num_rendered:,} of {self.num_images:,} images rendered in {self.wall_s:.0f} s: "
            f"{self.num_rendered / self.wall_s:.1f} images/s, "
            f"{ms * (self.render_s + self.write_s):.1f} CPU-ms an image "
            f"(rendering {ms * self.render_s:.1f}, writing {ms * self.write_s:.1f})"
        )


def render_dataset(
    job: Job,
    root: Path,
    num_items: int,
    open_pool: OpenPool,
    shard: Shard | None = None,
    on_progress: Progress = lambda done, total: None,
) -> RenderReport:
    """Bring a folder to ``num_items`` images, or to one shard of them.

    What is there is kept: whatever stopped an earlier run, this one goes on. Several shards may
    share the folder at the same time; whoever completes a chunk finalizes it.

    Args:
        job: What to render.
        root: The folder.
        num_items: Images of the whole job.
        open_pool: Makes the processes that do the work.
        shard: Which part of the job; all of it by default.
        on_progress: See :data:`Progress`.

    Raises:
        UserError: The count, the folder or the preset cannot be right.
        StoppedError: The disk is full or a worker died.
    """
    check_count(num_items)
    work, shard = Work(job.factory, job.layout, root.resolve()), shard or Shard()
    if not is_begun(work.root):
        # A preset that cannot show the part is found out before anything is written.
        job.factory.scene(0, 0)
    begin(work.root, job.record)
    start = time.monotonic()
    try:
        writer = work.writer()
        writer.prepare()
        run = _Run(list(plan(writer, shard, num_items)), RenderReport(len(shard.span(num_items))))
        on_progress(run.num_there, run.report.num_images)
        with open_pool(pickle.dumps(work), run.num_tasks) as pool:
            # Renders and, between them, finalizes; then the finalizes of what was rendered last.
            for tasks in (run.tasks(pool.images_per_task), run.finalizes()):
                for outcome in pool.run(tasks):
                    run.note(outcome)
                    on_progress(run.num_there, run.report.num_images)
    except OSError as error:
        raise stopped(error, work.root) from error
    run.report.wall_s = time.monotonic() - start
    return run.report


class _Run:
    """What is left to do, and what has been done."""

    def __init__(self, chunks: list[Chunk], report: RenderReport) -> None:
        self.report, self._chunks = report, chunks
        self._left = {chunk.number: len(chunk.missing) for chunk in chunks}
        self._required = {chunk.number: chunk.required for chunk in chunks}
        # Complete already, but maybe not finalized: finalizing is idempotent.
        self._complete = deque(chunk.number for chunk in chunks if not chunk.missing)
        self.num_tasks = sum(self._left.values()) + len(self._complete)
        self.num_there = report.num_images - sum(self._left.values())

    def tasks(self, images_per_task: int) -> Iterator[Task]:
        """Yield all renders and, between them, the finalizes of chunks that are complete."""
        for chunk in self._chunks:
            for first in range(0, len(chunk.missing), images_per_task):
                yield from self.finalizes()
                yield Task(chunk.number, chunk.missing[first : first + images_per_task])

    def finalizes(self) -> Iterator[Task]:
        """Yield the finalizes of chunks that are complete by now."""
        while self._complete:
            number = self._complete.popleft()
            yield Task(number, self._required[number], finalizes=True)

    def note(self, outcome: Outcome) -> None:
        """Count an outcome.

        Raises:
            Exception: The outcome's error.
        """
        task, report = outcome.task, self.report
        if outcome.error is not None:
            raise outcome.error
        if task.finalizes:
            report.num_unsealed += not outcome.finalized
            return
        report.render_s += outcome.render_s
        report.write_s += outcome.write_s
        report.num_rendered += len(task.indices)
        self.num_there += len(task.indices)
        self._left[task.chunk] -= len(task.indices)
        if not self._left[task.chunk]:
            self._complete.append(task.chunk)


ENGINES: Final = ("local", "ray")


@dataclass(frozen=True)
class RenderRequest:
    """How much of a job is done here, and by whom; it decides none of the bytes.

    Attributes:
        out: The data set's folder.
        num: Images of the whole job.
        shard: ``i/n``.
        workers: Processes; None for one per core.
        engine: One of :data:`ENGINES`.
        ray_address: Of a running Ray cluster.
    """

    out: Path
    num: int | None
    shard: str = "0/1"
    workers: int | None = None
    engine: str = "local"
    ray_address: str | None = None


def run(job: Job, order: RenderRequest) -> RenderReport:
    """Render what is missing and show the progress on stderr.

    Raises:
        UserError: The order cannot be carried out.
        StoppedError: The disk is full or a worker died.
    """
    if order.num is None:
        raise UserError("no -n", "the number of images, or --preview", "add -n 1000")
    shard, open_pool = Shard.parse(order.shard), _engine(order)
    with ProgressDisplay(Console(stderr=True)) as progress:
        return render_dataset(job, order.out, order.num, open_pool, shard, progress)


def write_preview(job: Job, out: Path) -> Path:
    """Write a contact sheet of the job's first images.

    Args:
        job: The job.
        out: A PNG file, or the data set's folder: the sheet then lies beside it.

    Returns:
        Where the sheet is.

    Raises:
        UserError: The preset cannot show the part, or the sheet cannot be written.
    """
    # Fonts and drawing take a second to load: only here.
    from dopepp.core.files import write_png
    from dopepp.data.jobs.progress import preview_sheet

    out = out.resolve()
    path = out if out.suffix.lower() == ".png" else out.parent / f"{out.name}.preview.png"
    sheet = preview_sheet(job.factory)
    try:
        write_png(path, sheet)
    except OSError as error:
        raise UserError(
            f"sheet {path}: {error.strerror}", "a folder that can be written", "change --out"
        ) from error
    return path


def _engine(order: RenderRequest) -> OpenPool:
    """Return what opens the pool, after checking what can be checked without it."""
    workers = available_cores() if order.workers is None else order.workers
    check_workers(workers)
    if order.engine == "local":
        if order.ray_address is not None:
            raise UserError(
                f"--ray-address {order.ray_address} with --engine local", "it goes with ray",
                "add --engine ray",
            )  # fmt: skip
        return lambda content, num_tasks: ProcessPool(content, min(workers, max(num_tasks, 1)))
    if order.engine == "ray":
        from dopepp.data.jobs.cluster import ClusterPool

        open_pool = partial(ClusterPool, address=order.ray_address, num_workers=workers)
        return lambda content, _: open_pool(content)
    raise UserError(f"--engine {order.engine}", ", ".join(ENGINES), "choose one of them")
