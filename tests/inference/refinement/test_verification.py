"""Evidence about a pose, and the probability that follows from it."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from dopepp.geometry.camera import camera_matrix, make_transform, move_pose, project, transform
from dopepp.geometry.rotation import rotation_vector_to_matrix
from dopepp.inference.refinement.creases import SharpEdges
from dopepp.inference.refinement.outline import make_outline_mesh, posed
from dopepp.inference.refinement.refiner import Refiner
from dopepp.inference.refinement.verification import (
    EVIDENCE,
    MIN_DIFFERENCE,
    Verifier,
    learned_model,
)
from dopepp.parts.part import make_part
from dopepp.recovery.detection import Detection
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import preset_of
from tests.parts.makers import mesh_of

K = camera_matrix(400, 400, 159.5, 119.5)
POSE = make_transform(rotation_vector_to_matrix(np.array([2.4, 0.5, 0.4])), np.array([0, 0, 0.35]))
COVARIANCE = np.diag(np.repeat([math.radians(2.0), 0.002], 3) ** 2)


def wedge():
    """A part without symmetries: two boxes and a rod."""
    pieces = [trimesh.creation.box((0.08, 0.05, 0.02)), trimesh.creation.box((0.02, 0.05, 0.06))]
    pieces.append(trimesh.creation.cylinder(0.008, 0.05))
    for piece, shift in zip(pieces, [(0, 0, 0), (0.03, 0, 0.03), (-0.02, 0.01, 0.03)], strict=True):
        piece.apply_translation(shift)
    return make_part("wedge", mesh_of(*pieces))


PART = wedge()


@pytest.fixture(scope="module")
def rendered():
    """Return a render of the part, its camera matrix and its pose."""
    fields = {
        "width": 320, "height": 240, "turning": {"kind": "free"}, "distractors": {"number": [0, 0]},
        "placement": {"kind": "distance", "nearest": 0.2, "farthest": 0.3},
        "materials": {"metal_share": 0.0},
    }  # fmt: skip
    picture = Factory([PART], preset_of("wide", fields, "scene"), 3).render(0, 0)
    scene = picture.scene
    return picture.image, scene.K, scene.objects[scene.targets[0]].T_cam_obj


def evidence(image, K, T, part=PART):
    """Return the evidence about a pose by name."""
    verifier = Verifier(make_outline_mesh(part.mesh.vertices, part.mesh.faces), part.diameter)
    values = verifier.evidence(image, K, T, COVARIANCE, 1.0)
    assert np.isfinite(values).all()
    return dict(zip(EVIDENCE, values, strict=True))


def drawn_box(shade):
    """Return an image of a cube in one colour on black, drawn by ray casting."""
    v, u = np.mgrid[:240, :320].reshape(2, -1)
    rays = np.column_stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.size)])
    start, directions = -POSE[:3, :3].T @ POSE[:3, 3], rays @ POSE[:3, :3]  # object frame
    ends = np.sort([(side - start) / directions for side in (-0.03, 0.03)], axis=0)
    hits = (ends[0].max(axis=1) < ends[1].min(axis=1)).reshape(240, 320)
    return np.where(hits[..., None], np.array(shade, np.uint8), 0).astype(np.uint8)


def box_part():
    return make_part("box", mesh_of(trimesh.creation.box((0.06, 0.06, 0.06))))


def test_all_creases_are_sampled_and_not_only_the_first():
    teeth = [trimesh.creation.box((0.001, 0.04, 0.01)) for _ in range(20)]
    for number, tooth in enumerate(teeth):
        tooth.apply_translation((0.004 * number - 0.038, 0.0, 0.0))
    part = make_part("comb", mesh_of(*teeth))
    mesh = make_outline_mesh(part.mesh.vertices, part.mesh.faces)
    edges, at = SharpEdges(mesh), posed(mesh, make_transform(POSE[:3, :3], [0, 0, 0.2]), K)
    counts = [len(edges.visible(at, edges.drawn(at, (320, 240)), step)) for step in (0.5, 4.0)]
    assert counts[0] > 512
    assert counts[0] == pytest.approx(8 * counts[1], rel=0.1)


def test_a_flat_silhouette_has_an_outline_and_no_creases():
    values = evidence(drawn_box((200, 120, 40)), K, POSE, box_part())
    assert values["outline"] > 0.85
    assert values["contrast"] > 0.9
    assert values["crease"] < 0.3
    assert values["creases"] > 0.2  # the box has visible creases, where the image shows nothing
    assert values["residual"] == pytest.approx(0.0, abs=0.01)  # no deviation on either side


def test_the_extent_is_that_of_the_projected_box():
    values = evidence(drawn_box((90, 90, 90)), K, POSE, box_part())
    pixels = project(transform(POSE, box_part().mesh.vertices), K)
    assert values["size"] == pytest.approx(math.log(np.ptp(pixels, axis=0).max() / 100), abs=0.01)


def test_the_stated_deviation_is_that_of_sampled_poses():
    values = evidence(drawn_box((90, 90, 90)), K, POSE, box_part())
    part, rng = box_part(), np.random.default_rng(0)
    vertices = make_outline_mesh(part.mesh.vertices, part.mesh.faces).vertices
    steps = rng.multivariate_normal(np.zeros(6), COVARIANCE, 4000)
    here = transform(POSE, vertices)
    moved = [transform(move_pose(POSE, step), vertices) for step in steps]
    squares = [((points - here) ** 2).sum(axis=1).mean() for points in moved]
    expected = math.log(math.sqrt(np.mean(squares)) / (0.1 * part.diameter))
    assert values["spread"] == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize(
    "step",
    [[0, 0, math.pi, 0, 0, 0], [0.5, 0, 0, 0, 0, 0], [0, 0, 0, 0.03, 0, 0], [0, 0, 0, 0, 0, 0.1]],
)
def test_the_right_pose_has_more_evidence_than_a_wrong_pose(rendered, step):
    image, K, T = rendered
    right, wrong = evidence(image, K, T), evidence(image, K, move_pose(T, np.array(step, float)))
    for name in ("outline", "outline_gain", "outline_weakest"):
        assert right[name] > wrong[name] + 0.1
    odds = [learned_model().log_odds(np.array(list(each.values()))) for each in (right, wrong)]
    assert odds[0] > odds[1] + 1.0


def test_the_lines_of_a_look_alike_are_not_preferred(rendered):
    image, K, T = rendered
    verifier = Verifier(make_outline_mesh(PART.mesh.vertices, PART.mesh.faces), PART.diameter)
    half_turn = make_transform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    look_alike, away = T @ half_turn, make_transform(T[:3, :3], np.array([5.0, 0.0, 0.3]))
    margins = verifier.margins(image, K, [T, look_alike, T])
    np.testing.assert_array_equal(margins, -margins.T)
    assert margins[0, 1] > MIN_DIFFERENCE
    assert margins[0, 2] == 0  # no line distinguishes a pose from itself
    grey = np.full_like(image, 90)
    np.testing.assert_array_equal(verifier.margins(grey, K, [T, look_alike]), np.zeros((2, 2)))
    np.testing.assert_array_equal(verifier.margins(image, K, [away, away]), np.zeros((2, 2)))
    responses = verifier.responses(image, K, [T, move_pose(T, np.array([0.2, 0, 0, 0, 0, 0]))])
    assert responses[0] > responses[1] + 0.1
    assert verifier.responses(image, K, [away]) == 0


def test_a_refined_detection_has_its_probability(rendered):
    image, K, T = rendered
    pixels = project(transform(T, PART.cuboid), K)
    right = Detection("wedge", 0.6, 0.6, T, pixels, pixels, 1.0, COVARIANCE)
    refiner = Refiner("region", [PART])
    assert refiner.verifies
    assert refiner(right, image, K, None).probability > 0.5
    noise = np.random.default_rng(0).integers(0, 256, image.shape, np.uint8)
    assert refiner(right, noise, K, None).probability < 0.05
    away = replace(right, T_cam_obj=make_transform(T[:3, :3], np.array([5.0, 0.0, 0.3])))
    assert refiner(away, image, K, None).probability == 0.0


def test_a_part_without_a_mesh_is_not_verified():
    assert not Refiner("depth", [replace(PART, mesh=None)]).verifies


def test_a_model_of_other_evidence_is_refused(monkeypatch):
    monkeypatch.setattr("dopepp.inference.refinement.verification.EVIDENCE", EVIDENCE[:-1])
    learned_model.cache_clear()
    with pytest.raises(ValueError, match="learn_verification"):
        learned_model()
    learned_model.cache_clear()
