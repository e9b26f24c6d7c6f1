"""Pose refinement on the image alone."""

import math

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy import ndimage
from scipy.stats import truncnorm

from dopepp.geometry.camera import (
    camera_matrix,
    make_transform,
    move_pose,
    project,
    resize_camera,
    transform,
)
from dopepp.geometry.rotation import rotation_angle, rotation_vector_to_matrix
from dopepp.inference.refinement.colour import colour_bins, crop_around, log_odds
from dopepp.inference.refinement.outline import (
    filled_mask,
    find_contour,
    make_outline_mesh,
    outline_rows,
    posed,
)
from dopepp.inference.refinement.refiner import NUM_QUADRUPLES, poses_of_four
from dopepp.inference.refinement.region import (
    CONVERGED,
    FINE,
    FOLLOWED,
    FOUND,
    MAX_REPEATS,
    MIN_AGREEMENT,
    RegionRefiner,
)
from dopepp.inference.refinement.region.round import Round
from dopepp.inference.refinement.region.shared_errors import (
    OFFSET_PX,
    SCALE_ERROR,
    _truncated_mean,
    region_terms,
)
from dopepp.inference.refinement.region.shifts import Shifts, find_shifts
from dopepp.inference.refinement.solver import Prior, descend
from dopepp.parts.catalogue import pivconnector, servoholder

SIZE = (416, 416)
K = camera_matrix(500, 500, 207.5, 207.5)
TURNED = rotation_vector_to_matrix(np.array([2.5, 0.5, 0.3]))
TRUE = make_transform(TURNED, np.array([0.01, -0.012, 0.24]))
PART_COLOUR, AROUND_COLOUR = (200, 120, 60), (60, 90, 130)
FLAT = np.full((64, 64, 3), 128, np.uint8)
DEVIATIONS = np.repeat([math.radians(5), 0.003], 3)
PRECISE = np.repeat([math.radians(5), 0.0003], 3)  # a tenth of a percent of the distance


COVARIANCE, PIV = np.diag(DEVIATIONS**2), pivconnector()


@pytest.fixture(scope="module", params=[PIV, servoholder()], ids=lambda part: part.name)
def part(request):
    return request.param


@pytest.fixture(scope="module")
def refiner():
    return RegionRefiner(PIV.mesh.vertices, PIV.mesh.faces)


def picture(part, T=TRUE, around=AROUND_COLOUR, noise=2):
    """Draw a part in one colour by OpenCV's polygons, four times finer than the pixels."""
    fine = K.copy()
    fine[:2] *= 4
    fine[:2, 2] += 1.5
    image = np.empty((4 * SIZE[1], 4 * SIZE[0], 3), np.uint8)
    image[:] = around
    corners = project(transform(T, part.mesh.vertices), fine)[part.mesh.faces]
    for triangle in np.round(corners * 16).astype(np.int32):
        cv2.fillConvexPoly(image, triangle, PART_COLOUR, cv2.LINE_8, 4)
    image = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA).astype(np.float64)
    image += np.random.default_rng(0).normal(size=image.shape) * noise
    return np.clip(image, 0, 255).astype(np.uint8)


def started(seed, T=TRUE):
    return move_pose(T, np.random.default_rng(seed).normal(size=6) * DEVIATIONS)


def off(T, true=TRUE):
    """Return degrees, and millimetres without what an error of the scale explains."""
    turn = float(rotation_angle(T[:3, :3] @ true[:3, :3].T))
    distance, shift = np.linalg.norm(true[:3, 3]), T[:3, 3] - true[:3, 3]
    ray = true[:3, 3] / distance
    along = np.clip(shift @ ray, -SCALE_ERROR * distance, SCALE_ERROR * distance)
    return math.degrees(turn), 1000 * float(np.linalg.norm(shift - along * ray))


