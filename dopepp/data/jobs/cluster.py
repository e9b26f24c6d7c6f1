"""Tasks on a Ray cluster: the same images, byte for byte, on any number of machines.

Every machine must see the data set's folder under the same path and have the same dopepp.
"""

from __future__ import annotations

import logging
import os
import socket
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from typing import Any, Final

from dopepp.core.errors import UserError
from dopepp.core.interrupts import StoppedError
from dopepp.data.jobs.work import Outcome, Task, Worker
from dopepp.virtual.renderers.photoreal.variant import THREADS_SETTING

_log = logging.getLogger(__name__)

_TASKS_PER_CORE: Final = 2
"""Tasks handed out per core: none waits, and a cluster that scales itself sees that there is more
to do."""

_CORES_EVERY_S: Final = 10.0
"""How often the cluster is asked for its cores, which may come and go."""

_KNOCK_S: Final = 5.0

_OBJECT_STORE_BYTES: Final = 200_000_000
"""Of a local cluster; it holds the work, a few megabytes, and outcomes."""


class ClusterPool:
    """Ray tasks of one core each; a context manager that leaves the cluster.

    Args:
        content: A pickled :class:`~dopepp.data.jobs.work.Work`.
        address: The cluster's address; None starts one on this machine that ends with the job.
        num_workers: Cores of that local cluster.

    Attributes:
        num_tasks: Tasks done so far, by the node's id.

    Raises:
        UserError: Ray is not installed, or there is no cluster at the address.
    """

    images_per_task = 8
    """Ray takes about a millisecond to hand out a task."""

    def __init__(self, content: bytes, address: str | None, num_workers: int) -> None:
        self._ray = connect(address, num_workers)
        try:
            # In a list, so that a worker fetches it once and not for every task.
            self._content = [self._ray.put(content)]
            self._key = self._content[0].hex()
            # Without SPREAD, Ray fills one machine before it uses the next.
            remote = self._ray.remote(num_cpus=1, scheduling_strategy="SPREAD")
            self._perform = remote(_perform)
        except BaseException:
            self._ray.shutdown()
            raise
        self._limit, self._asked_at = 0, -_CORES_EVERY_S
        self.num_tasks: Counter[str] = Counter()

    def __enter__(self) -> ClusterPool:
        return self

    def __exit__(self, *_: object) -> None:
        self._ray.shutdown()
        _log.info("Ray: %d tasks on %d nodes", self.num_tasks.total(), len(self.num_tasks))

    def run(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        """Do tasks and yield their outcomes as they come; Ray repeats those of a lost machine.

        Raises:
            StoppedError: The cluster cannot go on.
        """
        waiting = iter(tasks)
        flying: list[Any] = []
        try:
            while True:
                while len(flying) < self._in_flight() and (task := next(waiting, None)):
                    flying.append(self._perform.remote(self._content, self._key, task))
                if not flying:
                    return
                done, flying = self._ray.wait(flying, num_returns=1)
                for reference in done:
                    node, outcome = self._ray.get(reference)
                    self.num_tasks[node] += 1
                    yield outcome
        except self._ray.exceptions.RayError as error:
            reason = " ".join(str(error).split())
            raise StoppedError(f"Ray: {type(error).__name__}: {reason[:300]}") from error

    def _in_flight(self) -> int:
        """Return how many tasks may be handed out at once."""
        if time.monotonic() - self._asked_at >= _CORES_EVERY_S:
            cores = int(self._ray.cluster_resources().get("CPU", 0))
            self._limit, self._asked_at = max(cores, 1) * _TASKS_PER_CORE, time.monotonic()
        return self._limit


def connect(
    address: str | None,
    num_workers: int,
    asked_by: str = "--engine ray",
    option: str = "--ray-address",
) -> Any:
    """Import Ray and connect to a cluster, or start a local one.

    A local one binds to this machine only and reports to nobody.

    Args:
        address: See :class:`ClusterPool`.
        num_workers: See :class:`ClusterPool`.
        asked_by: The choice that needs Ray, for messages.
        option: The option that holds the address, for messages.

    Raises:
        UserError: See :class:`ClusterPool`.
    """
    if find_spec("ray") is None:
        raise UserError(
            f"{asked_by} without the package ray", "an installation with the extra ray",
            f"pip install 'dopepp[ray]', or leave {asked_by} out",
        )  # fmt: skip
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
        _check_reachable(address, option)
        options["address"] = address
    try:
        ray.init(**options)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise _no_cluster(address, option, error) from error
    return ray


def _check_reachable(address: str, option: str) -> None:
    """Knock at the address first: Ray itself tries for many minutes."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=_KNOCK_S).close()
    except (OSError, ValueError, OverflowError) as error:
        raise _no_cluster(address, option, error) from error


def _no_cluster(address: str | None, option: str, error: Exception) -> UserError:
    return UserError(
        f"{option} {address}: {error}",
        "host:port of a running Ray cluster that this machine belongs to",
        "start one with `ray start --head`, or leave the address out",
    )


_workers: dict[str, Worker] = {}
"""The worker of the current job in this process; Ray keeps processes for several tasks and jobs."""


def _perform(content: list[Any], key: str, task: Task) -> tuple[str, Outcome]:
    """Do a task in a process of the cluster; return the node's id and what came of it."""
    import ray

    if key not in _workers:
        os.environ.setdefault(THREADS_SETTING, "1")  # Ray gave this task one core
        _workers.clear()
        # Bytes, unpickled here: arrays out of Ray's store would be read-only, another type to the
        # compiled loops.
        _workers[key] = Worker(ray.get(content[0]))
    return ray.get_runtime_context().get_node_id(), _workers[key].perform(task)
