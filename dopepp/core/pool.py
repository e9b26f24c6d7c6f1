"""Pools that apply a function to many items: threads, processes of this machine, or a Ray cluster.

A pool receives the pickled function once and yields each item with its future on completion. An
exception or a lost process affects its own item only.

When one process dies, ``concurrent.futures.ProcessPoolExecutor`` and loky lose all items in
progress and do not report the exit code; when their parent is killed, their processes continue.
Here, each thread of a ``ThreadPoolExecutor`` has one process behind a pipe.

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
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from functools import cache
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, Final, TypeVar, cast

from dopepp.core.errors import UserError, require

_log = logging.getLogger(__name__)

Item = TypeVar("Item")
Result = TypeVar("Result")

THREAD_PREFIX: Final = "map_in_threads"  # of the names of threads

_LIMITED: Final = ("OMP_NUM", "OPENBLAS_NUM", "MKL_NUM", "BLIS_NUM", "VECLIB_MAXIMUM", "NUMBA_NUM")

THREAD_LIMITS: Final = tuple(f"{library}_THREADS" for library in _LIMITED)
"""Environment variables that limit the threads of libraries loaded after they are set."""

_ITEMS_PER_WORKER: Final = 2
"""Unfinished items per worker: no worker idles, and an autoscaling cluster sees a queue."""

_PATIENCE_S: Final = 3.0
"""Time in which a process may finish its item after a failure, before it is killed."""

_CORES_EVERY_S: Final = 10.0
"""Interval of queries for the cluster's number of CPU cores, which may change."""


def available_cores() -> int:
    """Return the number of CPU cores that this process may use; outside Linux, of all CPU cores."""
    return len(_cores())


@cache
def physical_cores() -> int:
    """Return the number of physical CPU cores for this process; outside Linux, of logical cores.

    The number is read once, because it is asked for in every image.
    """
    siblings = set()
    for core in _cores():
        path = Path(f"/sys/devices/system/cpu/cpu{core}/topology/thread_siblings_list")
        siblings.add(path.read_text() if path.is_file() else str(core))
    return len(siblings)


def _cores() -> Collection[int]:
    if hasattr(os, "sched_getaffinity"):
        return os.sched_getaffinity(0)
    return range(os.cpu_count() or 1)


def num_threads() -> int:
    """Return ``OMP_NUM_THREADS`` if it is a positive integer, else :func:`physical_cores`."""
    text = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]
    return int(text) if text.isdecimal() and int(text) > 0 else physical_cores()