@pytest.mark.parametrize("seed", range(4))
def test_contour_is_the_border_of_the_brute_force_silhouette(part, seed):
    T = move_pose(TRUE, np.random.default_rng(seed).normal(size=6) * [1, 1, 1, 0.01, 0.01, 0.01])
    mesh = make_outline_mesh(part.mesh.vertices, part.mesh.faces)
    at = posed(mesh, T, K)
    mask = filled_mask(mesh, at, SIZE)

    drawn = picture(part, T, noise=0).astype(np.float64)
    whole = np.array(PART_COLOUR, np.float64) - AROUND_COLOUR
    share = ((drawn - AROUND_COLOUR) @ whole) / (whole @ whole)
    # OpenCV draws a triangle's border pixels too: a quarter of a pixel more all around.
    assert (mask == (share > 0.5)).mean() > 0.995
    contour = find_contour(mesh, at, mask, 1.0)
    outlines, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    border = np.concatenate(outlines)[:, 0]
    distances = np.linalg.norm(contour.pixels[:, None] - border, axis=2)
    assert distances.min(axis=1).max() < 1.6  # every point is on the border
    assert np.mean(distances.min(axis=0) < 3.0) > 0.85  # and most of the border has points
    assert_allclose(np.linalg.norm(contour.normals, axis=1), 1.0)
    inner, outer = (
        cv2.remap(
            mask.astype(np.float32), *(contour.pixels + sign * 1.6 * contour.normals)
            .astype(np.float32).T[:, :, None], cv2.INTER_LINEAR,
        ) for sign in (-1, 1)
    )  # fmt: skip
    assert inner.mean() > 0.9 > 0.1 > outer.mean()
    assert_allclose(project(contour.arms + T[:3, 3], K), contour.pixels, atol=1e-9)


def covered(triangles, size):
    """Return which pixel centres lie in any of the triangles (n, 3, 2)."""
    points = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), axis=-1)
    mask = np.zeros(size[::-1], bool)
    for a, b, c in triangles:
        sides = [
            (q - p)[0] * (points - p)[..., 1] - (q - p)[1] * (points - p)[..., 0]
            for p, q in ((a, b), (b, c), (c, a))
        ]
        mask |= (np.min(sides, axis=0) >= 0) | (np.max(sides, axis=0) <= 0)
    return mask


@given(st.integers(0, 2**32 - 1), st.sampled_from(["closed", "open", "flipped", "fins"]))
def test_the_mask_is_what_the_triangles_cover(seed, kind):
    rng = np.random.default_rng(seed)
    ring = trimesh.creation.annulus(0.01, 0.02, 0.02, sections=10)
    vertices, faces = ring.vertices, ring.faces
    if kind == "open":
        faces = faces[rng.random(len(faces)) < 0.7]
    elif kind == "flipped":
        faces = np.where(rng.random((len(faces), 1)) < 0.2, faces[:, ::-1], faces)
    elif kind == "fins":  # several triangles at an edge
        tips = vertices[faces[:20]].mean(axis=1) + rng.normal(size=(20, 3)) * 0.01
        fins = np.column_stack([faces[:20, :2], len(vertices) + np.arange(20)])
        vertices, faces = np.concatenate([vertices, tips]), np.concatenate([faces, fins])
    outline = make_outline_mesh(vertices, faces)
    assert outline.is_closed == (kind == "closed")
    # Near and beside the image too: clipped on all sides.
    camera, size = camera_matrix(80, 80, 31.5, 23.5), (64, 48)
    shift = rng.uniform([-0.1, -0.1, 0.08], [0.1, 0.1, 0.5])
    R = rotation_vector_to_matrix(rng.normal(size=3))
    at = posed(outline, make_transform(R, shift), camera)
    if at is None:
        return
    mask = filled_mask(outline, at, size).astype(bool)
    # A centre on a border, or within rounding of it, belongs to either side.
    assert (mask != covered(at.pixels[outline.faces], size)).sum() <= 2


