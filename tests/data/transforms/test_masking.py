import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dopepp.data.sample import Instance, Sample, silhouette
from dopepp.data.transforms.masking import RandomMask

SIZE = (60, 80)


class Stripes:
    """Another picture that is told from any other by its colours 200 and 220."""

    calls = 0

    def draw(self, rng: np.random.Generator, width: int, height: int) -> np.ndarray:
        self.calls += 1
        picture = np.full((height, width, 3), 200, np.uint8)
        picture[:, ::2] = 220
        return picture


class Solid:
    def draw(self, rng: np.random.Generator, width: int, height: int) -> np.ndarray:
        return np.full((height, width, 3), 9, np.uint8)


def sample_of(*masks: np.ndarray, contrast: bool = True, seed: int = 0) -> Sample:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 190 if contrast else 1, (*SIZE, 3), np.uint8)
    for mask in masks:
        image[mask] = (255, 0, 255)  # a colour that no background has
    instances = [
        Instance("box", np.eye(4), np.full((9, 2), np.nan), 0.8, mask.copy()) for mask in masks
    ]
    return Sample(image, np.eye(3), instances)


def ellipse(row: float, column: float, height: float, width: float) -> np.ndarray:
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    return ((rows - row) / height) ** 2 + ((columns - column) / width) ** 2 <= 1


def box_of(mask: np.ndarray) -> tuple[int, int, int, int]:
    rows, columns = np.nonzero(mask)
    return rows.min(), rows.max() + 1, columns.min(), columns.max() + 1


@settings(max_examples=80)
@given(
    st.builds(ellipse, st.floats(5, 55), st.floats(5, 75), st.floats(3, 25), st.floats(3, 30)),
    st.floats(0.1, 1.0),
    st.integers(0, 10_000),
)
def test_bounds_share_and_origin_of_the_patch(mask, limit, seed):
    sample = sample_of(mask, seed=seed)
    before = sample.image.copy()
    result = RandomMask(1.0, limit, limit)(sample, np.random.default_rng(seed), Stripes())
    np.testing.assert_array_equal(sample.image, before)
    (instance,) = result.instances
    top, bottom, left, right = box_of(mask)
    if min(int(limit * (bottom - top)), int(limit * (right - left))) < 2:
        np.testing.assert_array_equal(result.image, before)
        return
    # The object's colour occurs nowhere else, so what is gone from it was covered.
    gone = mask & (result.image != (255, 0, 255)).any(axis=2)
    assert instance.masked_fraction == np.count_nonzero(gone) / np.count_nonzero(mask)
    assert instance.visible_fraction == pytest.approx(0.8 * (1 - instance.masked_fraction))
    np.testing.assert_array_equal(instance.mask, mask & ~gone)
    changed = (result.image != before).any(axis=2)
    if changed.any():
        first, last, start, stop = box_of(changed)
        assert top <= first < last <= bottom
        assert left <= start < stop <= right
        assert last - first <= limit * (bottom - top)
        assert stop - start <= limit * (right - left)
        # Background never holds the object's colour, neither does another picture.
        patch = result.image[first:last, start:stop]
        assert (patch != (255, 0, 255)).any(axis=2).all()
        assert patch.reshape(-1, 3).std(axis=0).max() > 0


def test_unless_told_otherwise_a_patch_has_at_most_the_papers_share_of_the_box():
    """Equation 4: 0.8 of the height and 0.8 of the width."""
    mask = np.zeros(SIZE, bool)
    mask[10:50, 20:70] = True
    sizes = []
    for seed in range(100):
        result = RandomMask(1.0)(sample_of(mask), np.random.default_rng(seed), Stripes())
        first, last, start, stop = box_of((result.image != (255, 0, 255)).any(axis=2) & mask)
        sizes.append((last - first, stop - start))
    assert np.max(sizes, axis=0).tolist() == [32, 40]


