"""The accumulator: matching, counting, rates, and cases without instances or detections."""

import copy
import json
import math
import pickle
from collections import namedtuple
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from dopepp.core.errors import UserError
from dopepp.data.sample import Instance
from dopepp.geometry.camera import make_transform, move_pose
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.metrics.functional import add, add_s, auc, mspd, mssd, pass_rate, rotation_error_deg
from dopepp.metrics.pose import MEAN, PoseMetrics
from dopepp.metrics.row import PoseRow, shown_columns
from dopepp.parts.part import Mesh, Part

K = np.array([[500.0, 0, 319.5], [0, 500, 239.5], [0, 0, 1]])
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])
Detection = namedtuple("Detection", ["object", "score", "T_cam_obj", "covariance"], defaults=[None])


def part(name, seed=0):
    points = np.random.default_rng(seed).uniform(-0.05, 0.05, (200, 3)) * [1, 0.6, 0.2]
    return Part(name, cuboid_keypoints(points.min(0), points.max(0)), 0.12, points)


def pose(x=0.0, rotvec=(0, 0, 0)):
    return make_transform(Rotation.from_rotvec(rotvec).as_matrix(), np.array([x, 0, 0.6]))


def truth(name, T, visible=1.0):
    return Instance(name, T, np.zeros((9, 2)), visible)


def measured(*images, of=None):
    """Return the metric for one part of images, each with detections and instances."""
    metric = PoseMetrics([of or part("box")])
    for image in images:
        metric.update(*image)
    return metric


def test_errors_are_compared_with_estimated_covariances():
    rng = np.random.default_rng(1)
    deviation = np.array([0.02, 0.01, 0.01, 0.002, 0.002, 0.005])
    metric = PoseMetrics([replace(part("box"), symmetries_discrete=FLIP[None])])
    for number in range(1500):
        T = pose(0, tuple(rng.normal(size=3)))
        estimate = move_pose(T, 3 * deviation * rng.normal(size=6))
        estimate = estimate @ FLIP if number % 2 else estimate
        metric.update([Detection("box", 1, estimate, np.diag(deviation**2))], [truth("box", T)])
    assert metric.compute()["box"].median_deviations == pytest.approx(3, rel=0.05)
    inside = chi2.cdf(chi2.ppf(0.9, 6) / 9, 6)
    assert metric.compute()["box"].coverage == pytest.approx(inside, abs=0.02)
    assert metric.compute()[MEAN].median_deviations == pytest.approx(3, rel=0.05)
    metric.update([], [truth("box", pose())])  # a miss has no covariance
    assert metric.compute()["box"].median_deviations == pytest.approx(3, rel=0.05)
    file = measured(([Detection("box", 1, pose(0.01))], [truth("box", pose())]))
    row = file.compute()["box"]
    assert (row.median_deviations, row.coverage) == (None, None)