def test_holes_and_open_edges_are_outlined_hidden_edges_are_not():
    # A frame of one side only, before a smaller square that it partly hides.
    outer = np.array([[-4, -4, 0], [4, -4, 0], [4, 4, 0], [-4, 4, 0]], np.float64)
    vertices = np.concatenate([outer, outer / 2, outer * 0.7 + [0, 0, 1]]) / 100
    faces = [[i, (i + 1) % 4, 4 + i] for i in range(4)]
    faces += [[(i + 1) % 4, 4 + (i + 1) % 4, 4 + i] for i in range(4)]
    alone = make_outline_mesh(vertices[:8], np.array(faces))
    both = make_outline_mesh(vertices, np.array([*faces, [8, 9, 10], [8, 10, 11]]))
    T = make_transform(np.eye(3), np.array([0, 0, 0.4]))
    radii = []
    for mesh in (alone, both):
        at = posed(mesh, T, K)
        contour = find_contour(mesh, at, filled_mask(mesh, at, SIZE), 2.0)
        radii.append(np.abs(contour.arms[:, :2]).max(axis=1).round(3))
    assert (set(radii[0]), set(radii[1])) == ({0.02, 0.04}, {0.04})


def test_derivative_against_finite_differences(part):
    mesh = make_outline_mesh(part.mesh.vertices, part.mesh.faces)
    at = posed(mesh, TRUE, K)
    contour = find_contour(mesh, at, filled_mask(mesh, at, SIZE), 5.0)
    rows = outline_rows(contour, TRUE, K)
    points = contour.arms @ TRUE[:3, :3]
    for axis, step in enumerate(1e-6 * np.eye(6)):
        poses = move_pose(TRUE, step), move_pose(TRUE, -step)
        ahead, behind = (project(transform(T, points), K) for T in poses)
        slope = ((ahead - behind) * contour.normals).sum(axis=1) / 2e-6
        assert_allclose(rows[:, axis], slope, rtol=1e-5, atol=1e-4)


def test_terms_take_the_common_offset_out():
    # Against the seven unknowns solved at once. At the camera's centre, scale moves no point.
    rng = np.random.default_rng(3)
    rows, mean = rng.normal(size=(60, 6)) * 100, rng.normal(size=60) * 1e-3 + 1.3
    shifts = Shifts(mean, np.full(60, 2.0))
    prior = np.eye(6), np.zeros(6)
    H, g = region_terms(rows, shifts, prior, spacing=8.0, extent=1.0, position=np.zeros(3))
    step = np.linalg.solve(H + prior[0], g)
    assert np.abs(rows @ step).max() < 0.2, "an offset of all points moves no pose"
    all_rows = np.column_stack([rows, np.ones(60)])
    ridge = np.diag([*np.ones(6), 1 / OFFSET_PX**2])
    whole = np.linalg.solve(2 * all_rows.T @ all_rows + ridge, 2 * all_rows.T @ mean)
    assert_allclose(step, whole[:6], atol=2e-5)


