"""Tasks on the cores of this machine.

Start a worker process.

Workers are spawned, not forked: Mitsuba's thread pool does not survive a fork, and a spawned
process starts alike on every system. It costs each of them about a second, once.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Final

from dopepp.core.errors import UserError
from dopepp.core.interrupts import StoppedError
from dopepp.data.jobs.work import Outcome, Task, Worker

_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)

_THREAD_LIMITS: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)


def start_worker() -> tuple[BaseProcess, Connection]:
    """Start a process that asks for its work and then does tasks; return it and our pipe's end."""
    context = get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(there,), daemon=True)
    process.start()
    there.close()  # so that the pipe ends when the worker does
    return process, here


@contextmanager
def sheltered() -> Iterator[None]:
    """Let children inherit one thread per library, and signals blocked from their first moment.

    Ctrl-C reaches every process of the terminal, but only this one decides what to do.
    """
    kept = {name: os.environ.get(name) for name in _THREAD_LIMITS}
    os.environ.update(dict.fromkeys(_THREAD_LIMITS, "1"))
    can_block = hasattr(signal, "pthread_sigmask")
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS) if can_block else set()
    try:
        yield
    finally:
        if can_block:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name, value in kept.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _serve(connection: Connection) -> None:
    """Ask for the work, then do tasks until the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # for systems without a signal mask
    try:
        connection.send(None)
        worker = Worker(connection.recv_bytes())
        while True:
            connection.send(worker.perform(connection.recv()))
    except (EOFError, OSError):  # there is nobody left to work for
        return


MAX_WORKERS: Final = 1024
"""More processes than any machine here has cores: a slip of the keyboard."""

_TASKS_AHEAD: Final = 2
"""Tasks a worker holds, so that it never waits for the next one."""

_PATIENCE_S: Final = 3.0
"""What a worker gets to complete its image when the job is stopped; then it is killed."""


def available_cores() -> int:
    """Return the cores that this process may use, where the system tells (Linux), else all."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def check_workers(num_workers: int) -> None:
    """Refuse a number of workers that must be a mistake.

    Raises:
        UserError: It is not in 1 … 1024.
    """
    if not 1 <= num_workers <= MAX_WORKERS:
        raise UserError(f"--workers {num_workers}", f"1 to {MAX_WORKERS}", "change --workers")


@dataclass
class _Process:
    process: BaseProcess
    connection: Connection
    is_ready: bool = False
    num_tasks: int = 0


class ProcessPool:
    """Worker processes, each with one pipe; a context manager that ends them.

    A worker ends after its current image when its pipe does: so it leaves nothing half-written,
    whether the job is stopped or this process is killed.

    Args:
        content: A pickled :class:`~dopepp.data.jobs.work.Work`.
        num_workers: Number of processes.
    """

    images_per_task = 2
    """Few, because they are completed before the job stops."""

    def __init__(self, content: bytes, num_workers: int) -> None:
        self._content = content
        with sheltered():
            self._processes = [_Process(*start_worker()) for _ in range(num_workers)]

    def __enter__(self) -> ProcessPool:
        return self

    def __exit__(self, failure: type[BaseException] | None, *_: object) -> None:
        for one in self._processes:
            one.connection.close()
        for one in self._processes:
            one.process.join(None if failure is None else _PATIENCE_S)
            if one.process.is_alive():
                one.process.kill()
                one.process.join()

    def run(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        """Do tasks and yield their outcomes as they come.

        Args:
            tasks: Read only as far as workers are free.

        Raises:
            StoppedError: A worker has died.
        """
        waiting = _Waiting(tasks)
        for one in self._processes:
            self._hand_out(one, waiting)
        while busy := {
            one.connection: one
            for one in self._processes
            if one.num_tasks or not (one.is_ready or waiting.is_empty)
        }:
            for connection in wait(list(busy)):
                assert isinstance(connection, Connection)
                one = busy[connection]
                with _death_explained(one.process):
                    message: Outcome | None = connection.recv()
                    if message is None:
                        connection.send_bytes(self._content)
                if message is None:
                    one.is_ready = True
                else:
                    one.num_tasks -= 1
                    # First the news, because they may decide which task comes next.
                    yield message
                self._hand_out(one, waiting)

    def _hand_out(self, one: _Process, waiting: _Waiting) -> None:
        while one.is_ready and one.num_tasks < _TASKS_AHEAD:
            task = waiting.next()
            if task is None:
                return
            with _death_explained(one.process):
                one.connection.send(task)
            one.num_tasks += 1


class _Waiting:
    """Tasks that nobody has yet; it may be empty now and not later."""

    def __init__(self, tasks: Iterable[Task]) -> None:
        self._tasks = iter(tasks)
        self.is_empty = False

    def next(self) -> Task | None:
        task = next(self._tasks, None)
        self.is_empty = task is None
        return task


@contextmanager
def _death_explained(process: BaseProcess) -> Iterator[None]:
    """Turn a broken pipe into a :class:`StoppedError` that says how its process ended."""
    try:
        yield
    except (EOFError, OSError) as error:
        process.join(_PATIENCE_S)
        code = process.exitcode
        how = f"signal {-code}" if code is not None and code < 0 else f"code {code}"
        raise StoppedError(
            f"a worker process died ({how}); if memory was short, use fewer --workers"
        ) from error
