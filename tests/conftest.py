from __future__ import annotations

import os
from pathlib import Path

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take longest, so that both processes end at about the same time."""
    items.sort(key=lambda item: not {"end_to_end", "test_quality.py"} & set(item.path.parts))


@pytest.fixture(scope="session")
def shared_data():
    """Folder with the real frames, meshes, parts and photos; skips where it is missing."""
    root = Path(os.environ.get("DOPEPP_TEST_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not root.is_dir():
        pytest.skip(f"real test data not found in {root}; set DOPEPP_TEST_DATA")
    return root


@pytest.fixture(scope="session")
def ycb_root(shared_data):
    return shared_data / "ycb_video_mini"


@pytest.fixture
def two_nodes():
    """A Ray cluster of two machines, both this one."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 1, "object_store_memory": 80_000_000}
    cluster = Cluster(
        initialize_head=True, head_node_args=node | {"include_dashboard": False}, connect=False
    )
    cluster.add_node(**node)
    cluster.wait_for_nodes()
    yield cluster
    cluster.shutdown()
