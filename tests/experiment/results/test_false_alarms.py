"""Detections on images without the part: numbers counted by hand, and cameras."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from dopepp.core.errors import UserError
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.results.false_alarms import (
    KEY,
    NUM_HIGHEST,
    FalseAlarms,
    alarm_rows,
    count_false_alarms,
    frames_without_parts,
)
from dopepp.experiment.results.report import Cost, Report

CAMERA = """image_width: 64
image_height: 48
camera_matrix: {rows: 3, cols: 3, data: [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.3, 0, 0, 0, 0]}
"""


@pytest.fixture
def folder(tmp_path):
    """Nine images whose grey level is 20 times their number."""
    (tmp_path / "photos").mkdir()
    for number in range(9):
        write_image(tmp_path / "photos" / f"{number}.png", np.full((48, 64, 3), 20 * number))
    (tmp_path / "camera.yaml").write_text(CAMERA)
    return tmp_path


def write_image(path, pixels):
    assert cv2.imwrite(str(path), pixels.astype(np.uint8))


class Estimator:
    """Estimator with candidates of the scores k/10 and k/20 on image k > 0."""

    min_score = 0.39

    def candidates(self, image, K, cropped):
        grey = int(image[24, 32, 0])
        scores = [grey / 200, grey / 400] if grey else []
        keypoints = np.full((9, 2), 20.0)
        return [SimpleNamespace(object="bolt", score=s, keypoints=keypoints) for s in scores]

    def split(self, candidates):
        return [each for each in candidates if each.score >= self.min_score], []


def test_detections_are_counted_from_the_threshold_on(folder, tiny):
    frames = frames_without_parts(folder / "photos", folder / "camera.yaml", tiny().data, [])
    alarms, tiles = count_false_alarms({"dopepp": Estimator()}, frames)
    # The better candidates of images 4 to 8 and the weaker of image 8 reach 0.39.
    assert alarms["dopepp"].per_image == pytest.approx(6 / 9)
    highest = {f"{number}.png": number / 10 for number in range(8, 8 - NUM_HIGHEST, -1)}
    assert alarms["dopepp"].highest == pytest.approx(highest)
    assert [tile.caption for tile in tiles] == list(alarms["dopepp"].highest) == list(highest)


def test_images_have_the_named_camera_or_the_camera_of_the_data(folder, tiny):
    data = tiny().data

    def samples(camera, parts=()):
        source = frames_without_parts(folder / "photos", camera, data, parts)
        return {sample.key: sample for sample in map(source.sample, range(len(source)))}

    grid = np.zeros((48, 64, 3), np.uint8)
    grid[::8], grid[:, ::8] = 255, 255
    write_image(folder / "photos" / "0.png", grid)
    sample = samples(folder / "camera.yaml")["0.png"]
    lens = np.array([-0.3, 0, 0, 0, 0])
    np.testing.assert_array_equal(sample.image, cv2.undistort(grid, sample.K, lens))
    assert (sample.K[0, 0], sample.size, sample.instances) == (60, (64, 48), [])
    (folder / "K.txt").write_text("60 0 31.5\n0 60 23.5\n0 0 1\n")
    assert samples(folder / "K.txt")["0.png"].size == (64, 48)
    own = next(iter(samples(None, build_parts(data)).values()))
    assert own.size[0] / own.K[0, 0] >= data.preset.width / data.preset.K[0, 0]
    with pytest.raises(UserError, match="no photo"):
        frames_without_parts(folder / "empty", None, data, [])


def test_a_readme_has_a_row_for_the_network_and_the_refined_poses():
    counts = FalseAlarms(20, 0.05, 0.9, {"a.png": 0.95})
    report, refined = (Report(name, {}, {}, {}, Cost(), 1) for name in ("x", "x + region"))
    report.refined = refined
    assert alarm_rows(report) == []
    report.details[KEY], refined.details[KEY] = vars(counts), vars(FalseAlarms(20, 0, 0.9, {}))
    rows = [list(row.values()) for row in alarm_rows(report)]
    assert rows == [
        ["x", "20", "0.050", "0.9", "0.95", "a.png"],
        ["x + region", "20", "0.000", "0.9", "n/a", ""],
    ]