@pytest.mark.parametrize("enlarged", [0.0, 0.001, -0.0045, 0.02, -0.05])
def test_a_bounded_error_of_the_scale_has_its_expected_value(enlarged):
    # Against the eight unknowns solved at once: pose, offset and scale.
    rng = np.random.default_rng(4)
    position, weights = np.array([0.1, -0.05, 0.5]), np.full(60, 2.0**0.5)
    rows = rng.normal(size=(60, 6)) * 100
    by_scale = -rows[:, 3:] @ position
    shifts = Shifts(rows @ (1e-3 * rng.normal(size=6)) + enlarged * by_scale, np.full(60, 2.0))
    factor = np.linalg.cholesky(50 * np.eye(6) + 20 * np.ones((6, 6))).T
    offset = 1e-3 * rng.normal(size=6)  # from the pose to the prior's mean
    prior = factor.T @ factor, factor.T @ factor @ offset
    H, g = region_terms(rows, shifts, prior, spacing=8.0, extent=1.0, position=position)

    design = np.zeros((67, 8))
    design[:60] = weights[:, None] * np.column_stack([rows, np.ones(60), by_scale])
    design[60, 6], design[61:, :6] = 1 / OFFSET_PX, factor
    target = [*weights * shifts.mean, 0.0, *factor @ offset]
    unbounded = np.linalg.lstsq(design, target, rcond=None)[0][7]
    deviation = np.linalg.inv(design.T @ design)[7, 7] ** 0.5
    low, high = ((limit - unbounded) / deviation for limit in (-SCALE_ERROR, SCALE_ERROR))
    error = truncnorm.mean(low, high, loc=unbounded, scale=deviation)
    expected = np.linalg.lstsq(design[:, :7], target - error * design[:, 7], rcond=None)[0]
    assert_allclose(np.linalg.solve(H + prior[0], g + prior[1]), expected[:6], atol=2e-6)
    assert abs(error) < SCALE_ERROR
    # The covariance contains the error of the scale, which is uniformly distributed.
    without_error = np.linalg.inv(design[:61, :7].T @ design[:61, :7])[:6, :6]
    nearer = np.array([0, 0, 0, *position])
    stated = without_error + SCALE_ERROR**2 / 3 * np.outer(nearer, nearer)
    assert_allclose(np.linalg.inv(H), stated, rtol=1e-3, atol=1e-9)


def straight_edge():
    """Return a square's outline in an image of 64 pixels, and which points are right."""
    corners = np.array([[-1, -1, 0], [0, -1, 0], [0, 1, 0], [-1, 1, 0.0]])
    mesh = make_outline_mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    T = make_transform(np.eye(3), np.array([0, 0, 40.0]))
    at = posed(mesh, T, camera_matrix(800, 800, 31.5, 31.5))
    contour = find_contour(mesh, at, filled_mask(mesh, at, (64, 64)), 2.0)
    return contour, contour.normals[:, 0] > 0.9


COLUMNS, NO_ODDS = np.arange(64.0), np.zeros((64, 64), np.float32)


def odds_of(row):
    return np.broadcast_to(row, (64, 64)).astype(np.float32, order="C")


def grey_of(row):
    return np.broadcast_to(row[:, None], (64, 64, 3)).astype(np.uint8, order="C")


def test_shifts_of_a_straight_edge():
    contour, right = straight_edge()
    for edge in (30.3, 33.0, 35.6):
        odds = odds_of(np.clip(2 * (edge - COLUMNS), -1, 1) * 3)
        shifts = find_shifts(odds, FLAT, contour, 8.0, 1.0, FOUND)
        assert_allclose(shifts.mean[right], edge - 31.5, atol=0.15)
        assert shifts.information[right].min() > 0.5
    nothing = find_shifts(NO_ODDS, FLAT, contour, 8.0, 1.0, FOUND)
    assert_allclose(nothing.information, 0.0, atol=1e-12)


def test_an_edge_is_found_where_colours_tell_nothing():
    contour, right = straight_edge()
    for edge in (28.5, 31.5, 35.0):
        colours = grey_of(100 + 60 * np.clip(COLUMNS - edge + 0.5, 0, 1))
        shifts = find_shifts(NO_ODDS, colours, contour, 6.0, 1.0, FOUND)
        weights = shifts.information[right]
        assert weights.min() > 0.05
        assert abs(np.average(shifts.mean[right], weights=weights) - (edge - 31.5)) < 0.8
    noise = np.random.default_rng(0).normal(128, 2, (64, 64, 3)).astype(np.uint8)
    nothing = find_shifts(NO_ODDS, noise, contour, 6.0, 1.0, FOUND)
    assert nothing.information.mean() < 0.003