def test_rows_agree_with_the_functions():
    """For a symmetric part on images of two sizes; most estimates are rotated by the symmetry."""
    rng = np.random.default_rng(3)
    turned = FLIP.copy()
    turned[:3, 3] = [0.002, 0.0, 0.0]
    box = replace(part("box"), symmetries_discrete=turned[None])
    metric = PoseMetrics([box])
    estimates, truths = [], []
    widths = np.where(np.arange(30) % 2, 640, 1280)
    cameras = np.array([np.diag([width / 640, width / 640, 1.0]) @ K for width in widths])
    for number in range(30):
        T = pose(rng.normal(0, 0.05), tuple(rng.normal(size=3)))
        E = (T @ turned if number % 3 else T) @ pose(0, tuple(rng.normal(0, 0.01, 3)))
        E[:3, 3] = T[:3, 3] + rng.normal(0, 0.01, 3)
        found = [Detection("box", 0.9, E)]
        metric.update(found, [truth("box", T)], cameras[number], widths[number])
        estimates.append(E)
        truths.append(T)
    est, gt = (torch.from_numpy(np.stack(x)) for x in (estimates, truths))
    split = est[:, :3, :3], est[:, :3, 3], gt[:, :3, :3], gt[:, :3, 3]
    points = torch.from_numpy(box.points)
    group = torch.from_numpy(np.stack([np.eye(4), turned]))
    errors, errors_s = add(*split, points), add_s(*split, points)
    surface = mssd(*split, points, group)
    pixels = mspd(*split, points, torch.from_numpy(cameras), group) * 640 / torch.from_numpy(widths)
    shares, steps = np.arange(1, 11) * 0.05, np.arange(1, 11) * 5.0
    relative = Rotation.from_matrix(split[0]) * Rotation.from_matrix(split[2]).inv()
    angles, distances = np.degrees(relative.magnitude()), torch.norm(split[1] - split[3], dim=1)
    row = metric.compute()["box"]
    assert row == replace(
        PoseRow("box", "estimate", 30, miss_rate=0.0, false_per_frame=0.0),
        precision=pass_rate(errors_s, 0.012),
        mspd_5px=pass_rate(pixels, 5),
        matching_radius=0.06,
        add_01d=pass_rate(errors, 0.012),
        add_005d=pass_rate(errors, 0.006),
        add_002d=pass_rate(errors, 0.0024),
        pass_5cm=pass_rate(errors, 0.05),
        pass_10cm=pass_rate(errors, 0.1),
        auc_10cm=pytest.approx(auc(errors, 0.1), rel=1e-12),
        add_s_01d=pass_rate(errors_s, 0.012),
        auc_s_10cm=pytest.approx(auc(errors_s, 0.1), rel=1e-12),
        add_or_s_01d=pass_rate(errors_s, 0.012),
        auc_or_s_10cm=pytest.approx(auc(errors_s, 0.1), rel=1e-12),
        pass_5cm_5deg=1.0,
        median_rotation_deg=pytest.approx(np.median(angles), rel=1e-9),
        median_translation=pytest.approx(np.median(distances)),
        p90_rotation_deg=pytest.approx(np.percentile(angles, 90)),
        p90_translation=pytest.approx(np.percentile(distances, 90)),
        average_precision=row.average_precision,
        mssd_01d=pass_rate(surface, 0.012),
        ar_mssd=pytest.approx(np.mean([pass_rate(surface, s * 0.12) for s in shares])),
        ar_mspd=pytest.approx(np.mean([pass_rate(pixels, s) for s in steps])),
        median_rotation_s_deg=pytest.approx(
            np.median(rotation_error_deg(split[0], split[2], group)), abs=1e-6
        ),
        num_symmetries=2,
    )
    assert 0 < row.ar_mspd < 1
    assert metric.compute()[MEAN] == replace(row, object=MEAN)
    np.testing.assert_allclose(metric.errors("box"), errors, rtol=1e-12)
    np.testing.assert_allclose(metric.errors("box", "mssd"), surface, rtol=1e-12)


@pytest.mark.parametrize(
    ("detections", "truths", "counts", "errors"),
    [
        # The detection with the better score counts, and the other is a false positive. Precision
        # counts poses within 12 mm.
        ([(0.2, pose(0)), (0.9, pose(0.03))], [(0, 1)], (1, 1, 0, 0), [0.03]),
        ([(0.9, pose(0)), (0.2, pose(0.03))], [(0, 1)], (1, 1, 0.5, 0), [0]),
        # Farther than half the diameter, or no pose at all: a miss and a false positive.
        ([(0.9, pose(0.061))], [(0, 1)], (1, 1, 0, 1), [math.inf]),
        ([(0.9, np.full((4, 4), math.nan))], [(0, 1)], (1, 1, 0, 1), [math.inf]),
        ([(0.9, np.full((4, 4), math.inf))], [(0, 1)], (1, 1, 0, 1), [math.inf]),
        # A hardly visible instance neither counts nor makes a false positive …
        ([(0.9, pose(0.3))], [(0, 0.1), (0.3, 0.0999)], (1, 0, None, 1), [math.inf]),
        # … but a second detection at its position is a false positive.
        ([(s, pose(0.3)) for s in (0.9, 0.8)], [(0, 0.1), (0.3, 0.0999)], (1, 1, 0, 1), [math.inf]),
        # An evaluated instance is matched before a hidden instance.
        ([(0.9, pose(0.01))], [(0.01, 0.05), (0, 0.9)], (1, 0, 1, 0), [0.01]),
    ],
)
def test_detections_are_matched_with_instances(detections, truths, counts, errors):
    found = [Detection("box", score, T) for score, T in detections]
    metric = measured((found, [truth("box", pose(x), visible) for x, visible in truths]))
    row = metric.compute()["box"]
    assert (row.num_instances, row.false_per_frame, row.precision, row.miss_rate) == counts
    assert metric.errors("box") == pytest.approx(errors)
    assert not any(isinstance(v, float) and math.isnan(v) for v in asdict(row).values())