def map_in_threads(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Return a function's result for each item, computed in up to :func:`num_threads` threads.

    The threads run at the same time only while the function has released the GIL, as compiled loops
    and OpenCV do. In one of these threads, items are computed one after the other.
    """
    is_inside = threading.current_thread().name.startswith(THREAD_PREFIX)
    if len(items) < 2 or is_inside or (count := num_threads()) < 2:
        return [function(item) for item in items]
    with ThreadPoolExecutor(min(len(items), count), THREAD_PREFIX) as threads:
        return list(threads.map(function, items))


def in_forked_process(function: Callable[[Item], Result], item: Item) -> Result:
    """Return a function's result, computed in a process whose threads and libraries end with it.

    Raises:
        LostWorkerError: The process died.
    """
    context = get_context("fork")
    receiver, sender = context.Pipe(duplex=False)

    def work() -> None:
        try:
            sender.send((function(item), None))
        except Exception as error:
            sender.send((None, error))

    process = context.Process(target=work)
    process.start()
    sender.close()
    try:
        result, error = receiver.recv()
    except EOFError:
        raise LostWorkerError(f"the process of {function.__name__} died") from None
    finally:
        process.join()
    if error is not None:
        raise error
    return cast("Result", result)


def cpu_fact(*names: str) -> str:
    """Return the value of the first line of /proc/cpuinfo that starts with a name, or ""."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.is_file() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(names)), "")


class LostWorkerError(RuntimeError):
    """A worker process, or a machine of the cluster, died while it processed an item."""


class PickledFunction:
    """A pickled function, which is unpickled when its first item arrives.

    A call returns the pickled pair (value, None), or (None, error) if the function raised.
    """

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._function: Callable[[Any], Any] | None = None

    def __call__(self, item: object) -> bytes:
        """Return the pickled (value, error) pair of an item."""
        try:
            if self._function is None:
                self._function = pickle.loads(self._content)
            return pickle.dumps((self._function(item), None))
        except (UserError, OSError) as error:
            return pickle.dumps((None, error))
        except Exception:  # a defect: not every exception can be pickled, but its text can
            return pickle.dumps((None, RuntimeError(traceback.format_exc())))


def unpickle_answer(answer: bytes) -> Any:
    """Return the value of a pickled (value, error) pair from :class:`PickledFunction`.

    Raises:
        Exception: The pair holds an error, which is raised again.
    """
    value, error = pickle.loads(answer)
    if error is not None:
        raise error
    return value


class Pool(ABC):
    """Base of pools, which apply a pickled function to items in parallel; a context manager."""

    batch_size: int
    """Recommended number of images to render per item. Small items lose little work when stopped;
    large items have less overhead."""

    def __enter__(self) -> Pool:
        return self

    @abstractmethod
    def __exit__(self, failure: type[BaseException] | None, *_: object) -> None: ...

    @abstractmethod
    def capacity(self) -> int:
        """Return how many submitted items may be unfinished at a time."""

    @abstractmethod
    def submit(self, item: object) -> Future[Any]:
        """Submit an item, and return the future of the function's value."""

    def run(self, items: Iterable[Item]) -> Iterator[tuple[Item, Future[Any]]]:
        """Yield items and their futures in the order of completion.

        A future raises the function's exception or :class:`LostWorkerError`. Further items are read
        only after finished items were yielded, because the consumer may decide on further items.
        """
        waiting, running = iter(items), dict[Future[Any], Item]()
        while True:
            while len(running) < self.capacity() and (item := next(waiting, None)) is not None:
                running[self.submit(item)] = item
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), future


class _Worker(threading.local):
    """Worker process of the current thread, and the pipe to it."""

    process: SpawnProcess | None = None
    connection: Connection


class ProcessPool(Pool):
    """Pool of at most ``num_workers`` processes, started on demand and restarted if lost.

    Processes are spawned (in about a second), because Mitsuba's thread pool does not survive a
    fork. They finish their item when the pipe is closed, so no file is half-written if the pool is
    stopped or this process is killed. ``environment`` has variables of the processes (default: one
    thread per library).
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

    def capacity(self) -> int:
        """Return how many submitted items may be unfinished at a time."""
        return self._num_workers * _ITEMS_PER_WORKER

    def submit(self, item: object) -> Future[Any]:
        """Submit an item, and return the future of the function's value."""
        return self._threads.submit(self._apply, item)

    def _apply(self, item: object) -> Any:
        worker = self._worker
        is_new = worker.process is None
        process = worker.process = worker.process or self._start()
        try:
            if is_new:
                # As an argument of the process, megabytes would delay its start.
                worker.connection.send_bytes(self._content)
            worker.connection.send(item)
            answer = worker.connection.recv_bytes()
        except (EOFError, OSError) as error:
            worker.process = None
            process.join(_PATIENCE_S)
            code = process.exitcode
            how = f"signal {-code}" if code is not None and code < 0 else f"code {code}"
            reason = f"a worker process died ({how}); if memory was short, use fewer --workers"
            raise LostWorkerError(reason) from error
        return unpickle_answer(answer)

    def _start(self) -> SpawnProcess:
        context = get_context("spawn")
        self._worker.connection, remote = context.Pipe()
        process = context.Process(target=_serve, args=(remote,))
        with _environment(self._environment):
            process.start()
        remote.close()  # so that the pipe ends with the process
        self._processes.append(process)
        self._connections.append(self._worker.connection)
        return process

    def _kill(self) -> None:
        for process in self._processes:
            process.kill()