def test_of_a_followed_part_a_blurred_edge_outweighs_its_colours():
    contour, right = straight_edge()
    colours = grey_of(cv2.GaussianBlur(np.where(COLUMNS < 31.5, 60.0, 160.0)[None], (0, 0), 3.0)[0])
    # The mixed colours beyond the edge were learned as the part's.
    odds = odds_of(np.where(COLUMNS < 34.5, 3.0, -3.0))
    result, followed = (
        find_shifts(odds, colours, contour, 8.0, 1.0, weights).mean[right]
        for weights in (FOUND, FOLLOWED)
    )
    assert_allclose(followed, 0.0, atol=0.7)
    assert result.min() > 1.5


@pytest.mark.parametrize("extent", [40.0, 150.0, 900.0])
def test_crop_keeps_places(extent):
    rng = np.random.default_rng(1)
    image = cv2.resize(rng.integers(0, 256, (20, 25, 3), np.uint8), (1250, 1000))
    middle = np.array([600.0, 480.0])
    box = middle + extent / 2 * np.array([[-1, -1], [1, 1]])
    crop = crop_around(image, K, box, 120)
    assert crop.extent <= 1.5 * 120
    assert crop.extent == pytest.approx(extent * crop.scale)
    # A pixel of the crop shows what the image shows at the place that has the same ray.
    rays = np.stack(np.meshgrid(*(np.linspace(5, size - 6, 9) for size in crop.size)), -1)
    rays = (rays - crop.K[:2, 2]) / np.diag(crop.K)[:2]
    own, whole = (
        ndimage.map_coordinates(
            pixels[..., 0].astype(float), (rays * np.diag(M)[:2] + M[:2, 2]).T[::-1], order=1
        ) for pixels, M in ((crop.colours, crop.K), (image, K))
    )  # fmt: skip
    assert_allclose(own, whole, atol=12)


def test_colours_tell_part_from_surroundings():
    mask = np.zeros((80, 80), np.uint8)
    mask[20:60, 20:60] = 1
    image = np.where(mask[..., None] == 1, PART_COLOUR, AROUND_COLOUR).astype(np.uint8)
    image[35:40, 35:40] = image[5:10, 25:30] = (10, 240, 10)  # seen on both sides
    odds = log_odds(colour_bins(image), mask, 3.0, 20.0, 1)
    assert odds[50, 50] > 2 > -2 > odds[70, 50]
    assert abs(odds[37, 37]) < 1.5
    assert log_odds(colour_bins(image), np.zeros_like(mask), 3.0, 20.0, 1) is None


def test_tiles_tell_a_part_of_two_colours_before_the_same_two():
    mask = np.zeros((120, 120), np.uint8)
    mask[20:100, 20:100] = 1
    left = np.arange(120) < 60
    image = np.where(((mask == 1) == left)[..., None], PART_COLOUR, AROUND_COLOUR).astype(np.uint8)
    whole, tiled = (log_odds(colour_bins(image), mask, 3.0, 20.0, tiles) for tiles in (1, 3))
    assert np.abs(whole).max() < 0.5
    for columns in (slice(0, 45), slice(75, 120)):
        assert np.where(mask == 1, tiled, -tiled)[:, columns].min() > 0.5


@pytest.mark.parametrize("tiles", [1, 3])
def test_log_odds_do_not_depend_on_pixels_beyond_the_surroundings(tiles):
    image = np.random.default_rng(0).integers(0, 256, (110, 130, 3), np.uint8)
    mask = np.zeros((110, 130), np.uint8)
    cv2.ellipse(mask, (65, 55), (30, 15), 30.0, 0.0, 360.0, 1, -1)
    bins = colour_bins(image)
    cut = slice(20, 90), slice(20, 110)  # 15 pixels and more around the ellipse
    odds = log_odds(bins, mask, 1.5, 10.0, tiles)
    np.testing.assert_array_equal(odds[cut], log_odds(bins[cut], mask[cut], 1.5, 10.0, tiles))


