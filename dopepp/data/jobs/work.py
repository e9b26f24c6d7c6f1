"""A piece of a render job and what came of it, the same on every engine.

A job's images lie in chunks, which are finalized when they are complete. A shard is a contiguous
part of the job; it may begin and end within a chunk.
"""

from __future__ import annotations

import pickle
import re
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2

from dopepp.core.errors import UserError
from dopepp.data.formats import RECORD_FILE, Writer
from dopepp.data.jobs.job import Job, is_begun
from dopepp.data.sources.rendered import rendered_sample
from dopepp.virtual.factory import Factory


@dataclass(frozen=True)
class Shard:
    """One of several equal, contiguous parts of a job."""

    number: int = 0
    total: int = 1

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Read ``i/n``, i from 0 to n − 1; anything else is a :class:`UserError`."""
        match = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
        if match is None or int(match[1]) >= int(match[2]):
            raise UserError(
                f"shard {text!r}",
                "i/n with 0 <= i < n: 0/2 and 1/2 are the two halves",
                "count the shards from 0",
            )
        return cls(int(match[1]), int(match[2]))

    def span(self, num_items: int) -> range:
        """Return the shard's indices of a job of ``num_items`` images."""
        return range(
            num_items * self.number // self.total, num_items * (self.number + 1) // self.total
        )


@dataclass(frozen=True)
class Chunk:
    """What a shard has to do with a chunk.

    Attributes:
        required: All of the job's images in it, also those of other shards: with these it is
            finalized.
        missing: The shard's images in it that are not there yet.
    """

    number: int
    required: range
    missing: Sequence[int]


def plan(writer: Writer, shard: Shard, num_items: int) -> Iterator[Chunk]:
    """Yield the chunks that a shard touches, in order, also those that are complete."""
    span, size = shard.span(num_items), writer.chunk_size
    if not span:
        return
    for number in range(span[0] // size, span[-1] // size + 1):
        required = range(number * size, min((number + 1) * size, num_items))
        own = range(max(span.start, required.start), min(span.stop, required.stop))
        written = writer.written(number)
        missing = [index for index in own if index not in written] if written else own
        yield Chunk(number, required, missing)


@dataclass(frozen=True)
class Task:
    """Images to render and write, or a chunk to finalize.

    Attributes:
        indices: The images; for finalizing, those without which it must not happen.
        finalizes: Whether the chunk is to be finalized.
    """

    chunk: int
    indices: Sequence[int]
    finalizes: bool = False


@dataclass(frozen=True)
class Outcome:
    """What came of a task.

    Attributes:
        render_s: CPU seconds that rendering took.
        write_s: CPU seconds that encoding and writing took.
        node: Machine of a cluster that did it, by its id; empty for this one.
    """

    task: Task
    render_s: float = 0.0
    write_s: float = 0.0
    error: Exception | None = None
    node: str = ""


class Worker:
    """Does tasks in one process, on one thread.

    ``content`` is a pickled job and the data set's folder, unpickled with the first task, so that
    whatever is wrong with it on this machine becomes that task's outcome.
    """

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._opened: tuple[Factory, Writer] | None = None

    def perform(self, task: Task) -> Outcome:
        """Do a task; an error comes back as a part of the outcome."""
        try:
            factory, writer = self._open()
            if not task.finalizes:
                return _render(factory, writer, task)
            written = writer.written(task.chunk)
            if written.issuperset(task.indices):  # else images of it are still to come
                writer.finalize(task.chunk, sorted(written))
            return Outcome(task)
        except (UserError, OSError) as error:
            return Outcome(task, error=error)
        except Exception:  # a defect: not every exception survives pickling, its text does
            return Outcome(task, error=RuntimeError(traceback.format_exc()))

    def _open(self) -> tuple[Factory, Writer]:
        if self._opened is None:
            cv2.setNumThreads(1)
            job: Job
            root: Path
            job, root = pickle.loads(self._content)
            if not is_begun(root):
                raise UserError(
                    f"{root} without {RECORD_FILE}, as one of the workers sees it",
                    "a folder that every machine of the cluster sees under the same path",
                    "choose --out on a shared file system",
                )
            self._opened = job.factory, job.writer(root)
        return self._opened


def _render(factory: Factory, writer: Writer, task: Task) -> Outcome:
    render_s = write_s = 0.0
    for index in task.indices:
        start = time.process_time()
        sample = rendered_sample(factory.render(0, index), "virtual", str(index))
        middle = time.process_time()
        writer.write(index, sample)
        render_s += middle - start
        write_s += time.process_time() - middle
    return Outcome(task, render_s, write_s)