def test_the_crop_is_a_piece_of_the_own_background():
    mask = ellipse(30, 40, 12, 12)
    sample, other = sample_of(mask), Stripes()
    result = RandomMask(1.0)(sample, np.random.default_rng(3), other)
    assert other.calls == 0
    first, last, start, stop = box_of((result.image != sample.image).any(axis=2))
    patch = result.image[first:last, start:stop]
    windows = np.lib.stride_tricks.sliding_window_view(sample.image, patch.shape)[:, :, 0]
    places = np.argwhere((windows == patch).all(axis=(2, 3, 4)))
    assert len(places) == 1
    row, column = places[0]
    assert not mask[row : row + last - first, column : column + stop - start].any()


def test_where_no_window_fits_a_smaller_one_of_the_own_background_is_taken():
    # Three columns of background are left: no patch of this part is so narrow.
    mask = np.ones(SIZE, bool)
    mask[:, :3] = False
    own = {tuple(pixel) for pixel in sample_of(mask).image[~mask]}
    for seed in range(20):
        sample, other = sample_of(mask), Stripes()
        result = RandomMask(1.0)(sample, np.random.default_rng(seed), other)
        changed = (result.image != sample.image).any(axis=2)
        assert other.calls == 0
        assert {tuple(pixel) for pixel in result.image[changed]} <= own
        assert result.instances[0].masked_fraction > 0
        assert not changed[~mask].any()


def test_a_part_that_fills_the_frame_takes_another_picture():
    sample, other = sample_of(np.ones(SIZE, bool)), Stripes()
    result = RandomMask(1.0)(sample, np.random.default_rng(0), other)
    assert other.calls == 1
    changed = (result.image != sample.image).any(axis=2)
    assert set(np.unique(result.image[changed])) <= {200, 220}
    assert result.instances[0].masked_fraction == changed.mean()


def test_a_solid_background_is_never_pasted():
    sample, other = sample_of(ellipse(30, 40, 12, 12), contrast=False), Stripes()
    result = RandomMask(1.0)(sample, np.random.default_rng(0), other)
    assert other.calls >= 1
    assert result.instances[0].masked_fraction > 0
    untouched = RandomMask(1.0)(sample, np.random.default_rng(0), Solid())
    np.testing.assert_array_equal(untouched.image, sample.image)
    assert untouched.instances[0].masked_fraction == 0


def test_a_patch_counts_for_every_instance_it_covers():
    left, right = ellipse(30, 30, 20, 15), ellipse(30, 45, 20, 15)
    right &= ~left
    sample = sample_of(left, right)
    result = RandomMask(1.0)(sample, np.random.default_rng(1), Stripes())
    gone = (result.image != (255, 0, 255)).any(axis=2)
    for mask, instance in zip((left, right), result.instances, strict=True):
        assert instance.masked_fraction == (gone & mask).sum() / mask.sum()


def test_probability_and_empty_masks():
    sample = sample_of(ellipse(30, 40, 12, 12))
    hits = [
        RandomMask(0.3)(sample, np.random.default_rng(seed), Stripes()).instances[0].masked_fraction
        for seed in range(400)
    ]
    assert 0.22 < np.count_nonzero(hits) / 400 < 0.38
    hidden = sample_of(np.zeros(SIZE, bool))
    masked = RandomMask(1.0)(hidden, np.random.default_rng(0), Stripes())
    assert masked.instances[0] == hidden.instances[0]


def test_without_a_mask_the_cuboids_hull_stands_in(fake_source):
    sample = fake_source().sample(0)
    instance = sample.instances[0]
    instance.mask = None
    hull = silhouette(instance, sample.image.shape[:2])
    result = RandomMask(1.0)(sample, np.random.default_rng(0), Stripes())
    changed = (result.image != sample.image).any(axis=2)
    assert result.instances[0].mask is None
    share = result.instances[0].masked_fraction
    assert share == pytest.approx((changed & hull).sum() / hull.sum(), abs=0.01)
    np.testing.assert_array_equal(result.instances[0].keypoints, instance.keypoints)


@pytest.mark.parametrize("field", ["probability", "max_height", "max_width"])
def test_shares_outside_0_to_1_are_refused(field):
    with pytest.raises(ValueError, match=f"{field}=1.5"):
        RandomMask(**{field: 1.5})
