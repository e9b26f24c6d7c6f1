"""Pools: order, errors, lost processes, interruptions, and missing clusters."""

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future

import pytest

from dopepp.core import pool as pool_module
from dopepp.core.errors import UserError
from dopepp.core.pool import (
    ClusterPool,
    LostWorkerError,
    Pool,
    ProcessPool,
    in_forked_process,
    map_in_threads,
)


def wait_for_group(process: int) -> None:
    """Wait until all processes of a group have ended."""
    for _ in range(600):
        try:
            os.killpg(process, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    pytest.fail("processes outlive their parent")


EVALUATE = pickle.dumps(eval)
posix = pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")


class InlinePool(Pool):
    """Completes items in this process, in reverse order, once ``room`` items are submitted."""

    def __init__(self, room: int) -> None:
        self._room, self.submitted = room, list[tuple[Future[object], object]]()

    def __exit__(self, *_: object) -> None: ...

    def capacity(self) -> int:
        return self._room

    def submit(self, item: object) -> Future[object]:
        self.submitted.append((Future(), item))
        assert len(self.submitted) <= self._room
        if len(self.submitted) == self._room or item == 9:
            while self.submitted:
                future, item = self.submitted.pop()
                future.set_result(item)
        return self.submitted[-1][0] if self.submitted else future


def test_results_may_determine_further_items():
    handed_out, values = [], [1]

    def items() -> Iterator[int]:
        while values and values[-1] < 1000:
            handed_out.append(values.pop())
            yield handed_out[-1]

    for _, future in InlinePool(1).run(items()):
        values.append(2 * future.result())
    assert handed_out == [2**power for power in range(10)]


def test_no_more_items_are_read_than_the_capacity():
    read = []

    def items() -> Iterator[str]:
        for number in range(50):
            read.append(number)
            yield f"{number} + 1"

    with ProcessPool(EVALUATE, 2) as pool:
        done = []
        for _, future in pool.run(items()):
            done.append(future.result())
            assert len(read) <= len(done) + pool.capacity()
        assert list(pool.run([])) == []
    assert sorted(done) == list(range(1, 51))


def test_an_error_and_a_lost_process_affect_one_item_each():
    died = "a worker process died ({}); if memory was short, use fewer --workers"
    errors = {
        "1 / 0": "ZeroDivisionError",
        "open('/nowhere')": "No such file",
        "__import__('os')._exit(3)": died.format("code 3"),
    }
    if os.name == "posix":
        errors["__import__('os').kill(__import__('os').getpid(), 9)"] = died.format("signal 9")
    items = [*errors, "6 * 7", "__import__('os').environ['OMP_NUM_THREADS']"]
    with ProcessPool(EVALUATE, 2) as pool:
        futures = dict(pool.run(items))
    assert [futures[item].result() for item in items[-2:]] == [42, "1"]
    for item, message in errors.items():
        assert message in str(futures[item].exception())
    kinds = [type(futures[item].exception()) for item in items[:3]]
    assert kinds == [RuntimeError, FileNotFoundError, LostWorkerError]


def test_a_function_that_cannot_be_unpickled_is_the_items_error():
    with ProcessPool(b"no pickle", 1) as pool:
        ((_, future),) = pool.run(["1"])
    with pytest.raises(RuntimeError, match="UnpicklingError"):
        future.result()


@posix
def test_a_stopped_pool_completes_its_items(tmp_path):
    started = []

    def stop_in_the_middle() -> None:
        with ProcessPool(EVALUATE, 1) as pool:
            item = f"__import__('time').sleep(0.5), open('{tmp_path}/done', 'x')"
            assert next(pool.run(["1", item]))[1].result() == 1
            started.extend(pool._processes)
            for number in (signal.SIGINT, signal.SIGTERM):  # the process continues
                os.kill(started[0].pid, number)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stop_in_the_middle()
    assert [process.exitcode for process in started] == [0]
    assert (tmp_path / "done").exists()


def test_an_item_that_takes_too_long_is_killed_when_the_pool_is_stopped(monkeypatch):
    monkeypatch.setattr(pool_module, "_PATIENCE_S", 0.2)

    def stop_in_the_middle() -> None:
        with ProcessPool(EVALUATE, 1) as pool:
            next(pool.run(["1", "__import__('time').sleep(60)"]))
            raise KeyboardInterrupt

    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        stop_in_the_middle()
    assert time.monotonic() - start < 30


@posix
def test_processes_end_after_their_parent_is_killed(tmp_path):
    code = """
import pickle
from dopepp.core.pool import ProcessPool
if __name__ == "__main__":
    with ProcessPool(pickle.dumps(eval), 2) as pool:
        for _ in pool.run(["1", "1", *["__import__('time').sleep(1)"] * 2]):
            print("done", flush=True)
"""
    (script := tmp_path / "script.py").write_text(code)
    command = [sys.executable, str(script)]
    parent = subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True)
    assert parent.stdout is not None
    assert parent.stdout.readline() == b"done\n"
    parent.kill()
    parent.wait()
    wait_for_group(parent.pid)


def test_without_ray_the_error_names_the_extra(monkeypatch):
    monkeypatch.setattr("dopepp.core.errors.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"--engine ray without .* pip install 'dopepp\[ray\]'"):
        ClusterPool(EVALUATE, None, 1)


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nowhere", "127.0.0.1:99999999", "a:b"])
def test_an_address_without_a_cluster_is_refused_at_once(address):
    pytest.importorskip("ray")
    with pytest.raises(UserError, match=f"--ray-address {address}: .*ray start --head"):
        ClusterPool(EVALUATE, address, 1)


@pytest.mark.parametrize("threads", ["1", "3"])
def test_results_of_threads_are_in_the_order_of_the_items(threads, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", threads)
    used = set()

    def slowest_first(item):
        used.add(threading.get_ident())
        time.sleep(0.02 * (5 - item))
        return item**2

    assert map_in_threads(slowest_first, range(5)) == [0, 1, 4, 9, 16]
    assert len(used) == int(threads)
    with pytest.raises(ZeroDivisionError):
        map_in_threads(lambda item: 1 / item, [1, 0])
    assert map_in_threads(str, [7]) == ["7"]
    nested = map_in_threads(
        lambda _: set(map_in_threads(lambda _: threading.get_ident(), range(4))), range(2)
    )
    assert [len(identities) for identities in nested] == [1, 1]
    assert map_in_threads(str, []) == []


def test_a_forked_process_returns_or_raises_what_its_function_does():
    parent = os.getpid()

    def fail(message):
        raise UserError(message, "nothing", "none")

    assert in_forked_process(lambda item: (item, os.getpid() != parent), 3) == (3, True)
    with pytest.raises(UserError, match="got this"):
        in_forked_process(fail, "this")
    with pytest.raises(LostWorkerError, match="died"):
        in_forked_process(os._exit, 1)
