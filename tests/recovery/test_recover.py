import re

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from dopepp.core.errors import UserError
from dopepp.geometry.camera import camera_matrix, make_transform, project_keypoints, transform
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.geometry.pnp import solve_pnp
from dopepp.maps import MapGeometry, encode
from dopepp.maps.codec import Peaks
from dopepp.recovery import Reason, explain, recover, recover_batch
from dopepp.recovery.association import BORDER_DEVIATION, select_peaks
from dopepp.recovery.reasons import format_reasons, main_reasons, summary

PLACES = [(-0.09, -0.09), (0.09, -0.09), (-0.09, 0.09), (0.09, 0.09)]


@pytest.mark.parametrize("name", ["box", "plate", "origin elsewhere"])
@pytest.mark.parametrize("count", [1, 4])
def test_all_instances_are_recovered(name, count, box, plate, make_scene, pose):
    elsewhere = cuboid_keypoints(np.array([0.1, 0.2, 0.3]), np.array([0.2, 0.25, 0.307]))
    cuboid = {"box": box, "plate": plate, "origin elsewhere": elsewhere}[name]
    rng = np.random.default_rng(count)
    for _ in range(8):
        scene = make_scene(cuboid)
        for x, y in PLACES[:count]:
            T = pose(rng, x, y, 0.55)
            T[:3, 3] -= T[:3, :3] @ cuboid[8]
            scene.place(0, T)
        detections = scene.recover()
        assert len(detections) == count
        assert max(scene.error(0, estimate.T_cam_obj) for estimate in detections) < 0.1
        centres = [transform(detection.T_cam_obj, cuboid[8])[:2] for detection in detections]
        assert len({tuple(np.round(centre / 0.09).astype(int)) for centre in centres}) == count


def test_vectors_count_in_the_disc_of_the_training(make_scene, box, pose):
    scene = make_scene(box).place(0, pose(np.random.default_rng(1)))
    belief, wide = scene.maps(field_radius=4.0)
    _, narrow = scene.maps()
    ring = torch.where(narrow == 0, wide, 0.0)
    assert [len(scene.recover(belief, ring, field_radius=r)) for r in (2.0, 4.0)] == [0, 1]


def test_two_objects_in_one_network(make_scene, box, plate, pose):
    rng = np.random.default_rng(1)
    for _ in range(8):
        scene = make_scene(box, plate)
        for index, (x, y) in zip([0, 1, 1, 0], PLACES, strict=True):
            scene.place(index, pose(rng, x, y, 0.55))
        detections = scene.recover(names=["box", "plate"])
        assert sorted(item.object for item in detections) == ["box", "box", "plate", "plate"]
        for detection in detections:
            assert scene.error(["box", "plate"].index(detection.object), detection.T_cam_obj) < 0.1


@pytest.mark.parametrize("name", ["box", "plate"])
def test_three_corners_may_be_missing(name, request, make_scene, pose):
    cuboid, rng = request.getfixturevalue(name), np.random.default_rng(3)
    good = 0
    for _ in range(40):
        scene = make_scene(cuboid).place(0, pose(rng))
        belief, field = scene.maps()
        missing = rng.permutation(8)[:3]
        belief[missing] = 0
        detections = scene.recover(belief, field)
        good += len(detections) == 1 and scene.error(0, detections[0].T_cam_obj) < 0.1
        for detection in detections:
            assert np.isnan(detection.peaks[missing]).all()
            assert np.isfinite(detection.keypoints).all()
            assert detection.score == pytest.approx(6 / 9, abs=0.25)
    assert good >= 36


def test_fields_of_a_detection(make_scene, box, pose):
    scene = make_scene(box).place(0, pose(np.random.default_rng(4)))
    (detection,) = scene.recover(names=["bracket"])
    assert detection.object == "bracket"
    assert 0.8 < detection.score <= 1
    truth = project_keypoints(box, scene.poses[0], scene.K)
    assert_allclose(detection.keypoints, project_keypoints(box, detection.T_cam_obj, scene.K))
    assert_allclose(detection.keypoints, truth, atol=0.5)
    assert_allclose(detection.peaks, truth, atol=0.5)
    rms = np.sqrt(((detection.peaks - detection.keypoints) ** 2).sum(1).mean())
    assert detection.reprojection_error_px == pytest.approx(rms, abs=1e-6)
    assert_array_equal(detection.T_cam_obj[3], [0, 0, 0, 1])


def test_best_score_is_first_and_at_most_one(make_scene, box, pose):
    rng = np.random.default_rng(5)
    scene = make_scene(box).place(0, pose(rng, -0.1)).place(0, pose(rng, 0.1))
    belief, field = scene.maps()
    belief[:, :, :26] *= 0.5
    belief[:, :, 26:] *= 1.7  # an identity activation does not bound beliefs
    first, second = scene.recover(belief, field, min_score=0.0)
    assert first.T_cam_obj[0, 3] > 0 > second.T_cam_obj[0, 3]
    assert 1 >= first.score > second.score >= 0
    for option in ("min_score", "centroid_threshold"):
        assert len(scene.recover(belief, field, **{option: 0.7})) == 1


