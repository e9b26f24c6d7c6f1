import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

import dopepp
from dopepp import PoseEstimator
from dopepp.core.errors import UserError
from dopepp.geometry.camera import (
    Letterbox,
    camera_matrix,
    make_transform,
    move_pose,
    project_keypoints,
    transform,
)
from dopepp.geometry.rotation import random_rotation, rotation_angle
from dopepp.inference import runtimes
from dopepp.inference.network_estimator import NetworkEstimator
from dopepp.inference.network_input import resize_and_pad
from dopepp.maps import MapGeometry, encode
from dopepp.models.checkpoint import Checkpoint
from dopepp.models.network import build_network
from dopepp.models.storage import write_atomic
from dopepp.parts.catalogue import pivconnector, servoholder
from dopepp.parts.part import make_part
from dopepp.virtual import Scene, SceneObject, make_surface, render

K_VGA = camera_matrix(560, 565, 318.0, 242.5)


@pytest.fixture(scope="session")
def parts():
    corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), -1).reshape(-1, 3)
    return [
        make_part("bracket", None, corners * [0.08, 0.06, 0.1]),
        make_part("plate", None, corners * [0.105, 0.052, 0.007] + [0.01, 0.02, 0.0]),
    ]


@pytest.fixture(scope="session")
def save(tiny_spec, tmp_path_factory):
    def write(parts, **recovery):
        torch.manual_seed(0)
        spec = {**tiny_spec, "num_objects": 2}
        weights = build_network(spec).state_dict()
        checkpoint = Checkpoint(spec, weights, parts, (416, 416), 8, 1.5, recovery)
        path = tmp_path_factory.mktemp("checkpoint") / "best.ckpt"
        write_atomic(checkpoint.to_file(), path)
        return path

    return write


@pytest.fixture(scope="session")
def checkpoint_path(save, parts):
    return save(parts, peak_threshold=0.03, max_peaks=8)


@pytest.fixture(scope="session")
def estimator(checkpoint_path):
    return PoseEstimator.load(checkpoint_path)


def image(width, height):
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