def test_descent_without_evidence_returns_to_the_prior():
    prior = Prior(TRUE, np.diag(1 / DEVIATIONS**2))
    result = descend(started(1), prior, [lambda pose, known: (np.zeros((6, 6)), np.zeros(6))], 8)
    assert_allclose(result.T_cam_obj, TRUE, atol=1e-6)
    assert descend(TRUE, prior, [lambda pose, known: None], 8) is None


@pytest.mark.parametrize("seed", range(6))
def test_two_colours_are_solved(part, seed):
    refiner = RegionRefiner(part.mesh.vertices, part.mesh.faces)
    refined = refiner.refine(picture(part), K, started(seed), COVARIANCE)
    assert not refined.reason
    assert max(off(refined.T_cam_obj)) < 0.3
    assert np.linalg.eigvalsh(refined.covariance).min() > 0
    assert np.linalg.det(refined.covariance) < np.prod(DEVIATIONS**2)
    assert refined.agreement > 0.9


def test_distance_is_kept_where_the_scale_may_be_wrong(part):
    wrong_camera = K * np.array([[1.006], [1.006], [1.0]])
    wrong_camera[:2, 2] = K[:2, 2]
    refiner = RegionRefiner(part.mesh.vertices, part.mesh.faces)
    for log_distance, deviations, kept in ((0.0, PRECISE, 0.002), (0.06, DEVIATIONS, 0.02)):
        turned = np.array([0.05, -0.06, 0.05, *log_distance * TRUE[:3, 3]])
        given = move_pose(TRUE, turned)
        refined = refiner.refine(picture(part), wrong_camera, given, np.diag(deviations**2))
        assert off(refined.T_cam_obj)[0] < 0.5
        ratio = np.linalg.norm(refined.T_cam_obj[:3, 3]) / np.linalg.norm(TRUE[:3, 3])
        assert abs(ratio - 1) < kept
        along = TRUE[:3, 3] / np.linalg.norm(TRUE[:3, 3])
        deviation = np.sqrt(along @ refined.covariance[3:, 3:] @ along)
        assert deviation > 0.4 * min(SCALE_ERROR * TRUE[2, 3], deviations[3])


@given(st.floats(-0.1, 0.1, allow_subnormal=False), st.floats(1e-4, 1.0), st.floats(1e-4, 0.1))
def test_the_expected_error_is_that_of_a_truncated_normal(mean, deviation, limit):
    expected = _truncated_mean(mean, deviation, limit)
    low, high = (-limit - mean) / deviation, (limit - mean) / deviation
    exact = truncnorm.mean(low, high, loc=mean, scale=deviation)
    assert expected == pytest.approx(exact, abs=0.25 * deviation if abs(mean) > limit else 1e-9)
    assert abs(expected) <= limit + 1e-9


@pytest.mark.parametrize(
    ("scale_error", "deviations", "ratio"),
    [(0.0, DEVIATIONS, 1.0), (0.01, PRECISE, 1.008), (0.01, 3 * DEVIATIONS, 1.0)],
)
def test_a_known_size_or_an_unknown_distance_gives_the_distance_of_the_outline(
    part, scale_error, deviations, ratio
):
    refiner = RegionRefiner(part.mesh.vertices, part.mesh.faces, scale_error)
    given = move_pose(TRUE, np.array([0.03, -0.03, 0.03, *0.008 * TRUE[:3, 3]]))
    refined = refiner.refine(picture(part), K, given, np.diag(deviations**2))
    distances = [np.linalg.norm(T[:3, 3]) for T in (refined.T_cam_obj, TRUE)]
    assert distances[0] / distances[1] == pytest.approx(ratio, abs=0.003)


