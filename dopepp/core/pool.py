"""Pools that apply a function to many items: processes of this machine, or a Ray cluster.

A pool takes the pickled function once and yields each item with its future as soon as that is done.
What the function raises belongs to its item, and so does a lost process: other items go on.

``concurrent.futures.ProcessPoolExecutor`` and loky do not keep these promises. They lose every item
in progress with one process, do not say what it died of, and leave processes behind when their
parent is killed. So each thread of a ``ThreadPoolExecutor`` has one process behind a pipe instead.

To add an engine, write a :class:`Pool`.
"""

from __future__ import annotations

import logging
import os
import pickle
import signal
import socket
import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, Final, TypeVar

from dopepp.core.errors import UserError, require

_log = logging.getLogger(__name__)

Item = TypeVar("Item")

_LIMITED: Final = ("OMP_NUM", "OPENBLAS_NUM", "MKL_NUM", "BLIS_NUM", "VECLIB_MAXIMUM", "NUMBA_NUM")

THREAD_LIMITS: Final = tuple(f"{library}_THREADS" for library in _LIMITED)
"""Environment variables that limit the threads of libraries loaded after they are set."""

_ITEMS_PER_WORKER: Final = 2
"""Items handed out per worker: no worker waits, and a cluster that scales itself sees a queue."""

_PATIENCE_S: Final = 3.0
"""Time that a process has to complete its item when the pool is stopped, before it is killed."""

_CORES_EVERY_S: Final = 10.0
"""How often the cluster is asked for its number of cores, which may change."""


def available_cores() -> int:
    """Return how many cores this process may use (Linux), or all of the machine's."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def physical_cores() -> int:
    """Return how many cores this process may use; two hardware threads of a core count as one."""
    if not hasattr(os, "sched_getaffinity"):
        return os.cpu_count() or 1
    siblings = set()
    for core in os.sched_getaffinity(0):
        path = Path(f"/sys/devices/system/cpu/cpu{core}/topology/thread_siblings_list")
        siblings.add(path.read_text() if path.is_file() else str(core))
    return len(siblings)


def cpu_fact(*names: str) -> str:
    """Return the first processor's entry of /proc/cpuinfo under one of these names, or nothing."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.is_file() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(names)), "")


class LostWorkerError(RuntimeError):
    """A process, or a machine of the cluster, that died over an item."""


class PickledFunction:
    """A function from its pickle, unpickled with the first item, so that a failure belongs to it.

    Calls return a pickled pair (value, error).
    """

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._function: Callable[[Any], Any] | None = None

    def __call__(self, item: object) -> bytes:
        """Apply the function."""
        try:
            if self._function is None:
                self._function = pickle.loads(self._content)
            return pickle.dumps((self._function(item), None))
        except (UserError, OSError) as error:
            return pickle.dumps((None, error))
        except Exception:  # a defect: not every exception survives pickling, its text does
            return pickle.dumps((None, RuntimeError(traceback.format_exc())))


def opened(answer: bytes) -> Any:
    """Return what the function returned, from :class:`PickledFunction`'s answer, or raise."""
    value, error = pickle.loads(answer)
    if error is not None:
        raise error
    return value


class Pool(ABC):
    """Applies a pickled function to items, several at once; a context manager that ends it."""

    batch_size: int
    """Pieces of work worth one item: few lose little when stopped, many cost less to hand out."""

    def __enter__(self) -> Pool:
        return self

    @abstractmethod
    def __exit__(self, failure: type[BaseException] | None, *_: object) -> None: ...

    @abstractmethod
    def room(self) -> int:
        """Return how many items may be handed out at a time."""

    @abstractmethod
    def submit(self, item: object) -> Future[Any]:
        """Hand out an item."""

    def run(self, items: Iterable[Item]) -> Iterator[tuple[Item, Future[Any]]]:
        """Yield items and their futures in the order in which they are done.

        A future raises what the function raised, or a :class:`LostWorkerError`. Items are read only
        as far as there is :meth:`room`, and after what is done was yielded, because that may decide
        what comes next.
        """
        waiting, flying = iter(items), dict[Future[Any], Item]()
        while True:
            while len(flying) < self.room() and (item := next(waiting, None)) is not None:
                flying[self.submit(item)] = item
            if not flying:
                return
            for future in wait(flying, return_when=FIRST_COMPLETED).done:
                yield flying.pop(future), future


