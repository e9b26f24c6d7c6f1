"""Processes of this machine and a Ray cluster: one set of bytes, and deaths that are told."""

import os
import pickle
import signal
from collections.abc import Iterator
from typing import Any

import pytest

from dopepp.core.errors import UserError
from dopepp.core.interrupts import StoppedError
from dopepp.data.jobs.job import WRITERS, begin
from dopepp.data.jobs.pools import ClusterPool, ProcessPool
from dopepp.data.jobs.render_dataset import render_dataset
from dopepp.data.jobs.work import Shard, Task

NUM = 60


@pytest.fixture
def work(small_job, tmp_path):
    job = small_job("ndds")
    begin(tmp_path, job.record)
    job.writer(tmp_path).prepare()
    return pickle.dumps((job, tmp_path))


def singles() -> Iterator[Task]:
    for index in range(10_000):
        yield Task(0, range(index, index + 1))


def stop_in_the_middle(work: bytes, processes: list[Any]) -> None:
    with ProcessPool(work, 2) as pool:
        processes += [one.process for one in pool._processes]
        for _, outcome in zip(range(5), pool.run(singles()), strict=False):
            assert outcome.error is None
        for process in processes:  # Ctrl-C reaches them, and they go on
            os.kill(process.pid, signal.SIGINT)
            os.kill(process.pid, signal.SIGTERM)
        raise KeyboardInterrupt


@pytest.mark.skipif(os.name != "posix", reason="signals are asked of POSIX")
def test_a_stopped_pool_completes_its_images_and_a_dead_worker_is_one_line(work, tmp_path):
    stopped = []
    with pytest.raises(KeyboardInterrupt):
        stop_in_the_middle(work, stopped)
    assert [process.exitcode for process in stopped] == [0, 0]
    assert not list(tmp_path.glob(".*"))
    with ProcessPool(work, 1) as pool:
        (process,) = (one.process for one in pool._processes)
        outcomes = pool.run(singles())
        assert next(outcomes).error is None
        os.kill(process.pid or 0, signal.SIGKILL)
        with pytest.raises(StoppedError, match=r"a worker process died \(signal 9\); if memory"):
            list(outcomes)
    assert not process.is_alive()


def test_a_pool_reads_no_further_ahead_than_it_has_room(work):
    read = 0

    def tasks():
        nonlocal read
        for chunk in range(50):
            read = chunk + 1
            yield Task(chunk, range(0), finalizes=False)

    done = []
    with ProcessPool(work, 2) as pool:
        for outcome in pool.run(tasks()):
            assert outcome.error is None
            done.append(outcome.task.chunk)
            assert read <= len(done) + 4
        assert list(pool.run([])) == []
    assert sorted(done) == list(range(50))


def test_an_error_in_a_worker_arrives_as_what_it_was(small_job, tmp_path):
    def open_pool(content, num_tasks):
        (tmp_path / "_dopepp_render.json").unlink()
        return ProcessPool(content, 1)

    with pytest.raises(UserError, match="as one of the workers sees it"):
        render_dataset(small_job(), tmp_path, 3, open_pool)


@pytest.mark.slow
@pytest.mark.parametrize("layout", WRITERS)
def test_one_worker_two_workers_and_two_nodes_write_the_same_bytes(
    layout, two_nodes, tmp_path, small_job, contents
):
    def processes(num):
        return lambda content, num_tasks: ProcessPool(content, num)

    job = small_job(layout, size="64x48")
    for num in (1, 2):
        render_dataset(job, tmp_path / str(num), NUM, processes(num))
    for number in range(2):
        pools = []

        def open_pool(content, num_tasks):
            pools.append(ClusterPool(content, two_nodes.address, 1))  # noqa: B023
            return pools[0]  # noqa: B023

        render_dataset(job, tmp_path / "ray", NUM, open_pool, Shard(number, 2))
        assert len(pools[0].num_tasks) == 2  # both nodes had work
    one = contents(tmp_path / "1")
    assert sum(len(content) for content in one.values()) > 1000 * NUM
    assert contents(tmp_path / "2") == one
    assert contents(tmp_path / "ray") == one


@pytest.mark.slow
def test_both_nodes_work_and_a_lost_node_costs_nothing(two_nodes, work, tmp_path):
    second = two_nodes.add_node(num_cpus=1, object_store_memory=80_000_000)
    done = []
    with ClusterPool(work, two_nodes.address, 1) as pool:
        for outcome in pool.run(Task(0, range(i, i + 8)) for i in range(0, 160, 8)):
            assert outcome.error is None
            done += outcome.task.indices
            if len(done) == 40:
                two_nodes.remove_node(second, allow_graceful=False)
    assert sorted(done) == list(range(160))
    assert len(list(tmp_path.glob("0*.json"))) == 160
