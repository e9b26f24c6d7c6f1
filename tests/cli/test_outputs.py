"""Files that ``dopepp predict`` writes, also if it is interrupted or fails."""

import errno
import json
import os
import re
import signal
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from dopepp.cli.outputs import JsonLines
from dopepp.data.formats.bop.bop_results import read_results
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual import PRESETS, Factory

FRAMES = 5


@pytest.fixture(scope="module")
def rendered():
    return Factory([pivconnector()], PRESETS["quickstart"].reframed(320, 240), 2).render(0, 9)


@pytest.fixture(scope="module")
def files(rendered, tmp_path_factory):
    """A video and an image of the same part, and an image without a part."""
    folder = tmp_path_factory.mktemp("files")
    fourcc = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(folder / "clip.avi"), fourcc, 10.0, (320, 240))
    for _ in range(FRAMES):
        writer.write(rendered.image[..., ::-1])
    writer.release()
    cv2.imwrite(str(folder / "000007.jpg"), rendered.image[..., ::-1])
    cv2.imwrite(str(folder / "000009.png"), np.full_like(rendered.image, 90))
    np.savetxt(folder / "K.txt", rendered.scene.K)
    return folder


@pytest.fixture
def predict(run, files):
    camera = ("--camera", files / "K.txt")
    return lambda *words, **code: run("predict", "pretrained/pivconnector", *words, *camera, **code)


def frames(path: Path) -> int:
    capture, count = cv2.VideoCapture(str(path)), 0
    while capture.grab():
        count += 1
    return count


def lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_all_outputs_for_images_and_a_video(predict, files, rendered, tmp_path):
    out, poses, csv = tmp_path / "out", tmp_path / "poses.jsonl", tmp_path / "poses.csv"
    sources = (f"{files}/0*", files / "clip.avi")
    done = predict(*sources, "--save", out, "--json", poses, "--csv", csv, "--stride", 2)
    assert sorted(path.name for path in out.iterdir()) == ["000007.jpg", "clip.mp4"]
    assert frames(out / "clip.mp4") == 3
    true = rendered.scene.objects[rendered.scene.targets[0]].T_cam_obj
    result = lines(poses)
    assert [entry["number"] for entry in result] == [7, 0, 2, 4]
    assert [entry["time"] for entry in result] == [None, 0, pytest.approx(0.2), pytest.approx(0.4)]
    for record in result:
        assert "x right, y down, z forward" in record["frame"]
        T = np.array(record["detections"][0]["T_cam_obj"])
        assert np.linalg.norm(T[:3, 3] - true[:3, 3]) < 0.02
    rows = read_results(csv, [1])
    assert [(row.scene_id, row.im_id) for row in rows] == [(0, 7), (1, 0), (1, 2), (1, 4)]
    for row, entry in zip(rows, result, strict=True):
        np.testing.assert_allclose(row.T_cam_obj, entry["detections"][0]["T_cam_obj"], atol=1e-9)
    assert len(done.stdout.splitlines()) == 4
    messages = done.stderr.splitlines()
    assert len(messages) == 4
    assert all("speed: pre " in item and item.endswith(" ms") for item in messages)
    assert messages[1].startswith("1/3 clip.avi: 1 pose; ")


def test_an_image_without_the_part_has_an_empty_line(predict, files, tmp_path):
    poses, csv = tmp_path / "poses.jsonl", tmp_path / "p.csv"
    done = predict(files / "000009.png", "--json", poses, "--csv", csv)
    assert (done.exit_code, done.stdout) == (0, "")
    assert done.stderr.startswith("nothing found: pivconnector: ")
    assert lines(poses)[0]["detections"] == []
    assert csv.read_text() == "scene_id,im_id,obj_id,score,R,t,time\n"
    done = predict(files / "000007.jpg", "--conf", "1")
    weaker = r"1 weaker below 1 \(--conf 0\.\d+ shows them\)"
    assert re.match(rf"nothing found; {weaker}: pivconnector: at pixel", done.stderr)
    assert "score" in done.stderr


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interruptions_keep_the_written_files(predict, files, tmp_path, monkeypatch, number, code):
    write, written = JsonLines.write, []

    def interrupted(self, result):
        written.append(result)
        if len(written) == 3:  # the image is written, the lines of JSON and CSV are not
            os.kill(os.getpid(), number)
        write(self, result)

    monkeypatch.setattr(JsonLines, "write", interrupted)
    out, poses, csv = tmp_path / "out", tmp_path / "poses.jsonl", tmp_path / "poses.csv"
    done = predict(files / "clip.avi", "--save", out, "--json", poses, "--csv", csv, code=code)
    assert done.stderr.splitlines()[-1] == "interrupted; the written files are complete"
    assert frames(out / "clip.mp4") == 3
    assert len(lines(poses)) == len(read_results(csv, [1])) == 3
    assert sorted(path.name for path in tmp_path.rglob("*")) == [
        "clip.mp4", "out", "poses.csv", "poses.jsonl",
    ]  # fmt: skip


def test_a_full_disk_is_one_line_and_code_1(predict, files, tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=0))
    poses = tmp_path / "poses.jsonl"
    done = predict(files / "clip.avi", "--save", tmp_path / "out", "--json", poses, code=1)
    assert done.stderr.splitlines()[-1].startswith(f"no space left for {tmp_path}/out/clip.mp4")
    monkeypatch.undo()

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("dopepp.core.files.Path.write_bytes", full)
    done = predict(files / "000007.jpg", "--save", tmp_path / "out", "--json", poses, code=1)
    assert done.stderr.splitlines()[-1] == f"no space left for {tmp_path}/out: free some disk space"
    assert poses.exists()
    assert not list(tmp_path.rglob("*.partial"))


def test_overlays_do_not_overwrite_their_images(predict, files):
    before = (files / "000007.jpg").read_bytes()
    done = predict(files / "000007.jpg", "--save", files, code=2)
    assert "the folder of" in done.stderr.splitlines()[-1]
    assert (files / "000007.jpg").read_bytes() == before


@pytest.mark.parametrize("linked", [False, True])
def test_overlays_do_not_overwrite_images_of_later_sources(predict, files, tmp_path, linked):
    image = (files / "000007.jpg").read_bytes()
    for folder in ("left", "right"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "1.jpg").write_bytes(image)
    if linked:
        (tmp_path / "link").symlink_to(tmp_path / "right")
    right = tmp_path / ("link" if linked else "right")
    done = predict(tmp_path / "left", tmp_path / "right", "--save", right, code=2)
    assert f"the folder of {right}/1.jpg" in done.stderr.splitlines()[-1]
    assert (tmp_path / "right" / "1.jpg").read_bytes() == image


def test_equal_names_are_numbered(predict, files, tmp_path):
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "000007.jpg").write_bytes((files / "000007.jpg").read_bytes())
    predict(files / "000007.jpg", tmp_path / "b", "--save", tmp_path / "out")
    assert len(list((tmp_path / "out").iterdir())) == 2


def test_a_damaged_image_stops_a_folder_and_keeps_the_written_files(predict, files, tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "1.jpg").write_bytes((files / "000007.jpg").read_bytes())
    (tmp_path / "in" / "2.jpg").write_bytes((files / "000007.jpg").read_bytes()[:900])
    done = predict(tmp_path / "in", "--json", tmp_path / "poses.jsonl", code=2)
    assert "2.jpg" in done.stderr.splitlines()[-1]
    assert len(lines(tmp_path / "poses.jsonl")) == 1