class _Worker(threading.local):
    """A thread's process and the pipe to it."""

    process: SpawnProcess | None = None
    connection: Connection


class ProcessPool(Pool):
    """Processes of this machine.

    They are spawned, not forked: Mitsuba's thread pool does not survive a fork, and a spawned
    process starts alike on every system, in about a second. They end after their item when the pipe
    does, so they leave nothing half-written if the pool is stopped or this process is killed.

    Args:
        content: Pickled function of one item.
        num_workers: Most processes; they are started as items come, and again when lost.
        environment: Variables of the processes' environment (default: one thread per library).
    """

    batch_size = 2

    def __init__(
        self, content: bytes, num_workers: int, environment: Mapping[str, str] | None = None
    ) -> None:
        self._content, self._num_workers = content, num_workers
        self._environment = environment or dict.fromkeys(THREAD_LIMITS, "1")
        self._worker = _Worker()
        self._processes: list[SpawnProcess] = []
        self._connections: list[Connection] = []
        self._threads = ThreadPoolExecutor(num_workers, initializer=_block_signals)

    def __exit__(self, failure: type[BaseException] | None, *_: object) -> None:
        killer = threading.Timer(_PATIENCE_S, self._kill)
        if failure is not None:
            killer.start()
        self._threads.shutdown(cancel_futures=True)
        killer.cancel()
        for connection in self._connections:
            connection.close()
        for process in self._processes:
            process.join()

    def room(self) -> int:
        """Return how many items may be handed out at a time."""
        return self._num_workers * _ITEMS_PER_WORKER

    def submit(self, item: object) -> Future[Any]:
        """Hand out an item."""
        return self._threads.submit(self._apply, item)

    def _apply(self, item: object) -> Any:
        worker = self._worker
        is_new = worker.process is None
        process = worker.process = worker.process or self._start()
        try:
            if is_new:
                # Not an argument of the process, whose start would wait until megabytes are read.
                worker.connection.send_bytes(self._content)
            worker.connection.send(item)
            answer = worker.connection.recv_bytes()
        except (EOFError, OSError) as error:
            worker.process = None
            process.join(_PATIENCE_S)
            code = process.exitcode
            how = f"signal {-code}" if code is not None and code < 0 else f"code {code}"
            raise LostWorkerError(
                f"a worker process died ({how}); if memory was short, use fewer --workers"
            ) from error
        return opened(answer)

    def _start(self) -> SpawnProcess:
        context = get_context("spawn")
        self._worker.connection, there = context.Pipe()
        process = context.Process(target=_serve, args=(there,))
        with _environment(self._environment):
            process.start()
        there.close()  # so that the pipe ends when the process does
        self._processes.append(process)
        self._connections.append(self._worker.connection)
        return process

    def _kill(self) -> None:
        for process in self._processes:
            process.kill()


def _block_signals() -> None:
    """Let processes that this thread starts inherit blocked signals from their first moment."""
    # Ctrl-C reaches every process of the terminal, but only the parent decides what to do.
    if hasattr(signal, "pthread_sigmask"):
        resource_tracker.ensure_running()  # it starts with the first process, and unblocks signals
        signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))


def _serve(connection: Connection) -> None:
    """Take the function, then apply it to items until the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # for systems without a signal mask
    with suppress(EOFError, OSError):  # there is nobody left to work for
        function = PickledFunction(connection.recv_bytes())
        while True:
            connection.send_bytes(function(connection.recv()))


_environment_lock = threading.Lock()


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Let a process that is started here inherit these environment variables."""
    with _environment_lock:
        kept = {name: os.environ[name] for name in variables if name in os.environ}
        os.environ.update(variables)
        try:
            yield
        finally:
            for name in variables:
                del os.environ[name]
            os.environ.update(kept)


