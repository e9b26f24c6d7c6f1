"""BOP's scores, against plain loops over BOP's definitions."""

from dataclasses import make_dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dopepp.data.sample import Instance
from dopepp.geometry.camera import make_transform
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.metrics.functional import VSD_DELTA, vsd
from dopepp.metrics.localisation import Localisation, num_matched
from dopepp.parts.part import Mesh, Part

K = np.array([[100.0, 0, 31.5], [0, 110.0, 23.5], [0, 0, 1]])
SIZE = (64, 48)
HALF = np.array([0.04, 0.03, 0.02])
HALF_TURN = make_transform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))


def part(**changes):
    corners = cuboid_keypoints(-HALF, HALF)
    made = Part("box", corners, 2 * float(np.linalg.norm(HALF)), corners[:8])
    return replace(made, **changes)


Pose = make_dataclass("Pose", ["object", "score", "T_cam_obj"])


def pose(x=0.0, turn=0.0, z=0.5):
    rotation = Rotation.from_euler("z", turn, degrees=True).as_matrix()
    return make_transform(rotation, np.array([x, 0.0, z]))


def truth(T, visible=1.0, wanted=None):
    return Instance("box", T, np.zeros((9, 2)), visible, wanted=wanted)


def matched_loop(errors, threshold):
    """bop_toolkit's greedy matching, estimate by estimate."""
    taken = []
    for row in errors:
        best, nearest = threshold, None
        for number, error in enumerate(row):
            if number not in taken and error < best:
                best, nearest = error, number
        taken += [] if nearest is None else [nearest]
    return len(taken)