class Oracle(NetworkEstimator):
    """An estimator whose maps are computed from true poses instead of by a network."""

    @classmethod
    def load(cls, path, **options):
        return cls(*runtimes.load(Path(path), torch.device("cpu")), **options)

    def show(self, size, K, poses):
        box = Letterbox.fit(size, self.checkpoint.input_size)
        self.truth = [
            (index, box.points(project_keypoints(self.cuboids[index], T, K))) for index, T in poses
        ]

    def maps(self, image):
        height, width = image.shape[:2]
        assert (height % self.network.size_multiple, width % self.network.size_multiple) == (0, 0)
        indices, points = zip(*self.truth, strict=True)
        maps = encode(
            torch.tensor(np.stack(points))[None], torch.tensor([indices]), len(self.parts),
            (height // 8, width // 8), MapGeometry(8, self.checkpoint.sigma),
        )  # fmt: skip
        return maps[0][0], maps[1][0]


def test_estimator_has_the_parts_and_options_of_its_checkpoint(estimator, parts):
    assert [part.name for part in estimator.parts] == ["bracket", "plate"]
    for loaded, expected in zip(estimator.parts, parts, strict=True):
        assert_allclose(loaded.cuboid, expected.cuboid)
    assert not estimator.network.training
    assert (estimator.recovery.peak_threshold, estimator.recovery.max_peaks) == (0.03, 8)
    assert estimator.recovery.sigma == 1.5


def test_repr_describes_network_parts_and_thresholds():
    text = repr(PoseEstimator.load("pretrained/pivconnector", refine="region"))
    size = "pivconnector: 105 × 52 × 7 mm, at 0.085 – 0.16 m"  # the paper's 10.5×5.2×0.7 cm
    for expected in ("128×128 pixels, cpu, refine=region)", size, "thresholds: "):
        assert expected in text


@pytest.mark.parametrize("size", [(416, 416), (640, 480), (97, 301), (33, 32), (1, 1), (900, 20)])
def test_images_of_any_size(estimator, size):
    longest = max(size)
    K = camera_matrix(longest, longest, size[0] / 2 - 0.5, size[1] / 2 - 0.5)
    for detection in estimator.predict(image(*size), K):
        assert detection.object in ("bracket", "plate")
        assert np.isfinite(detection.T_cam_obj).all()


def test_network_input_is_the_letterboxed_image(estimator):
    pixels = image(640, 480)
    padded = resize_and_pad(pixels, Letterbox.fit((640, 480), (416, 416)), 32)
    assert padded.shape == (320, 416, 3)
    expected = cv2.resize(pixels, (416, 312), interpolation=cv2.INTER_AREA)
    assert_array_equal(padded[:312], expected)
    assert not padded[312:].any()
    with torch.no_grad():
        batch = torch.tensor(padded).permute(2, 0, 1)[None].contiguous()
        expected = [maps[0] for maps in estimator.network.maps(batch)]
    torch.testing.assert_close(list(estimator.maps(padded)), expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("size", [(640, 480), (416, 416), (2560, 1440), (200, 301)])
def test_poses_and_pixels_refer_to_the_given_image(checkpoint_path, size):
    oracle, rng = Oracle.load(checkpoint_path), np.random.default_rng(1)
    width, height = size
    K = camera_matrix(0.9 * width, 0.91 * width, 0.49 * width, 0.52 * height)
    for _ in range(5):
        truth = [make_transform(random_rotation(rng), [x, 0.0, 0.4]) for x in (-0.07, 0.07)]
        oracle.show(size, K, list(enumerate(truth)))
        detections = oracle.predict(image(*size), K)
        assert sorted(estimate.object for estimate in detections) == ["bracket", "plate"]
        for detection in detections:
            index = ["bracket", "plate"].index(detection.object)
            part = oracle.parts[index]
            away = transform(truth[index], part.cuboid) - transform(
                detection.T_cam_obj, part.cuboid
            )
            assert np.linalg.norm(away, axis=1).mean() < 0.1 * part.diameter
            pixels = project_keypoints(part.cuboid, truth[index], K)
            assert_allclose(detection.keypoints, pixels, atol=0.005 * width)
            measured = ~np.isnan(detection.peaks).any(1)
            assert measured.sum() >= 5
            assert_allclose(detection.peaks[measured], pixels[measured], atol=0.002 * width)
            assert detection.reprojection_error_px < 0.003 * width


def test_distorted_images_are_undistorted_first(estimator, monkeypatch):
    inputs, original = [], NetworkEstimator.maps

    def spy(self, pixels):
        inputs.append(pixels)
        return original(self, pixels)

    monkeypatch.setattr(NetworkEstimator, "maps", spy)
    pixels, lens = cv2.blur(image(640, 480), (9, 9)), np.array([-0.3, 0.1, 0.001, -0.002, 0.01])
    estimator.predict(pixels, K_VGA, lens)
    box = Letterbox.fit((640, 480), (416, 416))
    assert_array_equal(inputs[0], resize_and_pad(cv2.undistort(pixels, K_VGA, lens), box, 32))
    estimator.predict(pixels, K_VGA, np.zeros((1, 4)))
    estimator.predict(pixels, K_VGA)
    assert_array_equal(inputs[1], inputs[2])


def test_array_views_and_lists_are_accepted(estimator):
    flipped = image(640, 480)[..., ::-1]
    expected = estimator.predict(flipped, K_VGA)
    for K in (K_VGA, K_VGA.tolist()):
        result = estimator.predict(np.ascontiguousarray(flipped), K)
        for detection, other in zip(result, expected, strict=True):
            assert_allclose(detection.T_cam_obj, other.T_cam_obj)


IMAGE, CAMERA = r"\(height, width, 3\) uint8 in RGB order", "pinhole matrix|field of view"
BAD = [
    *(({"image": np.zeros((480, 640, 3), kind)}, IMAGE) for kind in (np.float32, np.uint16)),
    *(
        ({"image": np.zeros(shape, np.uint8)}, IMAGE)
        for shape in ((480, 640), (480, 640, 1), (480, 640, 4), (3, 480, 640), (0, 640, 3))
    ),
    ({"image": None}, IMAGE),
    *(({"K": K}, CAMERA) for K in (np.eye(4), np.full((3, 3), np.nan), K_VGA * 2, None)),
    ({"K": camera_matrix(1e5, 1e5, 320, 240)}, CAMERA),
    *(
        ({"distortion": np.array(bad)}, "4, 5, 8, 12 or 14 finite numbers")
        for bad in ([0.1], [0.1] * 6, [0.1, np.nan, 0, 0], [[0.1, 0.2, 0.3]])
    ),
    ({"depth": np.ones((480, 640), np.uint16)}, "depth of type uint16"),
]


@pytest.mark.parametrize(("bad", "message"), BAD)
def test_bad_input(estimator, checkpoint_path, bad, message):
    with pytest.raises(UserError, match=message) as caught:
        estimator.predict(**{"image": image(640, 480), "K": K_VGA, **bad})
    assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match=r"refine='icp'.*one or more of region, depth, or none"):
        PoseEstimator.load(checkpoint_path, refine="icp")


def test_unneeded_packages_are_not_imported(command):
    code = """
import sys
import dopepp
import dopepp.cli
print({"numpy", "torch", "lightning", "cv2", "scipy", "numba"} & set(sys.modules))
dopepp.PoseEstimator.load("pretrained/pivconnector")
print({"torch._dynamo", "sympy", "lightning", "hydra", "omegaconf", "wandb", "ray", "matplotlib",
       "mitsuba"} & set(sys.modules))
"""
    assert command("-c", code, code=0).out == "set()\nset()\n"


def test_unknown_attribute_of_the_package():
    with pytest.raises(AttributeError, match="PoseEstimater"):
        _ = dopepp.PoseEstimater


TRUE = make_transform(random_rotation(np.random.default_rng(3)), np.array([0.01, 0.0, 0.4]))


@pytest.fixture
def parts_path(save):
    return save([servoholder(), pivconnector()])


def oracle_and_render(path, refine, nearer=0.012, **options):
    """Return an oracle with a distance error (``nearer``, metres) and a render of the part."""
    estimator = Oracle.load(path, refine=refine, **options)
    surface = make_surface(estimator.parts[0].mesh)
    wall = np.full((480, 640, 3), (40, 110, 60), np.uint8)
    rendered = render(Scene(K_VGA, wall, (SceneObject(surface, TRUE),)))
    off = move_pose(TRUE, np.array([0, 0, 0, 0, 0, nearer]))
    estimator.show((640, 480), K_VGA, [(0, off)])
    return estimator, rendered


def error(pose):
    return np.linalg.norm(pose[:3, 3] - TRUE[:3, 3])


def test_depth_image_refines_the_distance(parts_path):
    estimator, rendered = oracle_and_render(parts_path, "depth")
    detection = estimator.predict(rendered.image, K_VGA, depth=rendered.depth)[0]
    alone = estimator.candidates(rendered.image, K_VGA)[0]
    assert error(detection.T_cam_obj) < 0.002 < 0.009 < error(alone.T_cam_obj)
    assert (detection.kept, alone.kept) == ("", "no depth image was given")
    keypoints = project_keypoints(estimator.cuboids[0], detection.T_cam_obj, K_VGA)
    assert_array_equal(detection.keypoints, keypoints)


def test_region_refines_on_the_image(parts_path):
    estimator, rendered = oracle_and_render(parts_path, "region", nearer=0.0)
    detection = estimator.predict(rendered.image, K_VGA)[0]
    off = move_pose(TRUE, np.array([0.04, 0.04, -0.03, 0.001, 0.002, 0.002]))
    covariance = np.diag(np.square([0.04] * 3 + [0.002, 0.002, 0.005]))
    given = replace(detection, T_cam_obj=off, covariance=covariance)
    (refined,) = estimator.refined([given], rendered.image, K_VGA)
    assert refined.kept == ""
    assert refined.agreement > 0.9
    assert rotation_angle(off[:3, :3] @ TRUE[:3, :3].T) > math.radians(3.5)
    assert rotation_angle(refined.T_cam_obj[:3, :3] @ TRUE[:3, :3].T) < math.radians(0.6)
    assert np.abs(refined.T_cam_obj[:2, 3] - TRUE[:2, 3]).max() < 0.0002
    assert np.linalg.det(refined.covariance) < 0.01 * np.linalg.det(covariance)
    keypoints = project_keypoints(estimator.cuboids[0], refined.T_cam_obj, K_VGA)
    assert_array_equal(refined.keypoints, keypoints)
    blank = np.full_like(rendered.image, 90)
    assert estimator.predict(blank, K_VGA) == []
    alone = estimator.candidates(blank, K_VGA)[0]
    assert alone.probability < 0.1
    assert (bool(alone.kept), alone.agreement) == (True, None)
    assert_allclose(alone.T_cam_obj, TRUE, atol=1e-5)  # the network's


def test_a_probable_alternative_replaces_an_improbable_pose(parts_path, monkeypatch):
    estimator, rendered = oracle_and_render(parts_path, "region", nearer=0.0)
    right = estimator.predict(rendered.image, K_VGA)[0]
    beside = make_transform(TRUE[:3, :3], TRUE[:3, 3] + (0.05, -0.05, 0.0))  # on the wall
    wrong = replace(right, T_cam_obj=beside)
    begun = []
    refiner = estimator.refiner

    def recorded(detection, *others):
        begun.append(detection.T_cam_obj)
        return refiner(detection, *others)

    monkeypatch.setattr(estimator, "refiner", recorded)
    given = [
        replace(wrong, alternative=right),
        replace(right, alternative=wrong),
        replace(wrong, alternative=wrong),
    ]
    mended, kept, lost = estimator.refined(given, rendered.image, K_VGA)
    assert error(mended.T_cam_obj) < 0.001
    assert mended.probability == kept.probability > 0.9 > 0.5 > lost.probability
    assert all(detection.alternative is None for detection in (mended, kept, lost))
    assert len(begun) == 5  # the alternative of a probable pose is not refined


def test_refinement_stops_at_the_time_limit(parts_path):
    estimator, rendered = oracle_and_render(parts_path, "region", max_ms=0.0)
    assert estimator.predict(rendered.image, K_VGA)[0].kept == "max_ms=0 was spent"


def test_scale_error_is_a_share(parts_path):
    estimator = PoseEstimator.load(parts_path, refine="region", scale_error=0.002)
    assert estimator.refining("region").scale_error == 0.002
    with pytest.raises(UserError, match="scale_error"):
        PoseEstimator.load(parts_path, refine="region", scale_error=2.0)


def test_error_about_a_missing_mesh_names_the_option(parts_path):
    estimator, _ = oracle_and_render(parts_path, None)
    bare = [replace(part, mesh=None) for part in estimator.parts]
    write_atomic(replace(estimator.checkpoint, parts=bare).to_file(), parts_path)
    with pytest.raises(UserError, match=r"no mesh of servoholder.*--part servoholder=FILE"):
        PoseEstimator.load(parts_path, refine="region")
    PoseEstimator.load(parts_path, refine="region", parts=estimator.parts)


def test_candidates_below_the_threshold_are_not_detections(checkpoint_path):
    estimator, pixels = Oracle.load(checkpoint_path), image(640, 480)
    positions = [(-0.2, -0.1, 0.7), (0.2, -0.1, 0.8), (-0.2, 0.15, 0.9), (0.2, 0.15, 1.0)]
    poses = [(0, make_transform(TRUE[:3, :3], np.array(position))) for position in positions]
    estimator.show((640, 480), K_VGA, poses)
    candidates = estimator.reporting(0.0).predict(pixels, K_VGA)
    scores = [candidate.score for candidate in candidates]
    assert sorted(set(scores), reverse=True) == scores
    assert len(scores) == 4
    strict = estimator.reporting(scores[1])
    assert strict.min_score == scores[1]
    assert [detection.score for detection in strict.predict(pixels, K_VGA)] == scores[:2]
    assert [candidate.score for candidate in strict.candidates(pixels, K_VGA)] == scores
    assert strict.split(candidates) == (candidates[:2], scores[2:])
    rejected = [reason.best for reason in strict.explain(pixels, K_VGA) if reason.kind == "score"]
    assert sorted(rejected, reverse=True) == scores[2:]
    assert estimator.reporting(None) is estimator
    with pytest.raises(UserError, match=r"min_score=1.1"):
        estimator.reporting(1.1)


def test_refined_poses_have_a_separate_threshold(parts_path):
    estimator, rendered = oracle_and_render(parts_path, "region", nearer=0.0)
    estimator.recovery = replace(estimator.recovery, min_score=0.2, refined_min_score=0.6)
    assert estimator.min_score == 0.6
    unrefined, _ = oracle_and_render(parts_path, None, nearer=0.0)
    unrefined.recovery = estimator.recovery
    assert unrefined.min_score == 0.2
    (candidate,) = estimator.candidates(rendered.image, K_VGA)
    least, runs, maps = float(np.nextafter(candidate.score, 1)), [], estimator.maps
    estimator.maps = lambda pixels: runs.append(pixels) or maps(pixels)
    assert estimator.reporting(least).predict(rendered.image, K_VGA) == []
    runs.clear()
    reason = estimator.reporting(least).explain(rendered.image, K_VGA)[-1]
    assert (reason.kind, reason.best) == ("refined", candidate.score)
    assert len(runs) == len(estimator.views(rendered.image, K_VGA))  # one run for each size
    assert estimator.reporting(0.3).refining("region").min_score == 0.3