class ClusterPool(Pool):
    """Tasks of a Ray cluster; the same results on any number of machines.

    Every machine must see the same files under the same paths and have the same dopepp. Ray repeats
    the tasks of a machine that is lost. ``num_tasks`` counts the tasks done by the node's id.

    Args:
        content: Pickled function of one item.
        address: ``host:port`` of the cluster; None starts one on this machine that ends with it.
        num_workers: Cores of a cluster on this machine.
        asked_by: The choice that needs Ray, for messages.
        option: The option that holds the address, for messages.
        task_options: Options of ``ray.remote`` for a task, e.g. ``num_gpus`` (default: one core).

    Raises:
        UserError: Ray is not installed, or there is no cluster at the address.
    """

    batch_size = 8
    """Ray takes about a millisecond to hand out a task."""

    def __init__(
        self,
        content: bytes,
        address: str | None,
        num_workers: int,
        asked_by: str = "--engine ray",
        option: str = "--ray-address",
        **task_options: Any,
    ) -> None:
        self._ray = _connect(address, num_workers, asked_by, option)
        try:
            # In a list, so that a worker fetches it once and not for every task.
            self._content = [self._ray.put(content)]
            # Without SPREAD, Ray fills one machine before it uses the next.
            options = {"scheduling_strategy": "SPREAD", "num_cpus": 1} | task_options
            self._apply = self._ray.remote(**options)(_apply)
        except BaseException:
            self._ray.shutdown()
            raise
        self._room, self._asked_at = 0, -_CORES_EVERY_S
        self.num_tasks: Counter[str] = Counter()

    def __exit__(self, *_: object) -> None:
        self._ray.shutdown()
        _log.info("Ray: %d tasks on %d nodes", self.num_tasks.total(), len(self.num_tasks))

    def room(self) -> int:
        """Return how many items may be handed out at a time."""
        if time.monotonic() - self._asked_at >= _CORES_EVERY_S:
            cores = int(self._ray.cluster_resources().get("CPU", 0))
            self._room, self._asked_at = max(cores, 1) * _ITEMS_PER_WORKER, time.monotonic()
        return self._room

    def submit(self, item: object) -> Future[Any]:
        """Hand out an item."""
        result: Future[Any] = Future()

        def finish(answered: Future[tuple[bytes, str]]) -> None:
            try:
                answer, node = answered.result()
                self.num_tasks[node] += 1
                result.set_result(opened(answer))
            except self._ray.exceptions.RayError as error:
                reason = " ".join(str(error).split())
                lost = LostWorkerError(f"Ray: {type(error).__name__}: {reason[:300]}")
                result.set_exception(lost)
            except Exception as error:  # the function's
                result.set_exception(error)

        answered = self._apply.remote(self._content, self._content[0].hex(), item).future()
        answered.add_done_callback(finish)
        return result


def _connect(address: str | None, num_workers: int, asked_by: str, option: str) -> Any:
    """Import Ray and connect to a cluster, or start one that only this machine reaches."""
    require("ray", asked_by, "ray")
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # read when Ray starts, so it comes first
    import ray

    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address is None:
        options |= {
            "address": "local",
            "num_cpus": num_workers,
            "include_dashboard": False,
            "object_store_memory": 200_000_000,  # bytes, for the function and results
            "_node_ip_address": "127.0.0.1",
        }
    else:
        options["address"] = address
    try:
        if address is not None:  # Ray itself would try for many minutes
            host, _, port = address.rpartition(":")
            socket.create_connection((host, int(port)), timeout=5.0).close()
        ray.init(**options)
    except (OSError, ValueError, OverflowError, RuntimeError) as error:
        raise UserError(
            f"{option} {address}: {error}",
            "host:port of a running Ray cluster that this machine belongs to",
            "start one with `ray start --head`, or leave the address out",
        ) from error
    return ray


_functions: dict[str, PickledFunction] = {}
"""The current pool's function in this process; Ray keeps processes for several tasks and pools."""


def _apply(content: list[Any], key: str, item: object) -> tuple[bytes, str]:
    """Apply the function in a process of the cluster; return the answer and the node's id."""
    import ray

    if key not in _functions:
        _functions.clear()
        # Bytes, unpickled here: arrays out of Ray's store would be read-only, another type to the
        # compiled loops.
        _functions[key] = PickledFunction(ray.get(content[0]))
    return _functions[key](item), ray.get_runtime_context().get_node_id()