@pytest.mark.parametrize(("diameter", "radius"), [(0.038, 0.019), (0.2, 0.1), (1.5, 0.1)])
def test_a_detection_matches_within_half_a_diameter_and_ten_centimetres(diameter, radius):
    near_and_far = ([Detection("box", 1, pose(x * radius))] for x in (0.999, 1.001))
    images = [(found, [truth("box", pose())]) for found in near_and_far]
    row = measured(*images, of=replace(part("box"), diameter=diameter)).compute()["box"]
    assert (row.matching_radius, row.miss_rate) == (radius, 0.5)


def test_the_distance_of_a_match_is_between_centres():
    # The origin is half a metre from the part, so a small rotation moves the centre far away.
    points = np.random.default_rng(0).uniform([0.45, -0.05, -0.05], [0.55, 0.05, 0.05], (50, 3))
    far = Part("far", cuboid_keypoints(points.min(0), points.max(0)), 0.1, points)
    turned = [Detection("far", 1, pose(0, (0, 0, 0.4)))]
    assert measured((turned, [truth("far", pose())]), of=far).compute()["far"].miss_rate == 1


def test_objects_do_not_match_each_other():
    metric = PoseMetrics([part("a"), part("b")])
    other = "got a detection of 'c'; allowed: detections of the evaluated"
    with pytest.raises(UserError, match=other):
        metric.update([Detection("c", 1, pose())], [])
    metric.update([Detection("a", 0.9, pose())], [truth("b", pose()), truth("other", pose())])
    rows = metric.compute()
    assert (rows["a"].num_instances, rows["a"].false_per_frame) == (0, 1)
    assert (rows["b"].num_instances, rows["b"].miss_rate) == (1, 1)


@pytest.mark.parametrize("names", [[], ["a", "a"], ["a", "mean"]])
def test_names_of_parts_must_be_distinct(names):
    with pytest.raises(UserError, match="one or more parts with distinct names"):
        PoseMetrics([part(name) for name in names])


@pytest.mark.filterwarnings("ignore:The ``compute`` method of metric PoseMetrics was called")
def test_misses_give_zero_and_an_empty_metric_gives_none():
    metric = PoseMetrics([part("box")])
    for row in metric.compute().values():
        assert row == PoseRow(row.object, "estimate", num_instances=0, false_per_frame=0)
    zeros = ("add_01d", "add_005d", "add_002d", "pass_5cm", "pass_10cm", "auc_10cm", "add_s_01d",
             "auc_s_10cm", "average_precision", "mssd_01d", "ar_mssd",
             "add_or_s_01d", "auc_or_s_10cm", "pass_5cm_5deg")  # fmt: skip
    expected = PoseRow("box", "estimate", 3, matching_radius=0.06, miss_rate=1.0, false_per_frame=0)
    missed = measured(*[([], [truth("box", pose())])] * 3)
    assert missed.compute()["box"] == replace(expected, **dict.fromkeys(zeros, 0.0))


def test_the_mean_excludes_objects_without_ground_truth():
    metric = PoseMetrics([part("a"), part("b"), part("c")])
    found = [Detection("a", 1, pose()), Detection("c", 1, pose())]
    metric.update(found, [truth("a", pose()), truth("b", pose())])
    rows = metric.compute()
    assert rows["c"].add_01d is None
    cells = {column.heading: column.text(rows["c"]) for column in shown_columns(rows["c"])}
    assert cells["ADD-0.1d %"] == "n/a"
    assert rows[MEAN].add_01d == 0.5
    assert rows[MEAN].median_rotation_deg == 0.0  # only a was matched
    assert (rows[MEAN].num_instances, rows[MEAN].false_per_frame) == (2, 1)
    assert json.loads(json.dumps(asdict(rows["c"]), allow_nan=False))["add_01d"] is None


def test_reset_pickle_and_copy():
    metric = measured(([Detection("box", 0.9, pose(0.01))], [truth("box", pose())]))
    for twin in (copy.deepcopy(metric), pickle.loads(pickle.dumps(metric))):
        assert twin.compute() == metric.compute()
    metric.reset()
    metric.update([], [truth("box", pose())])
    assert metric.compute()["box"].num_instances == 1
    assert metric.errors("box").tolist() == [math.inf]


def test_references_use_the_instances_that_count():
    metric = PoseMetrics([part("a"), part("b")])
    for angle in (0.0, 0.1, 0.2):
        metric.update([], [truth("a", pose(0, (0, 0, angle))), truth("a", pose(0.3), 0.01)])
    table = metric.references()
    assert list(table) == ["chance, all rotations", "chance, test range", "best constant pose"]
    for rows in table.values():
        assert rows["a"].num_instances == 3
        assert rows["b"].add_01d is None
        assert rows[MEAN].add_01d == rows["a"].add_01d


