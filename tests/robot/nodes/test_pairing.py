"""Pairing of images by their stamps: nearest stamps, lag, order, rates and restarts."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dopepp.robot.nodes.image_queue import WAITING, StampPairing

MAX_LAG = 0.016


def paired(pairing, images):
    """Add (camera, stamp) pairs in order of arrival; return the sets of stamps."""
    sets = [pairing.add(camera, stamp, stamp) for camera, stamp in images]
    return [complete for complete in sets if complete is not None]


@st.composite
def arrivals(draw, periods, delay_s):
    """Return cameras' (camera, stamp) in order of arrival, with jitter, losses and delays."""
    images = []
    for camera, period in enumerate(periods):
        phase = draw(st.floats(0, period))
        for number in range(draw(st.integers(2, 12))):
            if draw(st.integers(0, 5)):  # otherwise lost
                stamp = 5.0 + phase + period * number + draw(st.floats(0, 0.05 * period))
                images.append((stamp + draw(st.floats(0, delay_s)), camera, stamp))
    return [(camera, stamp) for _, camera, stamp in sorted(images)]


@given(st.lists(st.sampled_from([0.02, 0.033, 0.1]), min_size=2, max_size=3).flatmap(
    lambda periods: arrivals(periods, 0.2).map(lambda images: (len(periods), images))
))  # fmt: skip
def test_sets_are_within_the_lag_and_ordered_whatever_arrives(case):
    num_cameras, images = case
    pairing = StampPairing(num_cameras, MAX_LAG)
    sets = paired(pairing, images)
    for stamps in sets:
        assert len(stamps) == num_cameras
        assert max(stamps) - min(stamps) <= MAX_LAG
    for before, after in pairwise(sets):
        assert max(before) < min(after)  # each image is used once
    for camera in range(num_cameras):
        sent = {stamp for number, stamp in images if number == camera}
        assert {stamps[camera] for stamps in sets} <= sent
    assert pairing.num_sets == len(sets)


@given(arrivals([0.04, 0.1], 0.0))
def test_images_in_order_are_paired_with_their_nearest(images):
    """The oracle compares all pairs. The lag is below half of both frame periods with jitter."""
    lag = 0.45 * 0.04 * 0.95
    fast, slow = ([stamp for number, stamp in images if number == camera] for camera in (0, 1))
    expected = []
    for stamp in slow:
        nearest = min(fast, key=lambda other: abs(other - stamp), default=-1.0)
        if abs(nearest - stamp) <= lag:
            expected.append([nearest, stamp])
    pairing = StampPairing(2, lag)
    assert paired(pairing, images) == expected
    assert pairing.dropped <= len(slow) - len(expected)


@given(
    st.permutations([(camera, 1 + 0.1 * n + 0.01 * camera) for camera in (0, 1) for n in (0, 1, 2)])
)
def test_the_newest_moment_is_paired_in_any_order_of_arrival(images):
    pairing = StampPairing(2, MAX_LAG)
    assert paired(pairing, images)[-1] == [pytest.approx(1.2), pytest.approx(1.21)]


def test_sets_beyond_the_lag_are_dropped_and_counted():
    pairing = StampPairing(2, MAX_LAG)
    images = [(camera, 1.0 + 0.1 * n + 0.05 * camera) for n in range(12) for camera in (0, 1)]
    assert paired(pairing, images) == []
    assert pairing.dropped == pairing.dropped_in_a_row == 11
    assert pairing.lag_s == pytest.approx(0.05)
    assert paired(pairing, [(0, 2.2), (1, 2.201)]) == [[2.2, 2.201]]
    assert (pairing.dropped_in_a_row, pairing.lag_s) == (0, pytest.approx(0.001))


def test_further_images_of_a_faster_camera_are_no_dropped_sets():
    pairing = StampPairing(2, MAX_LAG)
    images = [(0, 1.0 + 0.03 * n) for n in range(30)] + [(1, 1.0 + 0.09 * n) for n in range(10)]
    assert len(paired(pairing, sorted(images, key=lambda image: image[::-1]))) == 10
    assert pairing.dropped == 0


def test_images_of_a_silent_partner_are_not_stored_and_a_restart_is_paired():
    pairing = StampPairing(2, MAX_LAG)
    assert paired(pairing, [(0, 100.0 + n) for n in range(5 * WAITING)]) == []
    assert pairing.dropped == 0
    late = paired(pairing, [(1, 100.0 + n) for n in range(5 * WAITING)])
    assert late == [[100.0 + n] * 2 for n in range(4 * WAITING, 5 * WAITING)]
    assert paired(pairing, [(0, 7.0), (1, 7.01)]) == [[7.0, 7.01]]  # a recording starts again
