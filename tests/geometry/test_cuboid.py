import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from dopepp.geometry.cuboid import EDGES, cuboid_keypoints

LEFT_AND_RIGHT = [(1, -1), (-1, -1), (-1, 1), (1, 1)]
NDDS_ORDER = np.array([(*xy, z) for z in (1, -1) for xy in LEFT_AND_RIGHT] + [(0, 0, 0)])


@pytest.mark.parametrize("thickness", [0.007, 0.0])
def test_a_box_off_the_origin_has_its_keypoints_in_ndds_order(thickness):
    lower, upper = np.array([0.1, -0.2, 0.3]), np.array([0.4, 0.0, 0.3 + thickness])
    keypoints = cuboid_keypoints(lower, upper)
    assert_allclose(keypoints[8], (lower + upper) / 2)
    assert_allclose(keypoints[:8].min(0), lower)
    assert_allclose(keypoints[:8].max(0), upper)
    assert_array_equal(np.sign(keypoints - keypoints[8]), NDDS_ORDER * np.sign(upper - lower))


def test_edges_are_the_twelve_of_a_box():
    sides = np.array([0.2, 0.3, 0.5])
    keypoints = cuboid_keypoints(np.zeros(3), sides)
    edges = np.array([keypoints[b] - keypoints[a] for a, b in EDGES])
    assert len(set(EDGES)) == 12
    assert ((edges != 0).sum(1) == 1).all()
    assert_allclose(np.sort(np.abs(edges).sum(1)), np.repeat(sides, 4))


@pytest.mark.parametrize(
    ("lower", "upper"),
    [([0, 0, 1], [1, 1, 0]), ([0, 0, np.nan], [1, 1, 1]), ([0] * 3, [np.inf] * 3)],
)
def test_bad_bounds(lower, upper):
    with pytest.raises(ValueError, match="finite with lower <= upper"):
        cuboid_keypoints(np.array(lower), np.array(upper))
