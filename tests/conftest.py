"""Real data, the smallest training, and the ways to run the project's scripts."""

import contextlib
import gc
import io
import os
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import pytest
from hypothesis import settings

ROOT = Path(__file__).parents[1]
# Two processes with a thread for every core wait for each other, up to twenty times as long.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# How long an example takes says what else the machine does.
settings.register_profile("untimed", deadline=None, max_examples=30)
settings.load_profile("untimed")


# Imported modules live as long as the process. Searching them for garbage again and again takes a
# tenth of the time.
gc.disable()


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


def pytest_unconfigure() -> None:
    gc.unfreeze()  # or extension modules report leaks


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take longest, so that both processes end at about the same time.

    The first of all compiles no inner loops; otherwise, both processes would compile the same ones.
    """
    first = ("test_quality.py", "end_to_end")
    items.sort(key=lambda item: [name not in item.path.parts for name in first])


@pytest.fixture(scope="session")
def shared_data():
    """Folder with the real frames, meshes, parts and photos; skips where it is missing."""
    root = Path(os.environ.get("DOPEPP_TEST_DATA", ROOT.parent / "shared" / "data"))
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
        "model/head=shared_trunk",
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


class Done(NamedTuple):
    """How a command ended, and what it printed."""

    code: int
    out: str
    err: str

    def checked(self, code: int | None) -> "Done":
        """Fail where it should have ended with another code."""
        assert code in (None, self.code), (
            f"code {self.code}\n{self.out[-2000:]}\n{self.err[-4000:]}"
        )
        return self

    @property
    def last_line(self) -> str:
        """The last line on stderr, which says how it ended."""
        return self.err.rstrip("\n").rpartition("\n")[2]

    @property
    def line(self) -> str:
        """The one line that a user's mistake is told in."""
        line = self.checked(2).last_line
        assert "Traceback" not in self.err
        assert line.startswith("got ")
        assert "; allowed: " in line
        assert "; fix: " in line
        return line


@pytest.fixture(scope="session")
def call():
    """Run an entry point inside this process, ten times faster than as one of its own.

    It must end with ``code``.
    """

    def run(script: str, *arguments: str, code: int | None = None) -> Done:
        path, out, err, ended = str(ROOT / script), io.StringIO(), io.StringIO(), 0
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", [path, *arguments])
            patch.setenv("HYDRA_FULL_ERROR", "1")  # the entry point sets it: undone here
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                try:
                    runpy.run_path(path, run_name="__main__")
                except SystemExit as end:
                    ended = int(end.code or 0) if isinstance(end.code, int | None) else 1
        return Done(ended, out.getvalue(), err.getvalue()).checked(code)

    return run


@pytest.fixture(scope="session")
def start(tmp_path_factory):
    """Start a script, or ``-c`` and code, as a process in a folder that is not the project's."""
    folder = tmp_path_factory.mktemp("cwd")
    offline = {"WANDB_MODE": "offline", "WANDB_DIR": str(folder), "WANDB_SILENT": "true"}
    # A service that a run inside this process has started would be used by its children, too.
    own = {name: value for name, value in os.environ.items() if name != "WANDB_SERVICE"}
    usual = {**own, **offline, "PYTHONPATH": str(ROOT)}

    def begin(script: str, *arguments: str, **options: Any) -> Any:
        options["env"] = usual | options.get("env", {})
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        path = script if script == "-c" else str(ROOT / script)
        command = [sys.executable, path, *arguments]
        return subprocess.Popen(command, cwd=folder, text=True, **streams | options)

    return begin


@pytest.fixture(scope="session")
def command(start):
    """Run a script, or ``-c`` and code, as a process, which must end with ``code``."""

    def run(
        script: str, *arguments: str, code: int | None = None, timeout: float = 240, **options: Any
    ) -> Done:
        with start(script, *arguments, **options) as process:
            try:
                out, err = process.communicate(timeout=timeout)
            except subprocess.TimeoutExpired:
                process.kill()
                raise
        return Done(process.returncode, out, err).checked(code)

    return run


@pytest.fixture(scope="module")
def quick_sky():
    """Bake ambient occlusion from few directions, where its values do not matter."""
    from dopepp.virtual.surface import occlusion

    spread = occlusion.spread_directions
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(occlusion, "spread_directions", lambda count: spread(min(count, 12)))
        patch.setattr(occlusion, "_BAKED", {})
        yield


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


@pytest.fixture
def near_truth(monkeypatch):
    """Replace the templates by a detector that answers with poses near the given ones.

    Its ``truth`` lists the poses; each has two starts, and the first also a false one.
    """
    import numpy as np

    from dopepp.geometry.camera import project_keypoints
    from dopepp.geometry.rotation import rotation_vector_to_matrix
    from dopepp.recovery.detection import Detection

    class NearTruth:
        truth: ClassVar[list[np.ndarray]] = []

        def __init__(self, part, working_distance, tilt_deg=180.0):
            self.part, self.working_distance, self.tilt_deg = part, working_distance, tilt_deg
            self.asked = []

        def detect(self, image, K, distances=None, roi=None):
            self.asked.append((distances, roi))
            starts = []
            for T_true in self.truth:
                for score, turn in ((0.8, [0.03, 0, 0.02]), (0.7, [0, -0.03, 0.02])):
                    T = T_true.copy()
                    T[:3, :3] = rotation_vector_to_matrix(np.array(turn)) @ T[:3, :3]
                    starts.append(self.start(T, score, K))
            for T in self.truth[:1]:
                shift = np.eye(4)
                shift[:3, 3] = 0.05
                starts.append(self.start(shift @ T, 0.5, K))
            return starts

        def silhouette(self, T, image, K):
            return 1.0

        def half_turned(self, T):
            return []

        def turned(self, T):
            return []

        def start(self, T, score, K):
            points, peaks = project_keypoints(self.part.cuboid, T, K), np.full((9, 2), np.nan)
            covariance = np.diag([0.03**2] * 3 + [0.001**2] * 3)
            return Detection(self.part.name, score, score, T, points, peaks, 0.0, covariance)

    def background_log_odds(part, distances, tilt, measure):
        return 0.0

    monkeypatch.setattr("dopepp.inference.template_estimator.TemplateDetector", NearTruth)
    monkeypatch.setattr(
        "dopepp.inference.template_estimator.background_log_odds", background_log_odds
    )
    return NearTruth