def test_absent_object_is_not_detected(make_scene, box, plate, pose):
    scene = make_scene(box, plate).place(1, pose(np.random.default_rng(2)))
    assert [detection.object for detection in scene.recover()] == ["1"]
    assert scene.recover(*(0 * maps for maps in scene.maps())) == []


def test_batch_equals_its_single_images(make_scene, box, plate, pose):
    rng = np.random.default_rng(7)
    cameras = [camera_matrix(f, 1.02 * f, 200.0 + k, 210.0) for k, f in enumerate((450, 500, 600))]
    scenes = [
        make_scene(box, plate, camera=camera)
        .place(0, pose(rng, -0.08, 0, 0.5))
        .place(1, pose(rng, 0.08, 0, 0.5))
        for camera in cameras
    ]
    maps = [scene.maps() for scene in scenes]
    belief, field = (torch.stack(kind) for kind in zip(*maps, strict=True))
    batch = recover_batch(belief, field, scenes[0].cuboids, np.stack(cameras))
    for scene, detections, (single_belief, single_field) in zip(scenes, batch, maps, strict=True):
        alone = scene.recover(single_belief, single_field)
        assert len(detections) == len(alone) == 2
        for detection, other in zip(detections, alone, strict=True):
            assert detection.object == other.object
            assert detection.score == pytest.approx(other.score, abs=1e-6)
            assert_allclose(detection.T_cam_obj, other.T_cam_obj, atol=1e-5)
            assert_allclose(detection.peaks, other.peaks, atol=1e-3)
            assert scene.error(int(detection.object), detection.T_cam_obj) < 0.1


def test_maps_in_half_precision_and_channels_last(make_scene, box, pose):
    """A network under autocast returns such maps."""
    scene = make_scene(box).place(0, pose(np.random.default_rng(8)))
    belief, field = (
        maps[None].bfloat16().to(memory_format=torch.channels_last) for maps in scene.maps()
    )
    ((detection,),) = recover_batch(belief, field, scene.cuboids, scene.K[None])
    assert scene.error(0, detection.T_cam_obj) < 0.1


@pytest.mark.parametrize(
    ("option", "value"),
    [
        *(("sigma", 0.0), ("peak_threshold", 0.0), ("centroid_threshold", 2.0)),
        *(("max_angle_deg", bad) for bad in (-1.0, float("nan"))),
        *(("max_peaks", 0), ("min_score", 1.5), ("nms_radius", 3.0)),
    ],
)
def test_bad_option(option, value, make_scene, box):
    maps = torch.zeros(9, 8, 8), torch.zeros(16, 8, 8)
    with pytest.raises(UserError, match=f"recovery.{option}={value}"):
        make_scene(box).recover(*maps, **{option: value})


@pytest.mark.parametrize(
    ("factor", "options", "kind", "text"),
    [
        (0.0, {}, "empty", "box: its maps are empty, no belief above 0"),
        (0.01, {}, "empty", "no belief above 0.0"),
        (0.04, {}, "centroid", "best belief of a centroid 0.0"),
        (float("nan"), {}, "empty", "no belief above 0"),
        (1.0, {"min_score": 1.0}, "score", r"box: at pixel \(.* below 1"),
    ],
)
def test_reason_names_the_rejecting_step(factor, options, kind, text, make_scene, box, pose):
    scene = make_scene(box).place(0, pose(np.random.default_rng(10)))
    belief, field = scene.maps()
    assert explain(belief, field, scene.cuboids, scene.K) == []
    (detection,) = explain(factor * belief, field, scene.cuboids, scene.K, names=["box"], **options)
    assert (detection.object, detection.kind) == ("box", kind)
    assert re.search(text, str(detection))
    if factor == factor:
        assert detection.best == pytest.approx(factor, rel=0.25)


def test_few_corners_and_small_parts_are_reasons(make_scene, box, pose):
    scene = make_scene(box).place(0, pose(np.random.default_rng(10)))
    belief, field = scene.maps()
    belief[:6] = 0
    assert scene.recover(belief, field) == []
    (few,) = explain(belief, field, scene.cuboids, scene.K)
    assert "only 3 usable points, 4 are needed" in few.text
    belief[8] *= 0.5
    (low,) = explain(belief, field, scene.cuboids, scene.K, peak_threshold=0.6)
    assert low.text.endswith("below 0.6")  # the higher of both thresholds
    scene = make_scene(box).place(0, make_transform(np.eye(3), np.array([0.0, 0.0, 15.0])))
    (small,) = explain(*scene.maps(), scene.cuboids, scene.K, min_score=1.0)
    assert small.kind == "small"
    assert "px across, a cell of the maps has 8 px" in small.text


def reason(kind, best, name="plate"):
    return Reason(name, kind, best, f"{kind} {best}")


