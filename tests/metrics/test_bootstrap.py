"""The paired bootstrap against scipy's, closed forms and simulated comparisons."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import bootstrap, norm, t

from dopepp.core.errors import UserError
from dopepp.metrics.bootstrap import STATISTICS, fewest_differing, seeds_needed
from dopepp.metrics.bootstrap import paired_difference as difference

Z = norm.ppf(0.975)


@pytest.mark.parametrize(("name", "reference"), [("mean", np.mean), ("median", np.median)])
def test_with_one_seed_it_is_scipys_paired_percentile_bootstrap(name, reference):
    rng = np.random.default_rng(11)
    mine, other = rng.gamma(2, 5, 121), rng.gamma(2, 6, 121)
    mine = 0.6 * mine + 0.4 * other
    result = difference([mine[None]], [other[None]], name, num_resamples=20_000, seed=5)
    expected = bootstrap(
        (mine, other),
        lambda x, y, axis=-1: reference(x, axis=axis) - reference(y, axis=axis),
        paired=True, n_resamples=20_000, method="percentile", confidence_level=0.95,
        rng=np.random.default_rng(6),
    ).confidence_interval  # fmt: skip
    assert result.value == pytest.approx(reference(mine) - reference(other), abs=1e-12)
    width = expected.high - expected.low
    assert result.low == pytest.approx(expected.low, abs=0.04 * width)
    assert result.high == pytest.approx(expected.high, abs=0.04 * width)


def test_seeds_and_instances_add_their_variances():
    """Crossed resampling of S seeds and N instances: the closed form of its variance."""
    rng = np.random.default_rng(3)
    num_seeds, num = 12, 400
    d = rng.normal(0, 1.0, num) + rng.normal(0, 0.15, (num_seeds, 1))
    d = d + rng.normal(0, 0.8, (num_seeds, num))
    base = rng.normal(size=(num_seeds, num))
    result = difference([base + d], [base], few_seeds=False, num_resamples=12_000)
    by_seed, by_instance = d.mean(axis=1), d.mean(axis=0)
    rest = d - by_seed[:, None] - by_instance + d.mean()
    variance = by_instance.var() / num + by_seed.var() / num_seeds + rest.var() / (num_seeds * num)
    assert (result.high - result.low) / 2 == pytest.approx(Z * np.sqrt(variance), rel=0.06)


@pytest.mark.parametrize("num_seeds", [2, 3, 5])
def test_intervals_of_few_seeds_are_wide_enough(num_seeds):
    rng, hits = np.random.default_rng(8), 0
    for trial in range(150):
        noise = rng.normal(0, 0.1, (2, num_seeds))[:, :, None]
        mine, other = rng.normal(0, 0.05, (2, num_seeds, 40)) + noise
        result = difference([mine + 0.05], [other], num_resamples=400, seed=trial)
        hits += result.low <= 0.05 <= result.high
    assert hits > 0.9 * 150


@given(
    seed=st.integers(0, 10_000), num=st.integers(1, 30), seeds=st.integers(1, 3),
    name=st.sampled_from(["mean", "median"]), same=st.booleans(),
)  # fmt: skip
def test_exchanging_the_methods_negates_the_interval(seed, num, seeds, name, same):
    rng = np.random.default_rng(seed)
    mine, other = rng.integers(0, 4, (2, seeds, num)).astype(float)
    options = {"same_seeds": True, "num_resamples": 200, "seed": seed}
    option = difference([mine], [other], name, **options)
    back = difference([other], [mine], name, **options)
    assert (option.low, option.high) == pytest.approx((-back.high, -back.low), abs=1e-9)
    assert (option.value, option.num_differing) == (-back.value, back.num_differing)
    assert option == difference([mine], [other], name, **options)
    itself = difference([mine], [mine], name, same_seeds=same)
    assert (itself.value, itself.within_noise, itself.num_differing) == (0, True, 0)


@given(values=st.lists(st.floats(0, 180) | st.just(np.inf) | st.just(np.nan), min_size=1))
def test_the_median_is_of_the_finite_numbers(values):
    finite = [value for value in values if np.isfinite(value)]
    result = STATISTICS["median"](np.array([values, values]))
    expected = np.median(finite) if finite else np.nan
    np.testing.assert_allclose(result, [expected, expected], rtol=1e-12)


def test_a_median_over_misses_is_undefined():
    hit, missed = np.full((1, 9), 5.0), np.full((1, 9), np.inf)
    assert difference([hit], [missed], "median") is None
    # The overall median is undefined if one seed has no finite number.
    half = np.concatenate([hit, missed])
    assert difference([half], [np.concatenate([hit, hit])], "median") is None


def test_resamples_without_finite_numbers_are_ignored():
    mine = np.array([[3.0, np.inf, np.inf, np.inf]])
    result = difference([mine], [np.full((1, 4), 5.0)], "median", num_resamples=500)
    assert (result.value, result.low, result.high) == (-2, -2, -2)
    assert result.within_noise  # four differing instances are too few


@pytest.mark.parametrize("num", [1, 5, 6])
def test_fewer_than_six_differing_instances_are_not_significant(num):
    other = np.zeros((1, 50))
    mine = other.copy()
    mine[0, :num] = 1
    result = difference([mine], [other])
    assert (result.num_differing, result.fewest) == (num, 6)
    assert result.within_noise == (num < 6)
    item = difference([mine[:, :1]], [other[:, :1]])
    assert (item.low, item.high, item.within_noise) == (1, 1, True)


def test_the_fewest_differing_instances_follow_from_the_sign_test():
    for confidence in (0.5, 0.8, 0.95, 0.99, 0.999):
        fewest = fewest_differing(confidence)
        assert 2 * 0.5**fewest <= 1 - confidence + 1e-12 < 2 * 0.5 ** (fewest - 1) + 1e-12


def test_objects_have_equal_weights():
    rng = np.random.default_rng(1)
    a, b = rng.random((2, 2, 30)), rng.random((2, 2, 300))
    result = difference([a[0], b[0]], [a[1], b[1]])
    expected = ((a[0] - a[1]).mean() + (b[0] - b[1]).mean()) / 2
    assert result.value == pytest.approx(expected, abs=1e-12)
    alone = difference([a[0]], [a[1]])
    assert result.high - result.low < alone.high - alone.low


def test_pairs_of_seeds_cancel_shared_effects():
    rng = np.random.default_rng(4)
    shared = rng.normal(0, 1, (4, 1))
    mine, other = shared + 0.2 + rng.normal(0, 0.01, (2, 4, 100))
    paired = difference([mine], [other])
    loose = difference([mine], [other], same_seeds=False)
    difference([mine], [other[:1]], same_seeds=False)  # of other numbers of seeds
    assert loose.high - loose.low > 10 * (paired.high - paired.low)
    assert loose.value == pytest.approx(paired.value, abs=1e-12)


PASSES = np.array([[0.0, 1.0, 1.0]])
TWICE = np.concatenate([PASSES, PASSES])


@pytest.mark.parametrize(
    ("mine", "baseline", "message"),
    [
        ([PASSES], [PASSES[:, :2]], "same instances"),
        ([PASSES[:, :0]], [PASSES[:, :0]], "same instances"),
        ([PASSES[0]], [PASSES[0]], "seeds, instances"),
        ([PASSES], [PASSES, PASSES], "for each object"),
        ([], [], "for each object"),
        ([PASSES, TWICE], [PASSES, PASSES], "for each object"),
        ([TWICE], [PASSES], "2 seeds against 1"),
        ([PASSES], [PASSES + np.inf], "not finite"),
    ],
)
def test_values_that_cannot_be_paired_are_a_user_error(mine, baseline, message):
    with pytest.raises(UserError, match=message):
        difference(mine, baseline)


@given(st.floats(0.005, 0.1), st.floats(0.001, 0.2), st.floats(0, 0.02), st.integers(2, 6))
def test_the_estimated_number_of_seeds_makes_a_difference_significant(gain, spread, noise, seeds):
    """With this number of seeds, the interval for known spreads just excludes 0."""
    rng = np.random.default_rng(4)
    over_seeds, over_images = rng.normal(size=seeds), rng.normal(size=50)
    over_seeds = spread * (over_seeds - over_seeds.mean()) / over_seeds.std(ddof=1)
    over_images = noise * (over_images - over_images.mean()) / over_images.std(ddof=1)
    mine = 0.5 + gain + over_seeds[:, None] + over_images
    asked = seeds_needed([mine], [np.full_like(mine, 0.5)])

    def reach(num):
        of_seeds = t.ppf(0.975, num - 1) ** 2 * spread**2 / num
        return np.sqrt(Z**2 * noise**2 / 50 + of_seeds)

    if asked == np.inf:
        assert Z * noise / np.sqrt(50) >= gain * (1 - 1e-9)
    else:
        assert asked > seeds
        assert reach(asked) < gain * (1 + 1e-9)
        assert asked == seeds + 1 or reach(asked - 1) >= gain * (1 - 1e-9)


def test_seeds_cannot_replace_images():
    mine, other = np.zeros((3, 10)), np.zeros((3, 10))
    mine[:, 0] = 1
    assert seeds_needed([mine], [other]) == np.inf
    assert difference([mine], [other]).seeds_needed == np.inf
    assert difference([mine[:1]], [other[:1]]).seeds_needed is None
