"""Templates: closed forms of views, responses and matches; detection on rendered images."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from dopepp.core.errors import UserError
from dopepp.geometry.camera import camera_matrix, project, transform
from dopepp.geometry.rotation import rotation_angle
from dopepp.inference.refinement.outline import make_outline_mesh
from dopepp.inference.template_estimator import TemplateEstimator
from dopepp.inference.templates import views
from dopepp.inference.templates.detector import (
    SAME_DEPTH,
    SAME_PLACE,
    SAME_TURN,
    SMALLEST_PX,
    TemplateDetector,
    distinct_poses,
)
from dopepp.inference.templates.matching import (
    CELL,
    MOST,
    NUM_KEPT,
    NUM_ROLLS,
    NUM_SUMMED,
    QUANTUM,
    STRIDE,
    Matches,
    match,
)
from dopepp.inference.templates.ranking import FEATURES, improve_views, learned_ranking, move_nearby
from dopepp.inference.templates.responses import BINS, edge_responses
from dopepp.inference.templates.views import (
    DRAWN_PX,
    NUM_NEIGHBOURS,
    NUM_VIEWS,
    Templates,
    _neighbours,
    view_rotations,
)
from dopepp.parts.catalogue import pivconnector
from dopepp.parts.part import Mesh, Part, make_part
from dopepp.recovery.detection import log_odds
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import preset_of

DISTANCES = (0.2, 0.3)
SPACING = np.sqrt(4 * np.pi / NUM_VIEWS)  # side of a view's share of the unit sphere
PIXEL = 1 / DRAWN_PX
HALF_TURNS = Rotation.from_rotvec(np.pi * np.eye(4, 3, -1)).as_matrix()  # and the identity
VIEW_OF_TOP = np.diag([1.0, -1.0, -1.0])


def templates_of(mesh: trimesh.Trimesh, diameter: float, distance: float, *rotations) -> Templates:
    outline = make_outline_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return views.make_templates(outline, np.zeros(3), diameter, distance, np.array(rotations))


@pytest.fixture(scope="module")
def detector() -> TemplateDetector:
    return TemplateDetector(pivconnector(), DISTANCES)


@pytest.fixture(scope="module")
def rendered(detector):
    """Return a render of the part, its camera matrix and its pose."""
    fields = {"width": 320, "height": 240, "distractors": {"number": [0, 0]}}
    fields["placement"] = {"kind": "distance", "nearest": 0.2, "farthest": 0.3}
    rendered = Factory([detector.part], preset_of("wide", fields, "scene"), 3).render(0, 0)
    scene = rendered.scene
    return rendered.image, scene.K, scene.objects[scene.targets[0]].T_cam_obj


def distance_of(part: Part, T, T_true) -> float:
    """Return ADD, diameters."""
    apart = transform(T, part.mesh.vertices) - transform(T_true, part.mesh.vertices)
    return float(np.linalg.norm(apart, axis=1).mean()) / part.diameter


def is_near(starts, part: Part, T_true) -> bool:
    """Return whether refinement can reach the pose from a start pose."""
    return any(
        np.degrees(rotation_angle(start.T_cam_obj[:3, :3].T @ T_true[:3, :3])) < 15
        and distance_of(part, start.T_cam_obj, T_true) < 0.15
        for start in starts
    )


def test_views_are_proper_rotations_spread_evenly():
    rotations = view_rotations(180.0)
    products = rotations @ rotations.swapaxes(1, 2)
    np.testing.assert_allclose(products, np.tile(np.eye(3), (NUM_VIEWS, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)
    cosines = -rotations[:, 2] @ -rotations[:, 2].T
    np.fill_diagonal(cosines, -1)
    assert np.arccos(cosines.max(axis=0)).min() > 0.8 * SPACING
    axes = np.random.default_rng(0).normal(size=(50, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    for angle in (0.3, 0.8, 1.5):  # a cap's share of the sphere is (1 − cos) / 2
        counts = (-rotations[:, 2] @ axes.T > np.cos(angle)).sum(axis=0)
        assert np.abs(counts - NUM_VIEWS * (1 - np.cos(angle)) / 2).max() < 8


@pytest.mark.parametrize("tilt", [0.0, 30.0, 90.0, 150.0])
def test_tilt_limits_the_views(tilt):
    rotations = view_rotations(tilt)
    highest = np.degrees(np.arccos(-rotations[:, 2, 2].min()))
    assert highest <= max(tilt, 3.4) + 1e-6  # at least the view nearest to z is kept
    assert len(rotations) == pytest.approx(NUM_VIEWS * (1 - np.cos(np.radians(tilt))) / 2, abs=1)


def test_equivalent_views_of_a_box_are_merged():
    every, kept = -view_rotations(180.0)[:, 2], -view_rotations(180.0, HALF_TURNS)[:, 2]
    assert NUM_VIEWS / 4 <= len(kept) < 1.2 * NUM_VIEWS / 4
    nearest = np.einsum("nj,gij,ki->ngk", every, HALF_TURNS, kept).max(axis=(1, 2))
    assert np.arccos(nearest.clip(-1, 1)).max() < SPACING


def test_points_of_a_ball_lie_on_its_silhouette():
    radius, distance = 0.03, 0.2
    ball = trimesh.creation.icosphere(4, radius)
    templates = templates_of(ball, 2 * radius, distance, *view_rotations(180.0)[::100])
    # The tangents from the camera, at the depth of the centre, in diameters.
    circle = 0.5 * distance / np.sqrt(distance**2 - radius**2)
    np.testing.assert_allclose(np.linalg.norm(templates.points, axis=2), circle, atol=PIXEL)
    outwards = np.arctan2(templates.points[..., 1], templates.points[..., 0])
    off = np.angle(np.exp(1j * (templates.normals - outwards)))
    assert np.sqrt(np.mean(off**2)) < np.pi / BINS
    assert templates.is_outline.all()
    assert np.linalg.norm(templates.inner, axis=2).max() < circle - 3 * PIXEL
    np.testing.assert_allclose(templates.extents, 2 * circle, atol=3 * PIXEL)


def test_points_of_a_cube_lie_on_its_silhouette_and_creases():
    r = np.sqrt(0.5)
    diagonal = np.array([[-r, r, 0], [0, 0, -1], [-r, -r, 0]])
    cube = trimesh.creation.box((0.04,) * 3)
    templates = templates_of(cube, 0.04 * np.sqrt(3), 50.0, VIEW_OF_TOP, diagonal)
    half = 0.5 / np.sqrt(3)
    np.testing.assert_allclose(np.abs(templates.points[0]).max(axis=1), half, atol=PIXEL)
    normals = np.column_stack([np.cos(templates.normals[0]), np.sin(templates.normals[0])])
    beyond = np.abs(templates.points[0] + 0.05 * normals).max(axis=1)
    assert (beyond > half + 0.03).all()  # outwards
    creases = templates.points[1][~templates.is_outline[1]]
    np.testing.assert_allclose(creases[:, 0], 0.0, atol=PIXEL)
    assert np.ptp(creases[:, 1]) > 1.5 * half
    outline = templates.points[1][templates.is_outline[1]]
    np.testing.assert_allclose(np.abs(outline[:, 0]).max(), half * np.sqrt(2), atol=PIXEL)


def test_an_open_sheet_has_the_same_silhouette_from_both_sides():
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.02
    sheet = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]])
    templates = templates_of(sheet, 0.04 * np.sqrt(2), 0.5, VIEW_OF_TOP, np.eye(3))
    half = 0.5 / np.sqrt(2)
    np.testing.assert_allclose(np.abs(templates.points).max(axis=2), half, atol=PIXEL)
    assert templates.is_outline.all()


@pytest.mark.parametrize("index", range(0, BINS, 3))
def test_a_step_responds_at_its_orientation(index):
    angle = np.pi * index / BINS
    v, u = np.indices((61, 61)) - 30.0
    covered = np.clip(u * np.cos(angle) + v * np.sin(angle) + 0.5, 0, 1)[..., None]
    responses = edge_responses((40 + [160, 160, 160] * covered).astype(np.uint8), 3, 31)
    at_edge = responses[:, 28:33, 28:33].mean(axis=(1, 2))
    assert at_edge.argmax() == index
    assert at_edge.min() == at_edge[(index + BINS // 2) % BINS]
    assert at_edge.max() - at_edge.min() > 100


def test_a_flat_image_has_no_responses_and_finite_starts(detector):
    flat = np.full((120, 160, 3), 90, np.uint8)
    assert not edge_responses(flat, 5, 41).any()
    starts = detector.detect(flat, camera_matrix(200, 200, 79.5, 59.5))
    assert np.isfinite([start.T_cam_obj for start in starts]).all()
    assert all(start.score < 0.5 for start in starts)


def test_cells_keep_the_matches_with_the_largest_sums_of_responses():
    rng, size = np.random.default_rng(1), 41.0
    responses = rng.integers(-127, 128, (BINS, 46, 57)).astype(np.int8)
    points, normals = rng.uniform(-0.5, 0.5, (3, 8, 2)), rng.uniform(-np.pi, np.pi, (3, 8))
    ones, links = np.ones((3, 8), bool), np.zeros((3, 1))
    rotations = np.tile(np.eye(3), (3, 1, 1))
    templates = Templates(rotations, points, normals, ones, points, ones[:, 0], links, links)
    rows, columns, pad = len(range(0, 46, STRIDE)), len(range(0, 57, STRIDE)), 40
    quantised = np.minimum(np.floor(responses / QUANTUM + 0.5), MOST)
    padded = np.pad(quantised, ((0, 0), (pad, pad), (pad, pad)))
    side, cells = round(CELL * size / STRIDE), {}
    for view, roll in np.ndindex(3, NUM_ROLLS):
        angle = 2 * np.pi * roll / NUM_ROLLS
        turned = Rotation.from_euler("z", angle).apply(np.pad(points[view], ((0, 0), (0, 1))))
        sums = np.zeros((rows, columns))
        offsets = np.rint(size * turned[:, :2]).astype(int)
        for (du, dv), normal in zip(offsets, normals[view], strict=True):
            plane = padded[round((normal + angle) / np.pi * BINS) % BINS]
            sums += plane[pad + dv :: STRIDE, pad + du :: STRIDE][:rows, :columns]
        standard = (sums - sums.mean()) / sums.std()
        for i, j in np.ndindex(-(-rows // side), -(-columns // side)):
            cell = standard[i * side : (i + 1) * side, j * side : (j + 1) * side]
            v, u = np.add(np.unravel_index(cell.argmax(), cell.shape), (i * side, j * side))
            moments = QUANTUM * sums.mean() / 8, QUANTUM * sums.std() / 8
            row = (cell.max(), view, STRIDE * u, STRIDE * v, angle, size, *moments)
            cells.setdefault((i, j), []).append(row)
    best = [row for rows in cells.values() for row in sorted(rows)[-NUM_KEPT:]]
    matches = match(responses, templates, size)
    moments = matches.means, matches.deviations
    rows = np.column_stack([matches.scores, matches.views, matches.poses, *moments])
    assert len(cells) > 10
    np.testing.assert_allclose(sorted(rows.tolist()), sorted(best), rtol=1e-5)


def test_matching_uses_the_first_points_of_a_template(detector):
    rng = np.random.default_rng(4)
    responses = rng.integers(-127, 128, (BINS, 46, 57)).astype(np.int8)
    templates = detector._groups[0]
    changed = templates.points.copy()
    changed[:, NUM_SUMMED:] = 0.0
    whole, part = (
        match(responses, templates._replace(points=points), 41.0)
        for points in (templates.points, changed)
    )
    assert templates.points.shape[1] > NUM_SUMMED
    assert np.array_equal(whole.scores, part.scores)


def test_distinct_poses_are_the_first_of_near_duplicates(detector):
    part, centre = detector.part, detector.part.cuboid[-1]

    def posed(shift, turn=0.0):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec([turn, 0, 0]).as_matrix()
        T[:3, 3] = np.array([0, 0, 0.3]) + shift - T[:3, :3] @ centre
        return T

    near, far = 0.5 * SAME_PLACE * part.diameter, 2 * SAME_PLACE * part.diameter
    poses = [
        posed([0, 0, 0]),
        posed([near, 0, 0]),
        posed([far, 0, 0]),
        posed([0, 0, 0], 0.5 * SAME_TURN),
        posed([0, 0, 0], 2 * SAME_TURN),
        posed([0, 0, 0.3 * 0.5 * SAME_DEPTH]),
        posed([0, 0, 0.3 * 2 * SAME_DEPTH]),
    ]
    assert distinct_poses(poses, part) == [0, 2, 4, 6]
    assert distinct_poses(poses, part, 2) == [0, 2]
    assert distinct_poses([], part) == []


@pytest.mark.parametrize("move", [move_nearby, improve_views])
def test_moved_matches_have_the_mean_response_at_their_points(detector, move):
    rng, (height, width), count = np.random.default_rng(6), (90, 120), 60
    noise = rng.integers(0, 255, (height, width, 3), np.uint8)
    image = cv2.GaussianBlur(noise, None, 3.0)
    responses, templates = edge_responses(image, 3, 31), detector._templates

    def mean_response(view, pose):
        u, v, roll, scale = pose
        turned = Rotation.from_euler("z", roll).apply(
            np.pad(templates.points[view], [(0, 0), (0, 1)])
        )
        x, y = np.trunc(scale * turned[:, :2] + [u + 0.5, v + 0.5]).astype(int).T
        plane = np.floor((templates.normals[view] + roll) / np.pi * BINS + 0.5).astype(int) % BINS
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        values = responses[plane, y.clip(0, height - 1), x.clip(0, width - 1)].astype(int)
        return (values * inside).mean()

    poses = rng.uniform([0, 0, 0, 40], [width, height, 2 * np.pi, 60], (count, 4))
    ones, chosen = np.ones(count), rng.integers(0, len(templates.points), count)
    matches = Matches(chosen, poses, 5 * ones, 2 * ones, 3 * ones)
    options = [4.0] if move is move_nearby else []
    moved, features = move(matches, templates, responses, image, *options)
    before, after = (
        np.array([mean_response(*match) for match in zip(it.views, it.poses, strict=True)])
        for it in (matches, moved)
    )
    found = features[:, FEATURES.index("response")]
    np.testing.assert_allclose(found, after, atol=1e-9)
    assert (after > before).mean() > 0.9
    np.testing.assert_allclose(features[:, FEATURES.index("edges")], (after - 2) / 3)
    off = np.abs(moved.poses - poses)
    if move is move_nearby:
        assert (moved.views == chosen).all()
        assert off[:, :2].max() < 4.0 + 1.0 * (1 + 0.6 + 0.36) + 1e-9
    else:
        assert (moved.views != chosen).mean() > 0.5


def test_neighbouring_views_differ_least_after_their_twist():
    rotations = view_rotations(180.0)
    neighbours, twists = _neighbours(rotations)
    rng = np.random.default_rng(3)
    for view in rng.integers(0, NUM_VIEWS, 20):
        tilts = np.arccos(np.clip(rotations[:, 2] @ rotations[view, 2], -1, 1))
        assert set(neighbours[view]) == set(np.argsort(tilts)[1 : NUM_NEIGHBOURS + 1])
        for other, twist in zip(neighbours[view], twists[view], strict=True):
            turns = Rotation.from_euler("z", [[twist - 0.02], [twist], [twist + 0.02]])
            turned = turns * Rotation.from_matrix(rotations[other])
            apart = (turned * Rotation.from_matrix(rotations[view]).inv()).magnitude()
            assert apart.argmin() == 1
            np.testing.assert_allclose(apart[1], tilts[other])


def test_a_match_becomes_the_pose_at_its_pixel_size_and_turn(detector):
    rng, K = np.random.default_rng(2), camera_matrix(300, 300, 100.0, 80.0)
    drawings, turns = rng.integers(0, NUM_VIEWS, 20), rng.uniform(-np.pi, np.pi, 20)
    pixels, sizes = rng.uniform(0, 200, (20, 2)), rng.uniform(40, 120, 20)
    transforms = detector.transforms(drawings, np.column_stack([pixels, turns, sizes]), K)
    centre = detector.part.mesh.vertices.min(axis=0) / 2
    centre += detector.part.mesh.vertices.max(axis=0) / 2
    rotations = view_rotations(180.0)[drawings]
    for T, pixel, size, turn, R in zip(transforms, pixels, sizes, turns, rotations, strict=True):
        centre_in_camera = transform(T, centre[None])
        np.testing.assert_allclose(project(centre_in_camera, K)[0], pixel)
        np.testing.assert_allclose(centre_in_camera[0, 2], 300 * detector.part.diameter / size)
        ray = centre_in_camera[0] / np.linalg.norm(centre_in_camera)
        axis = np.cross([0, 0, 1], ray)
        to_ray = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.arccos(ray[2]))
        expected = to_ray * Rotation.from_euler("z", turn) * Rotation.from_matrix(R)
        np.testing.assert_allclose(T[:3, :3], expected.as_matrix(), atol=1e-9)


def test_a_match_with_low_normalised_edges_is_a_start(detector, rendered, monkeypatch):
    image, K, _ = rendered
    views, poses, features = detector.ranked(image, K, DISTANCES)
    weights = learned_ranking().weights
    edges, supported = FEATURES.index("edges"), FEATURES.index("supported")
    narrow = int(np.argmin(features @ weights))
    features[narrow, supported] += 100 / weights[supported]
    features[narrow, edges] -= 200 / weights[edges]
    monkeypatch.setattr(detector, "ranked", lambda *_: (views, poses, features))
    *others, last = detector.detect(image, K)
    T_cam_obj = detector.transforms(views[[narrow]], poses[[narrow]], K)[0]
    np.testing.assert_allclose(last.T_cam_obj, T_cam_obj)
    scores = [start.score for start in others]
    assert scores == sorted(scores, reverse=True)
    assert last.score < scores[-1]


def test_refined_start_pose_is_the_true_pose(detector, rendered):
    image, K, T_true = rendered
    assert is_near(detector.detect(image, K), detector.part, T_true)
    best, *_ = TemplateEstimator([detector], DISTANCES).predict(image, K)
    assert distance_of(detector.part, best.T_cam_obj, T_true) < 0.05


@pytest.mark.parametrize("case", ["grey", "region", "range of 1:10", "4k"])
def test_part_is_detected_on_unusual_input(detector, rendered, case):
    image, K, T_true = rendered
    u, v = project(T_true[None, :3, 3], K)[0]
    options = {}
    if case == "grey":
        image = np.repeat(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)
    elif case == "region":
        left, top = max(0, round(u) - 100), max(0, round(v) - 100)
        options["roi"] = (left, top, min(200, 320 - left), min(200, 240 - top))
    elif case == "4k":
        image = cv2.resize(image, (3840, 2880), interpolation=cv2.INTER_CUBIC)
        K = camera_matrix(12 * K[0, 0], 12 * K[1, 1], *(12 * (K[:2, 2] + 0.5) - 0.5))
    else:
        options["distances"] = (0.06, 0.6)
    starts = detector.detect(image, K, **options)
    assert is_near(starts, detector.part, T_true)
    if case == "region":
        left, top, width, height = options["roi"]
        pixels = np.array([start.keypoints[-1] for start in starts]) - [left, top]
        assert ((pixels > -5) & (pixels < [width + 5, height + 5])).all()


def test_a_ball_without_creases_is_detected_at_its_distance():
    ball = trimesh.creation.icosphere(3, 0.03)
    part = make_part("ball", Mesh(np.asarray(ball.vertices), ball.faces.astype(np.int32)))
    detector = TemplateDetector(part, (0.2, 0.4), tilt_deg=10)
    image, K = np.full((240, 320, 3), 60, np.uint8), camera_matrix(300, 300, 159.5, 119.5)
    cv2.circle(image, (190, 100), 30, (200, 190, 180), -1, cv2.LINE_AA)
    best, *_ = detector.detect(image, K)
    np.testing.assert_allclose(project(best.T_cam_obj[None, :3, 3], K)[0], [190, 100], atol=3)
    assert best.T_cam_obj[2, 3] == pytest.approx(0.3, rel=0.08)


def test_impossible_requests_are_rejected(detector):
    points = np.random.default_rng(0).normal(size=(50, 3)) * 0.02
    with pytest.raises(UserError, match="cloud, which has no mesh"):
        TemplateDetector(make_part("cloud", None, points), DISTANCES)
    image, K = np.zeros((480, 640, 3), np.uint8), camera_matrix(600, 600, 319.5, 239.5)
    with pytest.raises(UserError, match=rf"\d pixels long .* at least {SMALLEST_PX:.0f} pixels"):
        detector.detect(image, K, distances=(10.0, 20.0))


def test_the_silhouette_of_a_ball_has_the_area_of_its_disc():
    ball = trimesh.creation.icosphere(3, 0.03)
    part = make_part("ball", Mesh(np.asarray(ball.vertices), ball.faces.astype(np.int32)))
    T = np.eye(4)
    T[2, 3] = 0.1
    disc = np.pi / 4 / (1 - 0.3**2)  # the sine of half the angle that it covers is 0.3
    detector, image = TemplateDetector(part, DISTANCES), np.zeros((480, 640, 3), np.uint8)
    K = camera_matrix(600, 600, 319.5, 239.5)
    assert detector.silhouette(T, image, K) == pytest.approx(disc, rel=0.02)
    T[0, 3] = -319.5 / 600 * 0.1  # the centre is on the left border
    assert detector.silhouette(T, image, K) == pytest.approx(disc / 2, rel=0.1)


def test_half_turns_keep_the_centre_the_tilt_and_the_symmetries(detector, rendered):
    _, _, T = rendered
    centre = np.append(
        (detector._mesh.vertices.min(axis=0) + detector._mesh.vertices.max(axis=0)) / 2, 1
    )
    turned = detector.half_turned(T)
    assert len(turned) == 3
    for axis, pose in enumerate(turned):
        np.testing.assert_allclose(pose @ centre, T @ centre)
        turn = T[:3, :3].T @ pose[:3, :3]
        np.testing.assert_allclose(
            turn, 2 * np.outer(*[np.eye(3)[axis]] * 2) - np.eye(3), atol=1e-9
        )
    upright = np.diag([1.0, -1.0, -1.0, 1.0])
    upright[2, 3] = 0.25
    limited = TemplateDetector(detector.part, DISTANCES, tilt_deg=30)
    (pose,) = limited.half_turned(upright)
    np.testing.assert_allclose(pose[:3, :3], np.diag([-1.0, 1.0, -1.0]), atol=1e-9)
    box = trimesh.creation.box((0.04, 0.03, 0.02))
    part = make_part("box", Mesh(np.asarray(box.vertices), box.faces.astype(np.int32)))
    symmetric = replace(
        part,
        symmetries_discrete=np.pad(HALF_TURNS[1:], ((0, 0), (0, 1), (0, 1)))
        + np.diag([0, 0, 0, 1]),
    )
    assert len(TemplateDetector(part, DISTANCES, tilt_deg=5).half_turned(upright)) == 1
    assert TemplateDetector(symmetric, DISTANCES, tilt_deg=5).half_turned(upright) == []


def test_a_thin_silhouette_needs_more_evidence(detector, rendered, monkeypatch):
    estimator = TemplateEstimator([detector], DISTANCES)
    image, K, T = rendered
    edge_on = T.copy()
    edge_on[:3, :3] = np.eye(3)[[0, 2, 1]] * [1, 1, -1]
    monkeypatch.setattr(
        estimator, "refiner", lambda start, *_: replace(start, probability=0.9, kept="")
    )
    starts = [detector.start(pose, 0.5, K) for pose in (T, edge_on)]
    seen, thin = (end.probability for end in estimator._refined_once(starts, image, K, None))
    ratio = detector.silhouette(T, image, K) / detector.silhouette(edge_on, image, K)
    assert ratio > 2
    assert log_odds(seen) - log_odds(thin) == pytest.approx(np.log(ratio))
    assert log_odds(seen) == pytest.approx(log_odds(0.9) + np.log(detector.silhouette(T, image, K)))
