"""Pools of processes and Ray clusters write the same bytes."""

import os
import pickle
import signal

import pytest

from dopepp.core.errors import StoppedError, UserError
from dopepp.core.pool import ClusterPool, ProcessPool
from dopepp.data.render_job import WRITERS, claim
from dopepp.data.render_run import RenderTask, RenderTasks, Shard, render_dataset

NUM = 60


def test_an_error_of_a_worker_keeps_its_type(small_job, tmp_path):
    def open_pool(content):
        (tmp_path / "_dopepp_render.json").unlink()
        return ProcessPool(content, 1)

    with pytest.raises(UserError, match="in which a worker finds no"):
        render_dataset(small_job(), tmp_path, 3, open_pool)


@pytest.mark.skipif(os.name != "posix", reason="signals are asked of POSIX")
def test_a_dead_worker_is_one_line(small_job, tmp_path):
    pools = []

    def open_pool(content):
        pools.append(ProcessPool(content, 1))
        return pools[0]

    def kill_the_worker(done, total):
        if done == 2:
            (process,) = pools[0]._processes
            os.kill(process.pid, signal.SIGKILL)

    message = r"a worker process died \(signal 9\); if memory .*; run the same command again"
    with pytest.raises(StoppedError, match=message):
        render_dataset(small_job("ndds"), tmp_path, NUM, open_pool, on_progress=kill_the_worker)


@pytest.mark.slow
@pytest.mark.parametrize("layout", WRITERS)
def test_one_worker_two_workers_and_two_nodes_write_the_same_bytes(
    layout, two_nodes, tmp_path, small_job, contents
):
    job = small_job(layout, size="64x48")
    for num in (1, 2):
        render_dataset(job, tmp_path / str(num), NUM, lambda work: ProcessPool(work, num))  # noqa: B023
    for number in range(2):
        pools = []

        def open_pool(content):
            pools.append(ClusterPool(content, two_nodes.address, 1))  # noqa: B023
            return pools[0]  # noqa: B023

        render_dataset(job, tmp_path / "ray", NUM, open_pool, Shard(number, 2))
        assert len(pools[0].num_tasks) == 2  # both nodes had work
    whole = contents(tmp_path / "1")
    assert sum(len(content) for content in whole.values()) > 1000 * NUM
    assert (contents(tmp_path / "2"), contents(tmp_path / "ray")) == (whole, whole)


@pytest.mark.slow
def test_both_nodes_work_and_tasks_of_a_lost_node_are_repeated(two_nodes, small_job, tmp_path):
    job = small_job("ndds")
    claim(tmp_path, job.record)
    job.writer(tmp_path).prepare()
    second = two_nodes.add_node(num_cpus=1, object_store_memory=80_000_000)
    done = []
    with ClusterPool(pickle.dumps(RenderTasks(job, tmp_path)), two_nodes.address, 1) as pool:
        for task, future in pool.run(RenderTask(0, range(i, i + 8)) for i in range(0, 160, 8)):
            future.result()
            done += task.indices
            if len(done) == 40:
                two_nodes.remove_node(second, allow_graceful=False)
    assert sorted(done) == list(range(160))
    assert len(list(tmp_path.glob("0*.json"))) == 160