@given(st.integers(0, 4), st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_matching_is_the_plain_loop(num_estimates, num_targets, seed):
    errors = np.random.default_rng(seed).integers(0, 5, (num_estimates, num_targets)) / 4
    assert num_matched(errors, 0.75) == matched_loop(errors, 0.75)


def drawn(T, depth_of=0.0):
    """A frontal plate at the pose's depth, as a depth image."""
    depth = np.zeros(SIZE[::-1])
    u = K[0, 0] * T[0, 3] / T[2, 3] + K[0, 2]
    columns = slice(max(int(u - 8), 0), max(int(u + 8), 0))
    depth[16:32, columns] = T[2, 3] + depth_of
    return depth


def vsd_loop(estimated, true, measured, diameter, tolerances):
    """Pixel by pixel, BOP 2019."""
    errors = []
    for tolerance in tolerances:
        wrong, count = 0, 0
        for v, u in np.ndindex(measured.shape):
            ray = np.linalg.norm(np.linalg.inv(K) @ [u, v, 1])
            e, t, m = (ray * image[v, u] for image in (estimated, true, measured))
            visible_true = t > 0 and (m == 0 or t - m <= VSD_DELTA)
            visible_estimated = e > 0 and (m == 0 or e - m <= VSD_DELTA or visible_true)
            count += visible_true or visible_estimated
            wrong += (visible_true != visible_estimated) or (
                visible_true and abs(t - e) / diameter >= tolerance
            )
        errors.append(wrong / count if count else 1.0)
    return errors


@pytest.mark.parametrize(("x", "z"), [(0.0, 0.5), (0.02, 0.51), (0.0, 0.45), (0.2, 0.5), (0, 0.6)])
def test_vsd_is_its_definition(x, z):
    rng = np.random.default_rng(3)
    measured = np.where(rng.random(SIZE[::-1]) < 0.2, 0.0, 0.5 + 0.03 * rng.normal(size=SIZE[::-1]))
    measured[20:24] = 0.4  # an object in front of both
    estimated, true = drawn(pose(x, z=z)), drawn(pose())
    result = vsd(estimated, true, measured, K, 0.1)
    expected = vsd_loop(estimated, true, measured, 0.1, np.arange(1, 11) / 20)
    np.testing.assert_allclose(result, expected)


def test_vsd_of_an_invisible_object_is_one():
    nothing = np.zeros(SIZE[::-1])
    np.testing.assert_array_equal(vsd(nothing, nothing, nothing, K, 0.1), np.ones(10))


def scores(images, of=None, depth=None, draw=None):
    accumulator = Localisation([of or part()], draw)
    for detections, instances in images:
        accumulator.update(detections, instances, K, SIZE, depth)
    return accumulator.scores()


def test_recalls_by_hand():
    shift = 0.22 * part().diameter  # passes 0.25 … 0.5 of ten thresholds: six
    found = [[Pose("box", 0.9, pose(shift))], [], [Pose("box", 0.1, pose())]]
    result = scores([(detections, [truth(pose())]) for detections in found])
    assert (result.num_targets, result.ar_vsd, result.ar) == (3, None, None)
    assert result.ar_mssd == pytest.approx((0.6 + 0 + 1) / 3)
    pixels = K[0, 0] * shift / (0.5 - HALF[2]) * 640 / SIZE[0]  # of the nearest corner
    share = np.mean([pixels < limit for limit in range(5, 55, 5)])
    assert result.ar_mspd == pytest.approx((share + 0 + 1) / 3)
    assert result.add_or_s_01d == pytest.approx(1 / 3)
    assert "3 targets: AR n/a (VSD n/a, MSSD 53.3%" in result.in_words()


def test_targets_are_listed_or_visible_and_limit_the_number_of_estimates():
    away, right = Pose("box", 0.9, pose(0.3)), Pose("box", 0.5, pose())
    item = [truth(pose())]
    # One target: only the estimate with the best score counts, not the nearest.
    assert scores([([right, away], item)]).add_or_s_01d == 0
    assert scores([([right, replace(away, score=0.1)], item)]).add_or_s_01d == 1
    hidden = truth(pose(0.3), visible=0.05)
    assert scores([([right], [truth(pose()), hidden])]).num_targets == 1
    listed = [truth(pose(), wanted=False), truth(pose(0.3), visible=0.05, wanted=True)]
    assert scores([([away], listed)]).add_or_s_01d == 1
    assert scores([([right], [truth(pose(), wanted=False)])]) is None


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_add_or_s_is_over_the_vertices(seed, symmetric):
    """As in bop_toolkit, by plain loops; the part's own ADD points lie elsewhere."""
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(30, 3)) * HALF
    mesh = Mesh(vertices, np.arange(30, dtype=np.int32).reshape(10, 3))
    turns = HALF_TURN[None] if symmetric else None
    given_part = part(mesh=mesh, points=vertices.mean(0)[None], symmetries_discrete=turns)
    T_est, T_gt = pose(0.01 * rng.normal(), 30 * rng.normal()), pose(0.01 * rng.normal())
    estimated, true = (vertices @ T[:3, :3].T + T[:3, 3] for T in (T_est, T_gt))
    nearest = [np.linalg.norm(estimated - item, axis=1).min() for item in true]
    error = np.mean(nearest if symmetric else np.linalg.norm(estimated - true, axis=1))
    result = scores([([Pose("box", 1.0, T_est)], [truth(T_gt)])], given_part)
    assert result.add_or_s_01d == (error < 0.1 * given_part.diameter)


def test_symmetric_parts_are_scored_with_add_s():
    turned = [([Pose("box", 1.0, pose(turn=180))], [truth(pose())])]
    plain, symmetric = scores(turned), scores(turned, part(symmetries_discrete=HALF_TURN[None]))
    assert (plain.ar_mssd, plain.add_or_s_01d) == (0, 0)
    assert (symmetric.ar_mssd, symmetric.ar_mspd, symmetric.add_or_s_01d) == (1, 1, 1)


def test_ar_is_the_mean_of_three_recalls_if_depth_is_available():
    mesh = Mesh(part().cuboid[:8], np.array([(0, 1, 2)], np.int32))
    images = [([Pose("box", 1.0, pose(0.01))], [truth(pose())])]
    measured = drawn(pose())
    result = scores(images, part(mesh=mesh), measured, lambda _, T, *__: drawn(T))
    errors = vsd_loop(drawn(pose(0.01)), measured, measured, part().diameter, np.arange(1, 11) / 20)
    recalls = [np.mean([error < limit / 20 for limit in range(1, 11)]) for error in errors]
    assert result.ar_vsd == pytest.approx(np.mean(recalls))
    assert 0 < result.ar_vsd < 1
    assert result.ar == pytest.approx((result.ar_vsd + result.ar_mssd + result.ar_mspd) / 3)
    assert scores([*images, ([], [truth(pose())])], part(mesh=mesh), measured).ar is None  # no draw
