"""Tasks on the cores of this machine."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Final

from dopepp.data.production.spawning import sheltered, start_worker
from dopepp.data.production.stopping import StoppedError
from dopepp.data.production.work import Outcome, Task
from dopepp.errors import UserError

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
        content: A pickled :class:`~dopepp.data.production.work.Work`.
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
