"""Start a worker process.

Workers are spawned, not forked: Mitsuba's thread pool does not survive a fork, and a spawned
process starts alike on every system. It costs each of them about a second, once.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Final

from dopepp.data.production.work import Worker

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
