"""Contents of Rerun recordings, and errors of the viewer."""

import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.inference.frames.media import Images
from dopepp.inference.pose_result import PoseResult, make_shape
from dopepp.inference.viewer import Viewer, belief_images

rerun = pytest.importorskip("rerun")


@pytest.fixture
def estimator(piv_estimator):
    return piv_estimator


@pytest.fixture(scope="module")
def result(piv_estimator, piv_render):
    image, K = piv_render.image, piv_render.scene.K
    shapes = {part.name: make_shape(part) for part in piv_estimator.parts}
    detections = piv_estimator.predict(image, K)
    assert detections
    return PoseResult(image, K, detections, {}, "clip.mp4", 3, 0.3, shapes=shapes)


def test_recording_contains_every_entity(estimator, result, tmp_path):
    path = tmp_path / "new" / "out.rrd"
    viewer = Viewer(estimator, path)
    viewer.write(result)
    viewer.write(PoseResult(result.image, result.K, [], {}, "clip.mp4", 4, 0.4))
    assert not path.exists()
    viewer.close()
    assert [file.name for file in path.parent.iterdir()] == ["out.rrd"]
    chunks = rerun.chunk.RrdReader(path).stream().to_chunks()
    logged = {chunk.entity_path for chunk in chunks}
    name = "pivconnector_0"
    assert logged >= {
        "/world", "/world/camera", "/world/camera/image", "/world/camera/outlines",
        "/beliefs/pivconnector", "/summary",
        f"/world/parts/{name}", f"/world/parts/{name}/cuboid", f"/world/meshes/{name}",
        f"/world/uncertainty/{name}",
    }  # fmt: skip
    assert {name for chunk in chunks for name in chunk.timeline_names} >= {"frame", "time"}


def test_frames_of_the_next_source_follow_on_the_timeline(estimator, result, tmp_path):
    path = tmp_path / "out.rrd"
    viewer = Viewer(estimator, path)
    for _ in range(2):
        viewer.begin(Images([tmp_path / "any.png"]))
        viewer.write(result)
    viewer.close()
    chunks = rerun.chunk.RrdReader(path).stream().to_chunks()
    shown = [chunk for chunk in chunks if chunk.entity_path == "/summary"]
    frames = [row["frame"] for chunk in shown for row in chunk.to_record_batch().to_pylist()]
    assert sorted(frames) == [3, 7]


def test_beliefs_peak_where_the_part_is(estimator, result):
    (colours,) = belief_images(estimator, result).values()
    hottest = np.array(np.unravel_index(colours.sum(axis=2).argmax(), colours.shape[:2]))[::-1]
    scale = np.array(result.image.shape[1::-1]) / colours.shape[1::-1]
    nearest = np.abs((hottest + 0.5) * scale - result.detections[0].keypoints).sum(axis=1).min()
    assert nearest < 2 * scale.max()


def test_errors_name_the_suffix_the_extra_and_the_file_option(estimator, tmp_path, monkeypatch):
    with pytest.raises(UserError, match=r"\.rrd"):
        Viewer(estimator, tmp_path / "out.mp4")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(UserError, match=r"--rerun FILE\.rrd"):
        Viewer(estimator)
    monkeypatch.setattr("dopepp.core.errors.find_spec", lambda _: None)
    with pytest.raises(UserError, match=r"dopepp\[rerun\]"):
        Viewer(estimator, tmp_path / "out.rrd")