def test_part_behind_an_occluder_and_over_the_border(refiner):
    image = picture(PIV)
    image[150:240, 190:250] = (30, 160, 40)
    assert max(off(refiner.refine(image, K, started(2), COVARIANCE).T_cam_obj)) < 0.8
    T = make_transform(TRUE[:3, :3], np.array([0.085, -0.012, 0.24]))
    refined = refiner.refine(picture(PIV, T), K, started(2, T), COVARIANCE)
    assert max(off(refined.T_cam_obj, T)) < 1.5


@pytest.mark.parametrize(
    ("image", "pose", "reason"),
    [
        (np.full((416, 416, 3), 128, np.uint8), TRUE, "too alike"),
        (picture(PIV, around=PART_COLOUR), started(1), "too alike"),
        (np.random.default_rng(0).integers(0, 256, (416, 416, 3), np.uint8), TRUE, "alike"),
        (picture(PIV), np.full((4, 4), np.nan), "not finite"),
        (np.zeros((1, 1, 3), np.uint8), TRUE, "outside the image"),
        (picture(PIV), make_transform(TURNED, np.array([0.5, 0, 0.24])), "outside"),
        (picture(PIV), make_transform(TURNED, np.array([0, 0, 0.01])), "behind"),
        (picture(PIV), make_transform(TURNED, np.array([0, 0, -0.3])), "behind"),
        (picture(PIV), make_transform(TURNED, np.array([0, 0, 30.0])), "pixels long"),
        (picture(PIV), make_transform(TURNED, np.array([0.13, 0, 0.24])), ""),
    ],
)
def test_pose_is_kept_with_a_reason(refiner, image, pose, reason):
    kept = refiner.refine(image, K, pose, COVARIANCE)
    assert kept.reason
    assert reason in kept.reason
    assert kept.covariance is None
    np.testing.assert_array_equal(kept.T_cam_obj, pose)


def test_without_a_covariance_a_broad_one_is_taken(refiner):
    for covariance in (None, np.full((6, 6), np.nan)):
        assert max(off(refiner.refine(picture(PIV), K, started(4), covariance).T_cam_obj)) < 0.5


@pytest.fixture
def learned(monkeypatch):
    """The lengths of the rounds that are begun, in pixels."""
    lengths, learn = [], Round.learn

    def recorded(this, *rest):
        lengths.append(this.stage.longest_px)
        learn(this, *rest)

    monkeypatch.setattr(Round, "learn", recorded)
    return lengths


def test_tight_prior_needs_the_last_round_only(refiner, learned):
    # As a tracker's: the outline is two pixels off.
    deviations = np.repeat([math.radians(0.4), 0.0004], 3)
    start = move_pose(TRUE, np.array([1, -1, 1, -1, 1, 1]) * deviations)
    refined = refiner.refine(picture(PIV), K, start, np.diag(deviations**2))
    assert learned == [FINE.longest_px]
    assert not refined.reason
    assert max(off(refined.T_cam_obj)) < 0.3 < max(off(start))


def test_the_last_round_is_repeated_until_it_converges(refiner, learned, monkeypatch):
    image = picture(PIV)
    refined = refiner.refine(image, K, started(1), COVARIANCE)
    repeats = learned.count(FINE.longest_px) - 1
    assert 1 <= repeats < MAX_REPEATS  # on an image without noise, the search converges early
    # The next repetition hardly moves the pose.
    monkeypatch.setattr("dopepp.inference.refinement.region.CONVERGED", 0.0)
    further = refiner.refine(image, K, started(1), COVARIANCE)
    assert learned.count(FINE.longest_px) == repeats + MAX_REPEATS + 2
    prior = Prior(refined.T_cam_obj, np.linalg.inv(refined.covariance))
    assert prior.squared_distance(further.T_cam_obj) < CONVERGED**2


