"""The shading protocol's patches, against what brute force finds in the picture."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dopepp.data.formats.ycb_video.reader import YcbVideoReader
from dopepp.data.sample import Instance, Sample
from dopepp.data.transforms.shading import TOLERANCE, shade
from dopepp.parts.mesh.read import ycb_part

SIZE = (72, 96)
OBJECT_BLUE = 255
# Shuffled, so that neighbours differ enough for any crop to have contrast.
ROWS, COLUMNS = (np.random.default_rng(length).permutation(length) for length in SIZE)
SHARES = (0.2, 0.4, 0.6, 0.8)


def addressed(*masks: np.ndarray) -> Sample:
    """An image whose background pixels tell their row (red) and column (green)."""
    rows, columns = np.meshgrid(ROWS, COLUMNS, indexing="ij")
    image = np.stack([rows, columns, np.zeros_like(rows)], axis=2).astype(np.uint8)
    for mask in masks:
        image[mask, 2] = OBJECT_BLUE
    instances = [
        Instance("box", np.eye(4), np.full((9, 2), np.nan), 0.7, mask.copy()) for mask in masks
    ]
    return Sample(image, np.eye(3), instances, np.ones(SIZE, np.float32))


def ellipse(row: float, column: float, height: float, width: float) -> np.ndarray:
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    return ((rows - row) / height) ** 2 + ((columns - column) / width) ** 2 <= 1


def is_object(image: np.ndarray) -> np.ndarray:
    return np.asarray(image[..., 2] == OBJECT_BLUE)


def source_of(pixels: np.ndarray) -> np.ndarray:
    """Return the row and column that background pixels were taken from."""
    return np.column_stack([np.argsort(ROWS)[pixels[:, 0]], np.argsort(COLUMNS)[pixels[:, 1]]])


def box_of(mask: np.ndarray) -> tuple[int, int, int, int]:
    rows, columns = np.nonzero(mask)
    return rows.min(), rows.max() + 1, columns.min(), columns.max() + 1


@settings(max_examples=60)
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
    # What a patch hides has no known depth.
    assert not shaded.sample.depth[mask & ~left].any()
    assert shaded.sample.depth[left].all()


@pytest.mark.parametrize("seed", range(5))
def test_patches_are_several_crops_of_the_own_background(seed):
    mask = ellipse(36, 40, 20, 28)
    sample = addressed(mask)
    (shaded,) = shade(sample, [0.8], seed, 0)
    changed = (shaded.sample.image != sample.image).any(axis=2)
    rows, columns = np.nonzero(changed)
    pasted = shaded.sample.image[changed]
    source = source_of(pasted)
    assert (pasted[:, 2] == 0).all()
    assert not mask[source[:, 0], source[:, 1]].any()
    # A crop keeps one offset between where it was taken and where it lies.
    offsets = source - np.column_stack([rows, columns])
    patches = np.unique(offsets, axis=0)
    assert len(patches) >= 3
    top, bottom, start, stop = box_of(mask)
    for offset in patches:
        place = (offsets == offset).all(axis=1)
        assert np.ptp(rows[place]) + 1 <= 0.5 * (bottom - top)
        assert np.ptp(columns[place]) + 1 <= 0.5 * (stop - start)


def test_more_shading_contains_less_and_depends_on_nothing_else():
    sample = addressed(ellipse(36, 40, 20, 28))
    together = shade(sample, SHARES, 5, 7)
    for share, one in zip(SHARES, together, strict=True):
        (alone,) = shade(sample, [share], 5, 7)
        np.testing.assert_array_equal(alone.sample.image, one.sample.image)
        assert alone.reached == one.reached
    for less, more in pairwise(together):
        changed = (less.sample.image != sample.image).any(axis=2)
        np.testing.assert_array_equal(more.sample.image[changed], less.sample.image[changed])
    for seed, index in ((6, 7), (5, 8)):
        other = shade(sample, SHARES, seed, index)
        assert (other[1].sample.image != together[1].sample.image).any()


@settings(max_examples=40)
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


def test_what_cannot_be_shaded_is_left_alone():
    mask = ellipse(36, 30, 15, 15)
    sample = addressed(mask, np.zeros(SIZE, bool))
    corners = np.array([[60, 20], [90, 20], [60, 60], [90, 60]] * 2 + [[75, 40]], np.float64)
    sample.instances.append(Instance("unlabelled", np.eye(4), corners, 0.5))
    (shaded,) = shade(sample, [0.6], 0, 0)
    assert shaded.reached[0] == pytest.approx(0.6, abs=TOLERANCE)
    assert shaded.reached[1:] == (None, None)
    assert shaded.sample.instances[1:] == sample.instances[1:]
    # The unlabelled object's hull is no background to take crops from, either.
    pasted = shaded.sample.image[mask & ~is_object(shaded.sample.image)]
    taken_from = source_of(pasted)
    inside = (taken_from[:, 0] >= 20) & (taken_from[:, 0] <= 60)
    assert not (inside & (taken_from[:, 1] >= 60) & (taken_from[:, 1] <= 90)).any()


def test_a_solid_background_covers_nothing_and_says_so():
    sample = addressed(ellipse(36, 40, 20, 28))
    sample.image[~is_object(sample.image)] = 9
    (shaded,) = shade(sample, [0.4], 0, 0)
    np.testing.assert_array_equal(shaded.sample.image, sample.image)
    assert shaded.reached == (0.0,)


def test_little_room_gives_smaller_crops_and_a_smooth_background_is_no_solid_one():
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


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_a_share_outside_0_to_1_is_refused(share):
    with pytest.raises(ValueError, match=r"shares must be in \[0, 1\]"):
        shade(addressed(), [0.2, share], 0, 0)


def test_real_frames_are_shaded_to_the_share(ycb_root):
    names = ["003_cracker_box", "005_tomato_soup_can", "006_mustard_bottle"]
    parts = [ycb_part(ycb_root, name) for name in names]
    sample = YcbVideoReader(ycb_root, parts, frames=["0050/000003"]).sample(0)
    for shaded in shade(sample, SHARES, 17, 0):
        assert shaded.reached == pytest.approx((shaded.share,) * 3, abs=0.001)
