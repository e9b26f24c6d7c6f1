"""Patches of random masks and of the shading protocol, compared with brute force."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dopepp.data.formats.ycb_video.ycb_reader import YcbVideoReader
from dopepp.data.sample import Instance, Sample, silhouette
from dopepp.data.transforms.masking import RandomMask
from dopepp.data.transforms.shading_protocol import TOLERANCE, shade
from dopepp.parts.mesh.read import ycb_part

SIZE, UNKNOWN = (72, 96), np.full((9, 2), np.nan)


class Stripes:
    """Background images of the colours 200 and 220, which no other image has."""

    calls = 0

    def draw(self, rng: np.random.Generator, width: int, height: int) -> np.ndarray:
        self.calls += 1
        image = np.full((height, width, 3), 200, np.uint8)
        image[:, ::2] = 220
        return image


class Solid:
    def draw(self, rng: np.random.Generator, width: int, height: int) -> np.ndarray:
        return np.full((height, width, 3), 9, np.uint8)


def sample_of(*masks: np.ndarray, contrast: bool = True, seed: int = 0) -> Sample:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 190 if contrast else 1, (*SIZE, 3), np.uint8)
    for mask in masks:
        image[mask] = (255, 0, 255)  # a colour that no background has
    instances = [Instance("box", np.eye(4), UNKNOWN, 0.8, mask.copy()) for mask in masks]
    return Sample(image, np.eye(3), instances)


def ellipse(row: float, column: float, height: float, width: float) -> np.ndarray:
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    return ((rows - row) / height) ** 2 + ((columns - column) / width) ** 2 <= 1


def box_of(mask: np.ndarray) -> tuple[int, int, int, int]:
    rows, columns = np.nonzero(mask)
    return rows.min(), rows.max() + 1, columns.min(), columns.max() + 1


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
    # The object's colour occurs only on the object, so its missing pixels are covered.
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
        # Neither the background nor another image has the object's colour.
        patch = result.image[first:last, start:stop]
        assert (patch != (255, 0, 255)).any(axis=2).all()
        assert patch.reshape(-1, 3).std(axis=0).max() > 0


def test_the_default_limits_of_a_patch_are_the_papers():
    """Equation 4: 0.8 of the height and 0.8 of the width."""
    mask = np.zeros(SIZE, bool)
    mask[10:50, 20:70] = True
    sizes = []
    for seed in range(100):
        result = RandomMask(1.0)(sample_of(mask), np.random.default_rng(seed), Stripes())
        first, last, start, stop = box_of((result.image != (255, 0, 255)).any(axis=2) & mask)
        sizes.append((last - first, stop - start))
    assert np.max(sizes, axis=0).tolist() == [32, 40]


def test_the_crop_comes_from_the_images_background():
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


def test_the_crop_shrinks_to_fit_the_background():
    # The background has three columns, and every patch of this part is wider.
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


def test_a_part_that_fills_the_frame_is_covered_with_another_image():
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


def test_a_patch_reduces_every_instance_that_it_covers():
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


def test_without_a_mask_the_hull_of_the_cuboid_is_used(fake_source):
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


OBJECT_BLUE = 255
# Shuffled, so that every crop has contrast.
ROWS, COLUMNS = (np.random.default_rng(length).permutation(length) for length in SIZE)
SHARES = (0.2, 0.4, 0.6, 0.8)


def addressed(*masks: np.ndarray) -> Sample:
    """An image whose background pixels encode their row (red) and column (green)."""
    rows, columns = np.meshgrid(ROWS, COLUMNS, indexing="ij")
    image = np.stack([rows, columns, np.zeros_like(rows)], axis=2).astype(np.uint8)
    for mask in masks:
        image[mask, 2] = OBJECT_BLUE
    instances = [Instance("box", np.eye(4), UNKNOWN, 0.7, mask.copy()) for mask in masks]
    return Sample(image, np.eye(3), instances, np.ones(SIZE, np.float32))


def is_object(image: np.ndarray) -> np.ndarray:
    return np.asarray(image[..., 2] == OBJECT_BLUE)


def source_of(pixels: np.ndarray) -> np.ndarray:
    """Return the source row and column of pasted background pixels."""
    return np.column_stack([np.argsort(ROWS)[pixels[:, 0]], np.argsort(COLUMNS)[pixels[:, 1]]])


@given(
    st.builds(ellipse, st.floats(10, 60), st.floats(10, 80), st.floats(5, 25), st.floats(5, 30)),
    st.floats(0, 1),
    st.integers(0, 10_000),
)
def test_the_share_is_reached_inside_the_box(mask, share, seed):
    sample = addressed(mask)
    before = sample.image.copy()
    (shaded,) = shade(sample, [share], seed, 3)
    np.testing.assert_array_equal(sample.image, before)
    left = is_object(shaded.sample.image)
    covered = np.count_nonzero(mask & ~left) / np.count_nonzero(mask)
    assert shaded.reached == (covered,)
    assert abs(covered - share) <= 0.5 / np.count_nonzero(mask) + 1e-12
    top, bottom, start, stop = box_of(mask)
    outside = np.ones(SIZE, bool)
    outside[top:bottom, start:stop] = False
    np.testing.assert_array_equal(shaded.sample.image[outside], before[outside])

    (instance,) = shaded.sample.instances
    np.testing.assert_array_equal(instance.mask, mask & left)
    assert instance.masked_fraction == covered
    assert instance.visible_fraction == pytest.approx(0.7 * (1 - covered))
    # Depth is unknown under a patch.
    assert not shaded.sample.depth[mask & ~left].any()
    assert shaded.sample.depth[left].all()


@pytest.mark.parametrize("seed", range(5))
def test_patches_are_several_crops_of_the_images_background(seed):
    mask = ellipse(36, 40, 20, 28)
    sample = addressed(mask)
    (shaded,) = shade(sample, [0.8], seed, 0)
    changed = (shaded.sample.image != sample.image).any(axis=2)
    rows, columns = np.nonzero(changed)
    pasted = shaded.sample.image[changed]
    source = source_of(pasted)
    assert (pasted[:, 2] == 0).all()
    assert not mask[source[:, 0], source[:, 1]].any()
    # All pixels of a crop have the same offset from their source.
    offsets = source - np.column_stack([rows, columns])
    patches = np.unique(offsets, axis=0)
    assert len(patches) >= 3
    top, bottom, start, stop = box_of(mask)
    for offset in patches:
        place = (offsets == offset).all(axis=1)
        assert np.ptp(rows[place]) + 1 <= 0.5 * (bottom - top)
        assert np.ptp(columns[place]) + 1 <= 0.5 * (stop - start)


def test_a_larger_share_contains_a_smaller_share():
    sample = addressed(ellipse(36, 40, 20, 28))
    together = shade(sample, SHARES, 5, 7)
    for share, first in zip(SHARES, together, strict=True):
        (alone,) = shade(sample, [share], 5, 7)
        np.testing.assert_array_equal(alone.sample.image, first.sample.image)
        assert alone.reached == first.reached
    for less, more in pairwise(together):
        changed = (less.sample.image != sample.image).any(axis=2)
        np.testing.assert_array_equal(more.sample.image[changed], less.sample.image[changed])
    for seed, index in ((6, 7), (5, 8)):
        other = shade(sample, SHARES, seed, index)
        assert (other[1].sample.image != together[1].sample.image).any()


@given(
    masks=st.lists(
        st.tuples(st.floats(15, 55), st.floats(20, 75), st.floats(6, 18), st.floats(6, 20)),
        min_size=2, max_size=5,
    ),
    seed=st.integers(0, 10_000),
)  # fmt: skip
def test_every_instance_is_covered_by_its_own_patches_alone(masks, seed):
    taken, visible = np.zeros(SIZE, bool), []
    for one in masks:  # the first lies in front
        visible.append(ellipse(*one) & ~taken)
        taken |= visible[-1]
    sample = addressed(*visible)
    for shaded in shade(sample, SHARES, seed, 0):
        left = is_object(shaded.sample.image)
        for mask, reached in zip(visible, shaded.reached, strict=True):
            if reached is None:
                assert not mask.any()
                continue
            assert reached == np.count_nonzero(mask & ~left) / np.count_nonzero(mask)
            if min(np.ptp(np.argwhere(mask), axis=0)) > 2 and np.count_nonzero(mask) >= 25:
                assert abs(reached - shaded.share) <= TOLERANCE


def test_instances_without_visible_pixels_are_not_shaded():
    mask = ellipse(36, 30, 15, 15)
    sample = addressed(mask, np.zeros(SIZE, bool))
    corners = np.array([[60, 20], [90, 20], [60, 60], [90, 60]] * 2 + [[75, 40]], np.float64)
    sample.instances.append(Instance("unlabelled", np.eye(4), corners, 0.5))
    (shaded,) = shade(sample, [0.6], 0, 0)
    assert shaded.reached[0] == pytest.approx(0.6, abs=TOLERANCE)
    assert shaded.reached[1:] == (None, None)
    assert shaded.sample.instances[1:] == sample.instances[1:]
    # Crops avoid the hull of the unlabelled object, too.
    pasted = shaded.sample.image[mask & ~is_object(shaded.sample.image)]
    taken_from = source_of(pasted)
    inside = (taken_from[:, 0] >= 20) & (taken_from[:, 0] <= 60)
    assert not (inside & (taken_from[:, 1] >= 60) & (taken_from[:, 1] <= 90)).any()


def test_a_solid_background_covers_nothing():
    sample = addressed(ellipse(36, 40, 20, 28))
    sample.image[~is_object(sample.image)] = 9
    (shaded,) = shade(sample, [0.4], 0, 0)
    np.testing.assert_array_equal(shaded.sample.image, sample.image)
    assert shaded.reached == (0.0,)


def test_a_small_background_gives_smaller_crops_and_a_gradient_has_contrast():
    mask = np.ones(SIZE, bool)
    mask[:, :6] = mask[:6] = False
    smooth = addressed(seen := ellipse(36, 40, 8, 12))
    smooth.image[~seen] = np.arange(SIZE[1])[None, :, None].repeat(SIZE[0], 0)[~seen]
    for sample, share in ((addressed(mask), 0.2), (smooth, 0.6)):
        (shaded,) = shade(sample, [share], 0, 0)
        assert shaded.reached[0] == pytest.approx(share, abs=TOLERANCE)


def test_the_only_crops_with_contrast_are_found():
    sample = addressed(mask := ellipse(30, 30, 20, 20))
    sample.image[~mask] = 77
    sample.image[60:72, 84:96] = np.random.default_rng(0).integers(0, 200, (12, 12, 3))
    (shaded,) = shade(sample, [0.6], 0, 0)
    assert shaded.reached[0] == pytest.approx(0.6, abs=TOLERANCE)
    pasted = shaded.sample.image[mask & ~is_object(shaded.sample.image)]
    assert (pasted != 77).any(axis=1).sum() > 20


def test_real_frames_are_shaded_to_the_share(ycb_root):
    names = ["003_cracker_box", "005_tomato_soup_can", "006_mustard_bottle"]
    parts = [ycb_part(ycb_root, name) for name in names]
    sample = YcbVideoReader(ycb_root, parts, ["0050/000003"]).sample(0)
    for shaded in shade(sample, SHARES, 17, 0):
        assert shaded.reached == pytest.approx((shaded.share,) * 3, abs=0.001)