def test_reasons_are_formatted_in_a_line():
    reasons = [
        reason("pose", 0.9), reason("score", 0.1), reason("score", 0.2), reason("centroid", 0.99),
        reason("refined", 0.1, "box"), reason("empty", 0.0, "disc"),
    ]  # fmt: skip
    line = "box: refined 0.1; plate: score 0.2 (the best of 4); disc: empty 0.0"
    parts = [str(item) for item in reversed(main_reasons(reasons))]
    assert parts == line.replace(" (the best of 4)", "").split("; ")
    assert (format_reasons(reasons), format_reasons([])) == (line, "")
    assert summary([*reasons[1:3], reasons[-1]], 300) == (
        "3 of 300 images without detections: 1 with empty maps (best belief 0), "
        "2 below the threshold (best score 0.2)"
    )


@pytest.mark.parametrize(("name", "sigma"), [("box", 2.0), ("plate", 2.0), ("box", 0.5)])
def test_crowds_are_recovered_from_noisy_maps(name, sigma, request, make_scene, pose):
    cuboid, rng = request.getfixturevalue(name), np.random.default_rng(11)
    generator = torch.Generator().manual_seed(11)
    places = [(x, y) for x in (-0.13, -0.04, 0.04, 0.13) for y in (-0.1, 0.0, 0.1)]
    right = 0
    for _ in range(4):
        scene = make_scene(cuboid)
        for x, y in places[:10]:
            scene.place(0, pose(rng, x, y, 0.55))
        belief, field = scene.maps(sigma)
        belief = belief + 0.02 * torch.randn(belief.shape, generator=generator)
        field = field + 0.05 * torch.randn(field.shape, generator=generator)
        # Fits to further peaks of the noise must not widen the covariances of the parts' peaks.
        for max_peaks in (16, 100):
            detections = scene.recover(belief, field, sigma=sigma, max_peaks=max_peaks)
            errors = np.array([scene.errors(0, detection.T_cam_obj) for detection in detections])
            right += int((errors.min(0) < 0.1).sum())
    assert right >= 72


def test_wider_peaks_yield_a_larger_covariance(make_scene, box, pose):
    scene = make_scene(box).place(0, pose(np.random.default_rng(12)))
    (sharp,), (wide,) = scene.recover(), scene.recover(*scene.maps(1.5))
    for detection in (sharp, wide):
        assert_allclose(detection.covariance, detection.covariance.T, rtol=1e-6)
        assert np.linalg.eigvalsh(detection.covariance).min() > 0
    assert np.trace(wide.covariance) > 4 * np.trace(sharp.covariance)


def test_peaks_at_the_border_are_less_certain():
    inside, outside = [(8.0, 8.0), (71.0, 30.0)], [(7.0, 30.0), (30.0, 7.0), (73.0, 30.0), (-3, -3)]
    position = np.full((1, 9, 6, 2), np.nan)
    position[0, 0] = inside + outside
    covariance = np.tile(np.diag([2.0, 3.0]), (1, 9, 6, 1, 1))
    peaks = Peaks(position, np.ones((1, 9, 6)), covariance, np.zeros((1, 9, 6, 2)))
    selected = select_peaks(peaks, 0, 0, 0.05, (10, 6), 8.0)
    added = selected.covariance_px[0] - covariance[0, 0]
    assert_array_equal(added[:2], 0.0)
    assert_array_equal(added[2:], np.tile((8.0 * BORDER_DEVIATION) ** 2 * np.eye(2), (4, 1, 1)))
    assert selected.area_px == 80 * 48


def test_shifted_corners_at_the_border_have_less_weight(plate, pose):
    """Peaks of a network in the outermost cells are shifted inward by half a cell."""
    rng, K, size = np.random.default_rng(11), camera_matrix(153, 153, 63.5, 63.5), 128
    weighted, unweighted_errors = [], []
    while len(weighted) < 30:
        T = pose(rng, *rng.uniform(-0.02, 0.02, 2), 0.16)
        points = project_keypoints(plate, T, K)
        inward = np.minimum(points + 0.5, size - 0.5 - points)
        pulled = inward < 4
        if not pulled.any() or (inward < 0).any():
            continue
        points += 4 * pulled * np.sign(63.5 - points)
        belief, field = encode(
            torch.from_numpy(points)[None, None], torch.zeros(1, 1, dtype=torch.long), 1,
            (16, 16), MapGeometry(8, 1.0),
        )  # fmt: skip
        (detection,) = recover(belief[0], field[0], plate[None], K)
        unweighted = solve_pnp(plate, points, K).T_cam_obj
        assert unweighted is not None
        for errors, estimate in ((weighted, detection.T_cam_obj), (unweighted_errors, unweighted)):
            errors.append(np.linalg.norm(transform(estimate, plate) - transform(T, plate), axis=1))
    assert np.mean(weighted) < 0.6 * np.mean(unweighted_errors)
