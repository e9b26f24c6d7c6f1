import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from dopepp.core.errors import UserError
from dopepp.data.formats.bop.bop_writer import BopWriter, make_labels
from dopepp.data.sample import Instance, Sample
from dopepp.geometry.camera import camera_matrix, project_keypoints
from dopepp.parts.part import Part, make_part
from dopepp.virtual.surface import make_surface
from tests.data.makers import pose_at, write_set
from tests.parts.makers import mesh_of

K = camera_matrix(100.0, 100.0, 15.5, 11.5)


@pytest.fixture(scope="module")
def plate():
    """A plate of 40 × 20 mm."""
    return make_part("plate", mesh_of(trimesh.creation.box((0.040, 0.020, 0.002))))


def test_annotation_of_a_plate_in_literal_numbers(plate, tmp_path):
    # The plate faces the camera at 200 mm, 0.5 px/mm: 20 px × 10 px.
    T = pose_at(0.0, 0.0, 0.201)
    visible = np.zeros((24, 32), bool)
    visible[7:17, 10:20] = True  # the left half
    depth = np.where(visible, 0.2, 0.0).astype(np.float32)
    depth[7:17, 20:26] = 0.15  # something before the right half
    depth[0, 0] = 70.0  # beyond the scale
    instance = Instance("plate", T, project_keypoints(plate.cuboid, T, K), 0.5, visible)
    sample = Sample(np.zeros((24, 32, 3), np.uint8), K, [instance], depth)
    labels = make_labels(sample, {"plate": 7}, {"plate": (plate, make_surface(plate.mesh))})
    assert labels.camera == {"cam_K": [100, 0, 15.5, 0, 100, 11.5, 0, 0, 1], "depth_scale": 0.1}
    (truth,) = labels.truths
    assert (truth["obj_id"], truth["cam_R_m2c"]) == (7, [1, 0, 0, 0, 1, 0, 0, 0, 1])
    np.testing.assert_allclose(truth["cam_t_m2c"], [0, 0, 201], atol=1e-12)
    (info,) = labels.infos
    # Columns 15.5 ± 10 are pixels 6 – 25, rows 11.5 ± 5 pixels 7 – 16.
    assert info == {
        "bbox_obj": [6, 7, 19, 9], "bbox_visib": [10, 7, 9, 9], "px_count_all": 200,
        "px_count_valid": 160, "px_count_visib": 100, "visib_fract": 0.5,
    }  # fmt: skip
    assert (labels.depth[10, 12], labels.depth[10, 22]) == (2000, 1500)
    assert labels.depth[0, 0] == 0
    write_set(BopWriter, tmp_path, [plate], [sample])
    assert json.loads((tmp_path / "camera.json").read_text()) == {
        "cx": 15.5, "cy": 11.5, "depth_scale": 0.1, "fx": 100.0, "fy": 100.0,
        "height": 24, "width": 32,
    }  # fmt: skip
    mask = cv2.imread(str(tmp_path / "train_pbr/000000/mask/000000_000000.png"), -1)
    assert mask.dtype == np.uint8
    assert set(np.unique(mask)) == {0, 255}
    assert (mask[7:17, 6:26] == 255).all()
    png = cv2.imread(str(tmp_path / "train_pbr/000000/depth/000000.png"), -1)
    assert png.dtype == np.uint16
    np.testing.assert_array_equal(png, labels.depth)


def test_truncated_hidden_and_far_objects(plate):
    surfaces = {"plate": (plate, make_surface(plate.mesh))}
    T = pose_at(-0.0305, 0.0, 0.201)  # columns −9.75 … 10.25
    visible = np.zeros((24, 32), bool)
    visible[7:17, :11] = True
    depth = np.where(visible, 20.0, 0.0).astype(np.float32)
    instance = Instance("plate", T, project_keypoints(plate.cuboid, T, K), 0.5, visible)
    instances = [instance, replace(instance, visible_fraction=0.0, mask=np.zeros_like(visible))]
    image = np.zeros((24, 32, 3), np.uint8)
    labels = make_labels(Sample(image, K, instances, depth), {"plate": 1}, surfaces)
    seen, hidden = labels.infos
    assert (seen["bbox_obj"], seen["bbox_visib"]) == ([-9, 7, 19, 9], [0, 7, 10, 9])
    assert (seen["px_count_all"], hidden["px_count_visib"]) == (200, 0)
    assert hidden["bbox_obj"] == hidden["bbox_visib"] == [-1, -1, -1, -1]
    # 20 m do not fit into 16 bits of 0.1 mm.
    assert (labels.camera["depth_scale"], labels.depth[10, 5]) == (1.0, 20_000)


def test_a_folder_of_other_data_is_rejected(boxes, tmp_path):
    parts = boxes[0]
    BopWriter(tmp_path / "a", parts).prepare()
    (tmp_path / "b" / "train_pbr").mkdir(parents=True)
    bare = Part("bare", parts[0].cuboid, 0.1, parts[0].points)
    for folder, given, message in (
        ("a", parts[:1], r"models_info\.json, written for other parts"),
        ("b", parts, "has train_pbr/ and no models"),
        ("c", [bare], "part bare without a mesh"),
    ):
        with pytest.raises(UserError, match=message):
            BopWriter(tmp_path / folder, given).prepare()
    assert not (tmp_path / "c").exists()