def test_mssd_uses_the_vertices_of_a_mesh():
    vertices = np.array([[0.1, 0, 0], [-0.1, 0, 0], [0, 0.1, 0]])
    box = replace(part("box"), mesh=Mesh(vertices, np.array([[0, 1, 2]], np.int32)))
    turned = [Detection("box", 1, pose(0, (0, 0, 0.2)))]
    metric = measured((turned, [truth("box", pose())]), of=box)
    assert metric.errors("box", "mssd") == pytest.approx([2 * np.sin(0.1) * 0.1])


def test_mspd_needs_every_camera():
    image = [Detection("box", 1, pose())], [truth("box", pose())]
    metric = measured((*image, K, 640))
    assert metric.compute()["box"].ar_mspd == 1
    metric.update(*image)
    assert metric.compute()["box"].ar_mspd is None
    for camera, width in ((K, None), (None, 640), (K[:2], 640), (K * np.nan, 640), (K, 0)):
        with pytest.raises(ValueError, match="K must be"):
            metric.update([], [], camera, width)


STRAY, MISSED = "stray", "missed"


@pytest.mark.parametrize(
    ("images", "expected"),
    [
        # Half of the recall at precision 1; 51 of the 101 recalls are at most 0.5.
        ([(0.9, 0.0), (0.0, MISSED)], 51 / 101),
        ([(0.0, MISSED), (0.0, MISSED)], 0),
        # A matched pose with an error above 12 mm is wrong, and so is a stray detection.
        ([(0.9, 0.013), (0.8, 0.0119)], 51 / 101 * 0.5),
        ([(0.9, STRAY), (0.8, 0.0)], 0.5),
        ([(0.8, 0.0), (0.7, STRAY)], 1),
        # Of equal scores, the wrong detection comes first in any order of the images.
        ([(0.5, 0.0), (0.5, STRAY)], 0.5),
        ([(0.5, STRAY), (0.5, 0.0)], 0.5),
        ([(math.nan, 0.0), (0.1, STRAY)], 0.5),
    ],
)
def test_average_precision_by_hand(images, expected):
    """Each image has a score and an error in metres."""
    metric = PoseMetrics([part("box")])
    for score, error in images:
        shift = error if isinstance(error, float) else 0.0
        result = [] if error is MISSED else [Detection("box", score, pose(shift))]
        metric.update(result, [] if error is STRAY else [truth("box", pose())])
    assert metric.compute()["box"].average_precision == pytest.approx(expected)


def test_precision_and_false_detections_count_in_frames():
    """Ten images with six correct poses and one wrong pose, and two detections without the part."""
    metric = PoseMetrics([replace(part("box"), symmetries_discrete=FLIP[None])])
    for number in range(10):
        result = [] if number > 6 else [Detection("box", 0.9, pose() @ FLIP)]
        truths = [truth("box", pose(0.058 if number == 6 else 0))] if number < 9 else []
        metric.update(result, truths)
    metric.update([Detection("box", s, pose()) for s in (0.5, 0.4)], [])
    row = metric.compute()["box"]
    assert (row.precision, row.false_per_frame) == (pytest.approx(6 / 9), pytest.approx(2 / 11))
    assert row.add_or_s_01d == pytest.approx(6 / 9)


def test_a_duplicate_lowers_average_precision_and_an_ignored_pose_does_not():
    twice, once = ([Detection("box", s, pose()) for s in scores] for scores in ((0.9, 0.8), (0.7,)))
    metric = measured((twice, [truth("box", pose())]), (once, [truth("box", pose())]))
    # Right, wrong, right: precision 1 up to recall 0.5, then 2/3.
    expected = (51 + 50 * 2 / 3) / 101
    assert metric.compute()["box"].average_precision == pytest.approx(expected)
    metric.update([Detection("box", 0.99, pose(0.3))], [truth("box", pose(0.3), 0.01)])
    assert metric.compute()["box"].average_precision == pytest.approx(expected)


def test_plot_shows_one_curve_per_object():
    metric = PoseMetrics([part("a"), part("b")], method="DOPE++")
    metric.update([Detection("a", 1, pose(0.05))], [truth("a", pose()), truth("b", pose())])
    figure, axes = metric.plot()
    assert figure.axes == [axes]
    for legend in (axes.get_legend(), metric.plot("mssd")[1].get_legend()):
        labels = [text.get_text() for text in legend.get_texts()]
        assert labels == ["a (AUC 50.0 %)", "b (AUC 0.0 %)"]