def _block_signals() -> None:
    """Block SIGINT and SIGTERM in the processes that this thread starts."""
    # Ctrl-C reaches every process of the terminal, but only the parent should react.
    if hasattr(signal, "pthread_sigmask"):
        resource_tracker.ensure_running()  # it starts with the first process, and unblocks signals
        signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))


def _serve(connection: Connection) -> None:
    """Receive the pickled function, then apply it to items until the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # for systems without a signal mask
    with suppress(EOFError, OSError):  # the parent has ended
        function = PickledFunction(connection.recv_bytes())
        while True:
            connection.send_bytes(function(connection.recv()))


_environment_lock = threading.Lock()


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables in the block, for processes started in it, and restore them."""
    with _environment_lock:
        previous = {name: os.environ[name] for name in variables if name in os.environ}
        os.environ.update(variables)
        try:
            yield
        finally:
            for name in variables:
                del os.environ[name]
            os.environ.update(previous)


class ClusterPool(Pool):
    """Pool of tasks on a Ray cluster.

    All machines must have the same dopepp and the same files under the same paths. Ray repeats the
    tasks of a lost machine. ``num_tasks`` counts the finished tasks by the node's id.

    Args:
        content: Pickled function of one item.
        address: ``host:port`` of the cluster (default: start one on this machine for the pool).
        num_workers: Number of CPU cores of a cluster that is started on this machine.
        asked_by: The option that needs Ray, for error messages, like ``option`` for the address.
        task_options: Options of ``ray.remote`` for a task, e.g. ``num_gpus`` (default: one core).
    """

    batch_size = 8  # Ray takes about a millisecond to submit a task

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
            # In a list, a worker fetches the object once and not for every task.
            self._content = [self._ray.put(content)]
            # Without SPREAD, Ray fills a machine before using the next machine.
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

    def capacity(self) -> int:
        """Return how many submitted items may be unfinished at a time."""
        if time.monotonic() - self._asked_at >= _CORES_EVERY_S:
            cores = int(self._ray.cluster_resources().get("CPU", 0))
            self._room, self._asked_at = max(cores, 1) * _ITEMS_PER_WORKER, time.monotonic()
        return self._room

    def submit(self, item: object) -> Future[Any]:
        """Submit an item, and return the future of the function's value."""
        result: Future[Any] = Future()

        def finish(answered: Future[tuple[bytes, str]]) -> None:
            try:
                answer, node = answered.result()
                self.num_tasks[node] += 1
                result.set_result(unpickle_answer(answer))
            except self._ray.exceptions.RayError as error:
                reason = " ".join(str(error).split())
                lost = LostWorkerError(f"Ray: {type(error).__name__}: {reason[:300]}")
                result.set_exception(lost)
            except Exception as error:  # raised by the user's function
                result.set_exception(error)

        answered = self._apply.remote(self._content, self._content[0].hex(), item).future()
        answered.add_done_callback(finish)
        return result


def _connect(address: str | None, num_workers: int, asked_by: str, option: str) -> Any:
    require("ray", asked_by, "ray")
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # before the import, because Ray reads it then
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
        if address is not None:  # Ray would retry for many minutes
            host, _, port = address.rpartition(":")
            socket.create_connection((host, int(port)), timeout=5.0).close()
        ray.init(**options)
    except (OSError, ValueError, OverflowError, RuntimeError) as error:
        raise UserError(
            f"{option} {address}: {error}",
            "host:port of a running Ray cluster that includes this machine",
            "start a cluster with `ray start --head`, or leave out the address",
        ) from error
    return ray


_functions: dict[str, PickledFunction] = {}
"""The current pool's function in this process. Ray reuses processes for several pools."""


def _apply(content: list[Any], key: str, item: object) -> tuple[bytes, str]:
    """Apply the function to an item in a cluster process; return its answer and the node's id."""
    import ray

    if key not in _functions:
        _functions.clear()
        # Arrays from Ray's store would be read-only, which is a different type in compiled loops.
        _functions[key] = PickledFunction(ray.get(content[0]))
    return _functions[key](item), ray.get_runtime_context().get_node_id()
