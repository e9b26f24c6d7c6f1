"""Work in parallel: this machine's processor, futures in the order they are done in, and Ray."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, TypeVar

from dopepp.core.errors import UserError, require

Item = TypeVar("Item")
Result = TypeVar("Result")

_KNOCK_S: Final = 5.0

_OBJECT_STORE_BYTES: Final = 200_000_000
"""Of a local cluster; it holds the work, a few megabytes, and outcomes."""

THREAD_LIMITS: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMBA_NUM_THREADS",
)
"""Environment variables that limit the threads of libraries loaded after they are set."""


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Let processes that are started here have one thread per library."""
    kept = {name: os.environ[name] for name in THREAD_LIMITS if name in os.environ}
    os.environ.update(dict.fromkeys(THREAD_LIMITS, "1"))
    try:
        yield
    finally:
        for name in THREAD_LIMITS:
            del os.environ[name]
        os.environ.update(kept)


def available_cores() -> int:
    """Return the cores that this process may use, where the system tells (Linux), else all."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def physical_cores() -> int:
    """Return how many cores this process may use, two that share one's arithmetic as one."""
    if not hasattr(os, "sched_getaffinity"):
        return os.cpu_count() or 1
    siblings = set()
    for core in os.sched_getaffinity(0):
        path = Path(f"/sys/devices/system/cpu/cpu{core}/topology/thread_siblings_list")
        siblings.add(path.read_text() if path.is_file() else str(core))
    return len(siblings)


def cpu_fact(*names: str) -> str:
    """Return what Linux states of the first processor under one of these names; else nothing."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.is_file() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(names)), "")


def completed(
    submit: Callable[[Item], Future[Result]], items: Iterable[Item], room: Callable[[], int]
) -> Iterator[tuple[Item, Future[Result]]]:
    """Submit items and yield each with its future as soon as that is done.

    ``items`` are read only as far as ``room()`` allows, and after what is done was yielded, because
    that may decide what comes next.
    """
    waiting, flying = iter(items), dict[Future[Result], Item]()
    while True:
        while len(flying) < room() and (item := next(waiting, None)) is not None:
            flying[submit(item)] = item
        if not flying:
            return
        for future in wait(flying, return_when=FIRST_COMPLETED).done:
            yield flying.pop(future), future


def connect(
    address: str | None,
    num_workers: int,
    asked_by: str = "--engine ray",
    option: str = "--ray-address",
) -> Any:
    """Import Ray and connect to a cluster, or start a local one.

    A local one, without an ``address``, has ``num_workers`` cores, binds to this machine only,
    reports to nobody and ends with this process. ``asked_by`` and ``option`` name, for messages,
    the choice that needs Ray and the option that holds the address. A :class:`UserError`: Ray is
    not installed, or there is no cluster at the address.
    """
    require("ray", asked_by, "ray")
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # read when Ray starts, so it comes first
    import ray

    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address is None:
        options |= {
            "address": "local",
            "num_cpus": num_workers,
            "include_dashboard": False,
            "object_store_memory": _OBJECT_STORE_BYTES,
            "_node_ip_address": "127.0.0.1",
        }
    else:
        options["address"] = address
    try:
        if address is not None:  # knocks first: Ray itself tries for many minutes
            host, _, port = address.rpartition(":")
            socket.create_connection((host, int(port)), timeout=_KNOCK_S).close()
        ray.init(**options)
    except (OSError, ValueError, OverflowError, RuntimeError) as error:
        raise UserError(
            f"{option} {address}: {error}",
            "host:port of a running Ray cluster that this machine belongs to",
            "start one with `ray start --head`, or leave the address out",
        ) from error
    return ray


def spread(
    ray: Any, function: Callable[..., Result], **options: Any
) -> Callable[..., Future[Result]]:
    """Return a function that does the same as a task of the cluster.

    ``options`` are what a task occupies (``num_cpus``, ``num_gpus``), and how often it is repeated.
    """
    # Without SPREAD, Ray fills one machine before it uses the next.
    remote = ray.remote(scheduling_strategy="SPREAD", **options)(function)

    def submit(*arguments: object) -> Future[Result]:
        future: Future[Result] = remote.remote(*arguments).future()
        return future

    return submit