@pytest.mark.parametrize("seed", range(4))
def test_a_pose_that_was_known_well_is_not_given_up(refiner, seed):
    # An image adds little to it, and moves it by a fraction of a pixel either way.
    deviations = np.repeat([math.radians(0.05), 0.00005], 3)
    start = move_pose(TRUE, np.random.default_rng(seed).normal(size=6) * deviations)
    sure = np.diag(deviations**2)
    refined = refiner.refine(picture(PIV), K, start, sure, followed=True)
    assert not refined.reason
    assert max(off(refined.T_cam_obj)) < 0.15
    grey = refiner.refine(picture(PIV, around=PART_COLOUR, noise=0), K, start, sure)
    assert "too alike" in grey.reason


def test_large_pictures_are_read_smaller(refiner):
    image = cv2.resize(picture(PIV), None, fx=9, fy=9, interpolation=cv2.INTER_CUBIC)
    refined = refiner.refine(image, resize_camera(K, 9, 9), started(5), COVARIANCE)
    assert max(off(refined.T_cam_obj)) < 0.3


def test_faces_without_area_are_refused():
    with pytest.raises(ValueError, match="zero area"):
        RegionRefiner(np.zeros((3, 3)), np.array([[0, 1, 2]]))


def tiled(share):
    """Hide that share of a drawn part under patches of the colours around it."""
    rng, image = np.random.default_rng(0), picture(PIV)
    shown = np.abs(image.astype(int) - PART_COLOUR).max(axis=2) < 12
    rows, columns = np.nonzero(shown)
    hidden = np.zeros_like(shown)
    while (hidden & shown).sum() < share * len(rows):
        at = rng.integers(len(rows))
        hidden[rows[at] - 18 : rows[at] + 18, columns[at] - 18 : columns[at] + 18] = True
    image[hidden] = np.array(AROUND_COLOUR) + rng.normal(size=(hidden.sum(), 3)).astype(int)
    return image


def test_support_falls_with_what_is_hidden_agreement_hardly(refiner):
    bare, hidden = (refiner.refine(tiled(share), K, started(2), COVARIANCE) for share in (0.0, 0.4))
    assert max(off(bare.T_cam_obj)) < 0.5
    assert max(off(hidden.T_cam_obj)) < 1.5
    assert bare.support > 0.85 > 0.75 > hidden.support > 0.2
    assert hidden.agreement > hidden.support + 0.15


def test_far_from_a_covariance_that_is_too_sure_the_part_is_found_where_it_is_asked_for(refiner):
    sure = np.diag(np.repeat([math.radians(1.5), 0.0015], 3) ** 2)
    start = move_pose(TRUE, np.array([0.15, 0.2, -0.2, 0.012, -0.008, 0.02]))
    image = tiled(0.3)
    near = refiner.refine(image, K, start, sure)
    assert max(off(near.T_cam_obj)) > 5
    refined = refiner.refine(image, K, start, sure, starts=list)
    assert not refined.reason
    assert max(off(refined.T_cam_obj)) < 1.5
    assert refined.agreement >= MIN_AGREEMENT
    # Nothing there: the given pose stays, however far one looks.
    nothing = refiner.refine(np.full_like(image, 128), K, start, sure, starts=list)
    assert "alike" in nothing.reason
    # Where the image agrees near the given pose, nobody asks.
    refiner.refine(picture(PIV), K, started(2), COVARIANCE, starts=pytest.fail)


def test_four_right_keypoints_among_wrong_ones_give_the_pose():
    cuboid = PIV.cuboid
    peaks = project(transform(TRUE, cuboid), K)
    peaks[:3] += [[40, -25], [30, 30], [-35, 20]]
    peaks[4] = np.nan
    errors = [max(off(T)) for T in poses_of_four(cuboid, peaks, K)]
    assert 0 < len(errors) <= NUM_QUADRUPLES
    assert min(errors) < 0.01
    assert poses_of_four(cuboid, np.full((9, 2), np.nan), K) == []
    assert poses_of_four(cuboid, np.full((9, 2), 300.0), K) == []
