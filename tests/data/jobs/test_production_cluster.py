"""The same job on a Ray cluster of two nodes: labels and pixels are the same bytes."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path
from typing import Any

import pytest

from dopepp.core.errors import UserError
from dopepp.data.jobs.cluster import ClusterPool, connect
from dopepp.data.jobs.folder import begin
from dopepp.data.jobs.job import Job, make_job
from dopepp.data.jobs.processes import ProcessPool
from dopepp.data.jobs.render_dataset import OpenPool, render_dataset
from dopepp.data.jobs.work import Shard, Task, Work

NUM = 60


def small_job(layout: str) -> Job:
    return make_job(["servoholder"], preset="quickstart", size="64x48", layout=layout)


def contents(root: Path) -> dict[str, bytes]:
    files = (path for path in root.rglob("*") if path.is_file())
    return {str(path.relative_to(root)): path.read_bytes() for path in files}


def processes(num: int) -> OpenPool:
    return lambda content, num_tasks: ProcessPool(content, num)


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["bop", "ndds", "webdataset"])
def test_one_worker_two_workers_and_two_nodes_write_the_same_bytes(
    layout: str, two_nodes: Any, tmp_path: Path
) -> None:
    job = small_job(layout)
    for num in (1, 2):
        render_dataset(job, tmp_path / str(num), NUM, processes(num))
    for number in range(2):
        pools: list[ClusterPool] = []

        def open_pool(content: bytes, num_tasks: int) -> ClusterPool:
            pools.append(ClusterPool(content, two_nodes.address, 1))  # noqa: B023
            return pools[0]  # noqa: B023

        render_dataset(job, tmp_path / "ray", NUM, open_pool, Shard(number, 2))
        assert len(pools[0].num_tasks) == 2  # both nodes had work
    one = contents(tmp_path / "1")
    assert sum(len(content) for content in one.values()) > 1000 * NUM
    assert contents(tmp_path / "2") == one
    assert contents(tmp_path / "ray") == one


@pytest.mark.slow
def test_both_nodes_work_and_a_lost_node_costs_nothing(two_nodes: Any, tmp_path: Path) -> None:
    job = small_job("ndds")
    begin(tmp_path, job.record)
    work = Work(job.factory, "ndds", tmp_path)
    work.writer().prepare()
    second = two_nodes.add_node(num_cpus=1, object_store_memory=80_000_000)
    done: list[int] = []
    with ClusterPool(pickle.dumps(work), two_nodes.address, 1) as pool:
        for outcome in pool.run(Task(0, range(i, i + 8)) for i in range(0, 160, 8)):
            assert outcome.error is None
            done += outcome.task.indices
            if len(done) == 40:
                two_nodes.remove_node(second, allow_graceful=False)
    assert sorted(done) == list(range(160))
    assert work.writer().written(0) == set(range(160))


def test_without_ray_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.setattr("dopepp.data.jobs.cluster.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pip install 'dopepp\[ray\]'"):
        connect(None, 1)


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nowhere", "127.0.0.1:99999999", "a:b"])
def test_an_address_without_a_cluster_is_refused_at_once(address: str) -> None:
    pytest.importorskip("ray")
    with pytest.raises(UserError, match=f"--ray-address {address}: .*ray start --head"):
        connect(address, 1)
