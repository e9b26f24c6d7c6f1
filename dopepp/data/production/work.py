"""A piece of a render job and what came of it, the same on every engine.

To add a layout, write a :class:`~dopepp.data.writing.Writer` and one line in :data:`WRITERS`.
"""

from __future__ import annotations

import pickle
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Final

import cv2

from dopepp.data.production.folder import RECORD_FILE, is_begun
from dopepp.data.rendered import rendered_sample
from dopepp.data.writing import Writer
from dopepp.errors import UserError
from dopepp.parts.part import Part
from dopepp.virtual.factory import Factory

WriterClass = Callable[[Path, Sequence[Part]], Writer]

WRITERS: Final = {
    "bop": ("dopepp.data.bop_writer", "BopWriter"),
    "ndds": ("dopepp.data.ndds_writer", "NddsWriter"),
    "webdataset": ("dopepp.data.webdataset_writer", "WebdatasetWriter"),
}
"""Module and class of each layout's writer."""


def find_writer(layout: str) -> WriterClass:
    """Return a layout's writer; its module is imported only now.

    Raises:
        UserError: The layout is unknown.
    """
    if layout not in WRITERS:
        raise UserError(f"format {layout!r}", ", ".join(WRITERS), "choose one of them")
    module, name = WRITERS[layout]
    writer: WriterClass = getattr(import_module(module), name)
    return writer


@dataclass(frozen=True)
class Work:
    """What a process needs to know in order to do any task of a job.

    Attributes:
        factory: Renders the images.
        layout: Key of :data:`WRITERS`.
        root: The data set's folder, absolute.
    """

    factory: Factory
    layout: str
    root: Path

    def writer(self) -> Writer:
        """Return a new writer into the folder."""
        return find_writer(self.layout)(self.root, self.factory.parts)


@dataclass(frozen=True)
class Task:
    """A piece of the job.

    Attributes:
        chunk: The chunk it belongs to.
        indices: The images to render and write; for sealing, those without which it must not
            happen.
        seals: Whether the chunk is to be sealed.
    """

    chunk: int
    indices: Sequence[int]
    seals: bool = False


@dataclass(frozen=True)
class Outcome:
    """What came of a task.

    Attributes:
        task: The task.
        sealed: Whether it sealed its chunk; false where images of it are still to come.
        render_s: CPU seconds that rendering took.
        write_s: CPU seconds that encoding and writing took.
        error: What went wrong.
    """

    task: Task
    sealed: bool = False
    render_s: float = 0.0
    write_s: float = 0.0
    error: Exception | None = None


class Worker:
    """Does tasks in one process, on one thread.

    Args:
        content: A pickled :class:`Work`; unpickled with the first task, so that whatever is wrong
            with it on this machine becomes that task's outcome.
    """

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._opened: tuple[Factory, Writer] | None = None

    def perform(self, task: Task) -> Outcome:
        """Do a task; an error comes back as a part of the outcome."""
        try:
            factory, writer = self._open()
            if task.seals:
                return Outcome(task, sealed=_seal(writer, task))
            return _render(factory, writer, task)
        except (UserError, OSError) as error:
            return Outcome(task, error=error)
        except Exception:  # a defect: not every exception survives pickling, its text does
            return Outcome(task, error=RuntimeError(traceback.format_exc()))

    def _open(self) -> tuple[Factory, Writer]:
        if self._opened is None:
            cv2.setNumThreads(1)
            work: Work = pickle.loads(self._content)
            if not is_begun(work.root):
                raise UserError(
                    f"{work.root} without {RECORD_FILE}, as one of the workers sees it",
                    "a folder that every machine of the cluster sees under the same path",
                    "choose --out on a shared file system",
                )
            self._opened = work.factory, work.writer()
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
    return Outcome(task, render_s=render_s, write_s=write_s)


def _seal(writer: Writer, task: Task) -> bool:
    """Seal a chunk with all it holds, unless an image that belongs to it is missing."""
    written = writer.written(task.chunk)
    if not written.issuperset(task.indices):
        return False
    writer.seal(task.chunk, sorted(written))
    return True
