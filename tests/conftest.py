import contextlib
import io
import os
import runpy
import sys
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


@pytest.fixture(scope="session")
def tiny_options():
    """Options of a training whose network and data take no time."""
    return (
        "data=virtual",
        "data.parts=[pivconnector]",
        "virtual.preset=quickstart",
        "data.input_size=[64,64]",
        "data.samples_per_epoch=8",
        "data.batch_size=4",
        "data.num_val=2",
        "data.num_test=3",
        "data.num_workers=0",
        "model.width=0.0625",
        "trainer.max_epochs=1",
    )


@pytest.fixture(scope="session")
def tiny_spec():
    """What a checkpoint says of the smallest DOPE++ for one part."""
    return {
        "backbone": {"_target_": "dopepp.models.backbones.DSC", "width": 0.0625},
        "attention": {"_target_": "dopepp.models.attention.Identity"},
        "head": {"_target_": "dopepp.models.heads.MultiScale", "width": 0.0625},
        "activation": "exp",
        "num_objects": 1,
    }


@pytest.fixture(scope="session")
def in_process():
    """Run an entry point inside this process; returns exit code, output and error output."""

    def run(path: Path, *arguments: str) -> tuple[int, str, str]:
        out, err, code = io.StringIO(), io.StringIO(), 0
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", [str(path), *arguments])
            patch.setenv("HYDRA_FULL_ERROR", "1")  # the entry point sets it: undone here
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                try:
                    runpy.run_path(str(path), run_name="__main__")
                except SystemExit as end:
                    code = int(end.code or 0) if isinstance(end.code, int | None) else 1
        return code, out.getvalue(), err.getvalue()

    return run


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
