"""Turns of nearly round parts: which parts have them, and how the right one is chosen."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import trimesh

from dopepp.geometry.camera import camera_matrix, make_transform
from dopepp.geometry.rotation import rotation_angle, rotation_vector_to_matrix
from dopepp.inference.refinement.creases import SharpEdges
from dopepp.inference.refinement.outline import make_outline_mesh, posed
from dopepp.inference.template_estimator import TemplateEstimator
from dopepp.inference.templates.detector import TemplateDetector
from dopepp.inference.templates.turns import nearly_round_turns
from dopepp.parts.part import Mesh, make_part
from dopepp.parts.symmetry_finder import axis_rotation, find_symmetries

K = camera_matrix(900, 900, 319.5, 239.5)
DISTANCES = (0.1, 0.2)
Z = np.array([0.0, 0.0, 1.0])
TOOTH = 2 * np.pi / 12
ALONE = np.eye(3)[None]


def wheel(missing: bool) -> Mesh:
    """Return a wheel of 12 teeth, 40 mm wide, with a cone on one side; a tooth may be missing."""
    rim = []
    for tooth in range(12):
        top = 18 if missing and tooth == 0 else 20
        rim += [(18, tooth), (top, tooth + 0.25), (top, tooth + 0.5), (18, tooth + 0.75)]
    radii, turns = np.array(rim).T
    circle = np.column_stack([np.cos(turns * TOOTH), np.sin(turns * TOOTH)]) * radii[:, None] / 1e3
    side = np.arange(len(circle))
    after, top = np.roll(side, -1), len(circle)
    middle = np.full_like(side, 2 * top)
    faces = [(side, after, after + top), (side, after + top, side + top)]
    faces += [(middle, after, side), (middle + 1, side + top, after + top)]
    layers = [np.column_stack([circle, np.full(top, z)]) for z in (-0.004, 0.004)]
    vertices = np.concatenate([*layers, [[0, 0, -0.004], [0, 0, 0.02]]])
    return Mesh(vertices, np.concatenate([np.column_stack(it) for it in faces]).astype(np.int32))


def of_trimesh(mesh: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(mesh.vertices), mesh.faces.astype(np.int32))


TEETH = np.array([axis_rotation(Z, number * TOOTH) for number in range(12)])
SIDES = TEETH @ axis_rotation(np.array([1.0, 0.0, 0.0]), np.pi)
CYLINDER = of_trimesh(trimesh.creation.cylinder(0.02, 0.01))


@pytest.mark.parametrize(
    ("mesh", "symmetries", "counts"),
    [
        (wheel(missing=True), ALONE, [180]),
        (wheel(missing=False), TEETH, [15]),
        (CYLINDER, ALONE, [180, 180]),
        (CYLINDER, TEETH, [15, 15]),
        (CYLINDER, np.concatenate([TEETH, SIDES]), [15]),
        (of_trimesh(trimesh.creation.cone(0.02, 0.03)), ALONE, [180]),  # one side
        (of_trimesh(trimesh.creation.box((0.04, 0.03, 0.02))), ALONE, []),
    ],
)
def test_turns_of_nearly_round_parts(mesh, symmetries, counts):
    centre = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    diameter = float(trimesh.bounds.minimum_cylinder(mesh.vertices)["radius"] * 2)
    found = nearly_round_turns(mesh, centre, diameter, symmetries)
    assert [len(turns) for turns in found] == counts
    for turns in found:
        axes = turns @ Z
        np.testing.assert_allclose(np.abs(axes), np.tile(Z, (len(axes), 1)), atol=1e-9)
        steps = rotation_angle(turns[1:] @ np.swapaxes(turns[:-1], 1, 2))
        np.testing.assert_allclose(steps, np.radians(2), rtol=1e-6)


@pytest.mark.parametrize("sections", [32, 12])
def test_symmetric_turns_are_no_turns(sections):
    """A cylinder has no turn; a prism of 12 sides has turns of at most half a side."""
    part = make_part("part", of_trimesh(trimesh.creation.cylinder(0.02, 0.01, sections=sections)))
    discrete, continuous = find_symmetries(part.mesh)
    part = replace(part, symmetries_discrete=discrete, symmetries_continuous=continuous)
    pose = make_transform(np.eye(3), np.array([0.0, 0.0, 0.15]))
    turned = TemplateDetector(part, DISTANCES).turned(pose)
    assert [len(poses) for poses in turned] == ([] if continuous else [15])
    assert bool(continuous) == (sections == 32)


@pytest.fixture(scope="module")
def detector():
    return TemplateDetector(make_part("wheel", wheel(missing=True)), DISTANCES)


def shaded(detector, T):
    """Draw the part with light from one side on a grey image."""
    mesh = make_outline_mesh(detector.part.mesh.vertices, detector.part.mesh.faces)
    edges = SharpEdges(mesh)
    ids = edges.drawn(posed(mesh, T, K), (640, 480))
    light = 140 + 80 * (edges.normals @ T[:3, :3].T @ np.array([0.5, -0.6, -0.6]))
    image = np.full((480, 640, 3), 90, np.uint8)
    image[ids >= 0] = light[ids[ids >= 0]][:, None].astype(np.uint8)
    return image


def best_turn(detector, image, start):
    estimator = TemplateEstimator([detector], DISTANCES)
    detection = detector.start(start, 0.9, K)
    refine = partial(estimator._refined_once, image=image, K=K, depth=None)
    (end,) = refine([detection])
    return end, estimator._in_best_turn(end, image, K, refine)


@pytest.mark.parametrize("teeth", [0, 1, 5])
def test_the_missing_tooth_decides_the_turn(detector, teeth):
    tilt = rotation_vector_to_matrix(np.array([0.6, 0.1, 0.0]))
    truth = make_transform(tilt @ axis_rotation(Z, -0.4), np.array([0.005, 0.0, 0.13]))
    wrong = truth @ make_transform(axis_rotation(Z, teeth * TOOTH), np.zeros(3))
    end, turned = best_turn(detector, shaded(detector, truth), wrong)
    assert np.degrees(rotation_angle(turned.T_cam_obj[:3, :3].T @ truth[:3, :3])) < 1.5
    np.testing.assert_allclose(turned.covariance, turned.covariance.T)
    assert turned.covariance[:3, :3].max() < 2 * end.covariance[:3, :3].max()


def test_an_undecided_turn_is_in_the_covariance():
    whole = TemplateDetector(make_part("wheel", wheel(missing=False)), DISTANCES)
    tilt = rotation_vector_to_matrix(np.array([0.6, 0.1, 0.0]))
    truth = make_transform(tilt, np.array([0.005, 0.0, 0.13]))
    image = shaded(whole, truth)  # no tooth is missing, so twelve turns fit
    end, turned = best_turn(whole, image, truth)
    variances, axes = np.linalg.eigh(turned.covariance[:3, :3])
    deviations = np.degrees(np.sqrt(variances))
    assert deviations[2] > 60
    assert deviations[1] < 10
    assert abs(axes[:, 2] @ truth[:3, 2]) > 0.95  # about the wheel's axis
    assert turned.probability >= end.probability - 0.2


def test_each_probable_instance_is_turned_once(detector):
    tilt = rotation_vector_to_matrix(np.array([0.6, 0.1, 0.0]))
    places = [make_transform(tilt, np.array([x, 0.0, 0.15])) for x in (-0.03, 0.03)]
    first, second = (shaded(detector, place) for place in places)
    image = np.where(second == 90, first, second)
    wrong = make_transform(axis_rotation(Z, 5 * TOOTH), np.zeros(3))
    starts = [detector.start(place @ wrong, 0.9, K) for place in places]
    ends = TemplateEstimator([detector], DISTANCES).refined(starts, image, K)
    for place in places:
        near = [end for end in ends if np.linalg.norm(end.T_cam_obj[:3, 3] - place[:3, 3]) < 0.01]
        (end,) = near
        assert np.degrees(rotation_angle(end.T_cam_obj[:3, :3].T @ place[:3, :3])) < 1.5
