"""PoseResult: drawing, text, JSON and table."""

import json
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.geometry.camera import camera_matrix, make_transform, project_keypoints
from dopepp.inference.pose_result import COLOURS, PoseResult, make_shape, silhouette_contours
from dopepp.parts.catalogue import pivconnector
from dopepp.recovery.detection import Detection
from dopepp.virtual import PRESETS, Factory

PART = pivconnector()
SHAPES = {PART.name: make_shape(PART)}
K = camera_matrix(560, 560, 319.5, 239.5)
FRAME = "camera, OpenCV: x right, y down, z forward; metres"


def detection(T, score=0.9):
    keypoints = project_keypoints(PART.cuboid, T, K)
    return Detection(PART.name, score, score, T, keypoints, keypoints, 0.5, np.eye(6) * 1e-6)


def pose(x=0.0, z=0.3, turn=0.5):
    return make_transform(Rotation.from_rotvec([turn, 0.3, 0.2]).as_matrix(), np.array([x, 0, z]))


def result(*poses, size=(640, 480), **fields):
    image = np.full((*size[::-1], 3), 128, np.uint8)
    speed = {"pre": 1.0, "network": 2.0, "decode": 3.0, "refine": 0.0}
    result = [detection(pose, 0.9 - 0.1 * number) for number, pose in enumerate(poses)]
    given = {"name": "a.png", "shapes": SHAPES} | fields
    return PoseResult(image, K, result, speed, **given)


@pytest.mark.parametrize("index", range(4))
def test_silhouette_is_the_renderers_mask(index):
    rendered = Factory([PART], PRESETS["quickstart"].reframed(320, 240), 5).render(0, index)
    target = rendered.scene.targets[0]
    T, mask = rendered.scene.objects[target].T_cam_obj, np.zeros((240, 320), np.uint8)
    contours = silhouette_contours(SHAPES[PART.name], T, rendered.scene.K, rendered.image)
    cv2.drawContours(mask, contours, -1, 1, -1)
    truth = rendered.instances == target
    assert (mask.astype(bool) & truth).sum() / (mask.astype(bool) | truth).sum() > 0.97


@pytest.mark.parametrize("factor", [0.2, 1.0, 4.0])
def test_lines_and_text_scale_with_the_image(factor):
    width, height = round(640 * factor), round(480 * factor)
    own_K = K.copy()
    own_K[:2] *= factor
    small = result(pose(), pose(0.06))
    large = replace(
        small, image=np.full((height, width, 3), 128, np.uint8), K=own_K,
        detections=[replace(d, keypoints=d.keypoints * factor) for d in small.detections],
    )  # fmt: skip
    drawn, expected = large.plot(), small.plot()
    assert drawn.shape[1] >= 640
    shrunk = cv2.resize(drawn, (640, 480), interpolation=cv2.INTER_AREA)
    touched, own = masks = [(np.abs(item - 128.0) > 40).any(axis=2) for item in (expected, shrunk)]
    for mask, other in (masks, masks[::-1]):
        near = cv2.dilate(other.astype(np.uint8), np.ones((9, 9))) > 0
        assert (mask & near).sum() > 0.9 * mask.sum()
    assert own.sum() == pytest.approx(touched.sum(), rel=0.5)


def test_neighbours_have_distinct_colours():
    drawn = result(pose(-0.03), pose(0.03)).plot()
    for colour in COLOURS[:2]:
        assert (np.abs(drawn.astype(int) - colour).sum(axis=2) < 12).sum() > 200
    assert (drawn[:60] == 128).all()
    assert (drawn[-60:] == 128).all()


def test_poses_outside_the_image_can_be_drawn():
    behind, through, aside, far = pose(z=-0.3), pose(z=0.01), pose(x=5.0), pose(z=90.0)
    assert result(behind, through, aside, far, size=(40, 30)).plot().shape == (480, 640, 3)
    assert (result(pose(), shapes={}).plot() != 128).any()


def test_image_format_follows_the_suffix(tmp_path):
    for name in ("a.png", "new/b.JPG"):
        result(pose()).save(tmp_path / name)
        assert cv2.imread(str(tmp_path / name)).shape == (480, 640, 3)
    with pytest.raises(UserError, match=r"\.png, \.jpg"):
        result(pose()).save(tmp_path / "a.gif")


def test_weaker_candidates_are_counted_in_every_output():
    plain, loud = result(pose()), result(pose(), weaker=[0.3, 0.051], min_score=0.312)
    assert (plain.summary, loud.summary) == ("1 pose", "1 pose; 2 weaker below 0.31")
    assert result(weaker=[0.1], min_score=0.5).summary == "nothing found; 1 weaker below 0.5"
    changed = (plain.plot() != loud.plot()).any(axis=2)
    assert changed[-20:, :200].any()
    assert not changed[:-20].any()
    contents = [json.loads(item.to_json()) for item in (plain, loud)]
    keys = ("min_score", "num_weaker", "best_weaker")
    values = [[content[key] for key in keys] for content in contents]
    assert values == [[0.0, 0, None], [0.312, 2, 0.3]]


def test_json_states_frame_and_null_for_nan():
    content = json.loads(result(pose(), pose(0.1), time=0.4, number=7, identities=[3, 5]).to_json())
    speed = {"pre": 1.0, "network": 2.0, "decode": 3.0, "refine": 0.0}
    expected = {"image": "a.png", "number": 7, "time": 0.4, "frame": FRAME, "speed_ms": speed}
    assert content.items() >= expected.items()
    np.testing.assert_allclose(content["K"], K)
    assert [record["identity"] for record in content["detections"]] == [3, 5]
    np.testing.assert_allclose(content["detections"][1]["T_cam_obj"], pose(0.1))
    assert np.shape(content["detections"][0]["covariance"]) == (6, 6)
    behind = json.loads(result(pose(z=-0.3)).to_json())["detections"][0]
    assert behind["keypoints"][0] == [None, None]
    assert json.loads(result().to_json())["detections"] == []
    (line,) = result(pose()).records()
    assert (line["image"], line["frame"], line["object"]) == ("a.png", FRAME, PART.name)
    assert not {"time", "identity"} & line.keys()


def test_table_contains_the_poses():
    pytest.importorskip("pandas")
    table = result(pose(), pose(0.1, turn=2.0)).to_dataframe()
    turns = Rotation.from_quat(table[["qw", "qx", "qy", "qz"]].to_numpy(), scalar_first=True)
    for row, T in zip(turns.as_matrix(), (pose(), pose(0.1, turn=2.0)), strict=True):
        np.testing.assert_allclose(row, T[:3, :3], atol=1e-12)
    assert table[["x", "y", "z"]].to_numpy().tolist() == [[0, 0, 0.3], [0.1, 0, 0.3]]
    assert table["frame"].unique().tolist() == [FRAME]
    assert list(table.columns) == list(result().to_dataframe().columns)
    assert math.isclose(table["score"][1], 0.8)
