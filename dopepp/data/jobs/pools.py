"""Who does the tasks of a job: processes of this machine, or a Ray cluster.

Either takes a task and returns a ``concurrent.futures.Future`` of its outcome.

To add an engine, write a :class:`Pool` and name it in
:data:`~dopepp.data.jobs.render_dataset.ENGINES`.
"""

from __future__ import annotations

import logging
import os
import signal
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from queue import SimpleQueue
from threading import Timer
from typing import Any, Final

from dopepp.core.futures import completed, connect, one_thread_each, spread
from dopepp.core.interrupts import StoppedError
from dopepp.data.jobs.work import Outcome, Task, Worker
from dopepp.virtual.renderers.photoreal.variant import THREADS_SETTING

_log = logging.getLogger(__name__)

_TASKS_PER_WORKER: Final = 2
"""Tasks handed out per worker: none waits, and a cluster that scales itself sees that there is more
to do."""

_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)

_PATIENCE_S: Final = 3.0
"""What a worker gets to complete its task when the job is stopped; then it is killed."""

_CORES_EVERY_S: Final = 10.0
"""How often the cluster is asked for its cores, which may come and go."""


class Pool(ABC):
    """Does tasks somewhere, several at once; a context manager that ends what it began."""

    images_per_task: int
    """As few as the cost of handing out a task allows: less is lost when it is interrupted."""

    def __enter__(self) -> Pool:
        return self

    @abstractmethod
    def __exit__(self, failure: type[BaseException] | None, *_: object) -> None: ...

    @abstractmethod
    def room(self) -> int:
        """Return how many tasks may be handed out at a time."""

    @abstractmethod
    def submit(self, task: Task) -> Future[Outcome]:
        """Hand out a task."""

    def run(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        """Do tasks, in any order, and yield their outcomes as they come.

        ``tasks`` are read only as far as workers are free. A StoppedError: a worker has died, or
        the cluster cannot go on.
        """
        for _, future in completed(self.submit, tasks, self.room):
            yield future.result()


class ProcessPool(Pool):
    """Processes of this machine.

    They are spawned, not forked: Mitsuba's thread pool does not survive a fork, and a spawned
    process starts alike on every system. It costs each of them about a second, once.
    """

    images_per_task = 2

    # Threads of concurrent.futures, each with a process behind a pipe, and no ProcessPoolExecutor:
    # its workers outlive a killed parent, it does not tell what one of them died of, and it starts
    # them one after another, as each must first read the work, which is megabytes.
    def __init__(self, content: bytes, num_workers: int) -> None:
        self._threads = ThreadPoolExecutor(num_workers)
        with _sheltered():
            self._processes = [_Process(content) for _ in range(num_workers)]
        self._idle = SimpleQueue[_Process]()
        for process in self._processes:
            self._idle.put(process)

    def __exit__(self, failure: type[BaseException] | None, *_: object) -> None:
        killer = Timer(_PATIENCE_S, self._kill)
        if failure is not None:
            killer.start()
        self._threads.shutdown(cancel_futures=True)
        killer.cancel()
        for one in self._processes:
            one.connection.close()
        for one in self._processes:
            one.process.join()

    def room(self) -> int:
        """Return how many tasks may be handed out at a time."""
        return len(self._processes) * _TASKS_PER_WORKER

    def submit(self, task: Task) -> Future[Outcome]:
        """Hand out a task."""
        return self._threads.submit(self._perform, task)

    def _perform(self, task: Task) -> Outcome:
        process = self._idle.get()
        try:
            return process.perform(task)
        finally:
            self._idle.put(process)

    def _kill(self) -> None:
        for one in self._processes:
            one.process.kill()


class _Process:
    """A worker process behind a pipe; it ends after its task when the pipe does.

    So it leaves nothing half-written, whether the job is stopped or this process is killed.
    """

    def __init__(self, content: bytes) -> None:
        context = get_context("spawn")
        self._content: bytes | None = content
        self.connection, there = context.Pipe()
        self.process = context.Process(target=_serve, args=(there,), daemon=True)
        self.process.start()
        there.close()  # so that the pipe ends when the worker does

    def perform(self, task: Task) -> Outcome:
        """Have a task done."""
        try:
            if self._content is not None:
                self.connection.send_bytes(self._content)
                self._content = None
            self.connection.send(task)
            outcome: Outcome = self.connection.recv()
        except (EOFError, OSError) as error:
            self.process.join(_PATIENCE_S)
            code = self.process.exitcode
            how = f"signal {-code}" if code is not None and code < 0 else f"code {code}"
            raise StoppedError(
                f"a worker process died ({how}); if memory was short, use fewer --workers"
            ) from error
        return outcome


def _serve(connection: Connection) -> None:
    """Take the work, then do tasks until the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # for systems without a signal mask
    try:
        worker = Worker(connection.recv_bytes())
        while True:
            connection.send(worker.perform(connection.recv()))
    except (EOFError, OSError):  # there is nobody left to work for
        return


@contextmanager
def _sheltered() -> Iterator[None]:
    """Let children inherit one thread per library, and signals blocked from their first moment."""
    # Ctrl-C reaches every process of the terminal, but only this one decides what to do.
    can_block = hasattr(signal, "pthread_sigmask")
    if can_block:
        resource_tracker.ensure_running()  # it starts with the first process, and unblocks signals
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS) if can_block else set()
    try:
        with one_thread_each():
            yield
    finally:
        if can_block:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


class ClusterPool(Pool):
    """Ray tasks of one core each: the same images, byte for byte, on any number of machines.

    Every machine must see the data set's folder under the same path and have the same dopepp. Ray
    repeats the tasks of a machine that is lost.

    Without an ``address`` one is started on this machine, which ends with the job. ``num_tasks``
    counts the tasks done so far, by the node's id.
    """

    images_per_task = 8
    """Ray takes about a millisecond to hand out a task."""

    def __init__(self, content: bytes, address: str | None, num_workers: int) -> None:
        self._ray = connect(address, num_workers)
        try:
            # In a list, so that a worker fetches it once and not for every task.
            self._content = [self._ray.put(content)]
            self._submit = spread(self._ray, _perform, num_cpus=1)
        except BaseException:
            self._ray.shutdown()
            raise
        self._room, self._asked_at = 0, -_CORES_EVERY_S
        self.num_tasks: Counter[str] = Counter()

    def __exit__(self, *_: object) -> None:
        self._ray.shutdown()
        _log.info("Ray: %d tasks on %d nodes", self.num_tasks.total(), len(self.num_tasks))

    def room(self) -> int:
        """Return how many tasks may be handed out at a time."""
        if time.monotonic() - self._asked_at >= _CORES_EVERY_S:
            cores = int(self._ray.cluster_resources().get("CPU", 0))
            self._room, self._asked_at = max(cores, 1) * _TASKS_PER_WORKER, time.monotonic()
        return self._room

    def submit(self, task: Task) -> Future[Outcome]:
        """Hand out a task."""
        return self._submit(self._content, self._content[0].hex(), task)

    def run(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        """Do tasks and count them, as :meth:`Pool.run`."""
        try:
            for outcome in super().run(tasks):
                self.num_tasks[outcome.node] += 1
                yield outcome
        except self._ray.exceptions.RayError as error:
            reason = " ".join(str(error).split())
            raise StoppedError(f"Ray: {type(error).__name__}: {reason[:300]}") from error


_workers: dict[str, Worker] = {}
"""The worker of the current job in this process; Ray keeps processes for several tasks and jobs."""


def _perform(content: list[Any], key: str, task: Task) -> Outcome:
    """Do a task in a process of the cluster, and say on which node."""
    import ray

    if key not in _workers:
        os.environ.setdefault(THREADS_SETTING, "1")  # Ray gave this task one core
        _workers.clear()
        # Bytes, unpickled here: arrays out of Ray's store would be read-only, another type to the
        # compiled loops.
        _workers[key] = Worker(ray.get(content[0]))
    return replace(_workers[key].perform(task), node=ray.get_runtime_context().get_node_id())
