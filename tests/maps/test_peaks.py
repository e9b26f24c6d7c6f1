import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import maximum_filter

from dopepp.geometry.camera import camera_matrix, make_transform, project_keypoints
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.geometry.rotation import random_rotation
from dopepp.maps import MapGeometry, encode, find_peaks

GEOMETRY = MapGeometry(stride=8, sigma=1.0)
NUM_CELLS = 30


def gaussians(*centres, sigma=1.0, height=1.0):
    """One channel with the maximum of Gaussians at (x, y) in cells."""
    y, x = torch.meshgrid(*[torch.arange(NUM_CELLS)] * 2, indexing="ij")
    belief = torch.zeros(NUM_CELLS, NUM_CELLS)
    for cx, cy in centres:
        squared = (x - cx) ** 2 + (y - cy) ** 2
        belief = torch.maximum(belief, height * torch.exp(-squared / (2 * sigma**2)))
    return belief[None, None]


def positions(peaks):
    """Return the peaks of the first image's first channel in cells, (n, 2)."""
    found = peaks.position[0, 0][peaks.score[0, 0] > 0]
    return np.asarray((found - 3.5) / 8)


@pytest.mark.parametrize("sigma", [0.5, 1.0, 2.0])
def test_decoding_an_encoded_pose_finds_its_keypoints(sigma):
    """The bias is under 0.1 px and 99 % of errors are under 0.5 px, also at the border."""
    rng = np.random.default_rng(0)
    geometry = MapGeometry(stride=8, sigma=sigma)
    cuboid = cuboid_keypoints(np.array([-0.05, -0.03, -0.02]), np.array([0.05, 0.03, 0.02]))
    K = camera_matrix(400, 400, 127.5, 127.5)
    low, high = [-0.12, -0.12, 0.25], [0.12, 0.12, 0.5]
    poses = [make_transform(random_rotation(rng), rng.uniform(low, high)) for _ in range(150)]
    keypoints = np.stack([project_keypoints(cuboid, T, K) for T in poses])
    objects = torch.zeros(len(keypoints), 1, dtype=torch.long)
    belief, _ = encode(torch.tensor(keypoints)[:, None], objects, 1, (32, 32), geometry)
    peaks = find_peaks(belief, geometry)
    on_map = ((keypoints > -0.5) & (keypoints < 255.5)).all(-1)
    assert on_map.mean() < 0.99  # some are off the map
    border = on_map & ((keypoints < 8) | (keypoints > 247)).any(-1)
    assert border.sum() > 20
    assert ((peaks.score > 0).sum(-1) == on_map).all()
    error = peaks.position[:, :, 0][on_map] - keypoints[on_map]
    distance = np.linalg.norm(error, axis=-1)
    assert np.abs(error.mean(0)).max() < 0.1
    assert np.quantile(distance, 0.99) < 0.5
    assert np.abs(peaks.covariance_px[peaks.score > 0]).max() < 0.01


BORDER = [(0.0, 0.0), (-0.4, 29.3), (29.4, -0.3), (12.0, 29.49)]
EQUAL_NEIGHBOURS = [(10.5, 10.0), (10.0, 10.5), (10.5, 10.5), (0.5, 0.0), (28.5, 28.5)]


@pytest.mark.parametrize("height", [1.0, 1e3, 1e15])
@pytest.mark.parametrize("centre", BORDER + EQUAL_NEIGHBOURS)
def test_a_peak_at_any_position_is_exact(centre, height):
    """An identity activation does not bound beliefs; the fit is independent of the height."""
    found = positions(find_peaks(gaussians(centre, height=height), GEOMETRY))
    assert found == pytest.approx(np.array([centre]), abs=1e-3)


@pytest.mark.parametrize("height", [1.3, 2.0, 3.0])
@pytest.mark.parametrize("sigma", [1.0, 1.5])
def test_a_clamped_belief_has_one_peak_in_the_middle_of_its_top(height, sigma):
    """The activation clamps beliefs at 1; the flanks still determine the position."""
    rng = np.random.default_rng(1)
    for centre in rng.uniform(5, 25, (40, 2)):
        belief = gaussians(centre, sigma=sigma, height=height).clamp(max=1)
        found = positions(find_peaks(belief, GEOMETRY))
        assert len(found) == 1
        assert 8 * np.linalg.norm(found[0] - centre) < 0.5


PLATEAUS = {
    "row": torch.ones(1, 5),
    "column": torch.ones(5, 1),
    "square": torch.ones(3, 3),
    "diagonal": torch.eye(4),
    "other diagonal": torch.eye(4).flip(0),
    "flat slope": torch.tensor([[0.0, 0, 0, 1, 1], [1, 1, 1, 1, 0]]),
    "steep slope": torch.tensor([[0.0, 1], [0, 1], [1, 1], [1, 0]]),
    "plus": torch.tensor([[0.0, 1, 0], [1, 1, 1], [0, 1, 0]]),
}


@pytest.mark.parametrize("shape", PLATEAUS.values(), ids=PLATEAUS)
def test_a_plateau_of_any_shape_is_one_peak_near_its_middle(shape):
    belief = torch.zeros(1, 1, NUM_CELLS, NUM_CELLS)
    belief[0, 0, 10 : 10 + shape.shape[0], 12 : 12 + shape.shape[1]] = shape
    found = positions(find_peaks(belief, GEOMETRY))
    rows, columns = np.nonzero(shape.numpy())
    assert len(found) == 1
    assert np.linalg.norm(found[0] - [12 + columns.mean(), 10 + rows.mean()]) < 1.0


def test_steps_of_a_coarse_number_format_are_not_peaks():
    """A bf16 belief has terraces on its flanks: equal neighbours below the top."""
    for sigma in (2.0, 4.0):
        belief = gaussians((14.3, 15.6), sigma=sigma).bfloat16()
        found = positions(find_peaks(belief, MapGeometry(8, sigma)))
        assert found == pytest.approx(np.array([[14.3, 15.6]]), abs=0.05)


@pytest.mark.parametrize("sigma", [1.0, 2.0])
@pytest.mark.parametrize("apart", [3.0, 3.5, 4.0, 6.0])
def test_the_peaks_of_two_instances_are_independent(sigma, apart):
    rng = np.random.default_rng(2)
    geometry = MapGeometry(8, sigma)
    turns = rng.uniform(0, 2 * np.pi, 60)
    for first, turn in zip(rng.uniform(13, 17, (60, 2)), turns, strict=True):
        second = first + apart * sigma * np.array([np.cos(turn), np.sin(turn)])
        belief = gaussians(first, second, sigma=sigma)
        found = positions(find_peaks(belief, geometry))
        assert len(found) == 2
        for truth in (first, second):
            assert 8 * np.linalg.norm(found - truth, axis=1).min() < 0.5


def test_a_weak_peak_beside_a_strong_one():
    belief = torch.maximum(gaussians((10.2, 10.4)), gaussians((14.3, 10.1), height=0.2))
    peaks = find_peaks(belief, GEOMETRY)
    assert positions(peaks) == pytest.approx(np.array([[10.2, 10.4], [14.3, 10.1]]), abs=0.06)
    assert (np.diff(peaks.score[0, 0]) <= 0).all()


def test_noise_on_a_peak_moves_it_little():
    rng = torch.Generator().manual_seed(0)
    noise = torch.randn(1, 200, NUM_CELLS, NUM_CELLS, generator=rng)
    belief = gaussians((14.3, 15.6)) + 0.02 * noise
    peaks = find_peaks(belief, GEOMETRY, threshold=0.3, max_peaks=1)
    error = (peaks.position[0, :, 0] - 3.5) / 8 - np.array([14.3, 15.6])
    assert (peaks.score > 0).all()
    assert 8 * np.sqrt((error**2).mean()) < 0.15


def test_the_strongest_above_the_threshold_fill_the_slots():
    heights = [0.3, 0.9, 0.5, 0.7]
    maps = [gaussians((5.0 + 6 * k, 15.0), height=h) for k, h in enumerate(heights)]
    belief = torch.cat([torch.stack(maps).amax(0), gaussians((9.0, 9.0), height=0.6)], dim=1)
    peaks = find_peaks(belief, GEOMETRY, max_peaks=3)
    assert peaks.score[0, 0].tolist() == pytest.approx([0.9, 0.7, 0.5])
    assert positions(peaks)[:, 0] == pytest.approx([11.0, 23.0, 17.0], abs=1e-3)
    assert (peaks.score > 0).tolist() == [[[True] * 3, [True, False, False]]]
    assert np.isnan(peaks.position[0, 1, 1:]).all()
    assert peaks.score[0, 1, 1:].tolist() == [0, 0]
    for threshold, count in ((0.2, 4), (0.6, 2), (0.9001, 0)):
        assert len(positions(find_peaks(belief, GEOMETRY, threshold=threshold))) == count


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_a_constant_map_has_no_peak(value):
    peaks = find_peaks(torch.full((2, 9, 8, 8), value), GEOMETRY)
    assert not (peaks.score > 0).any()


@pytest.mark.parametrize("size", [(16, 16), (7, 31), (1, 9), (2, 3)])
def test_peaks_are_the_highest_cells_of_their_neighbourhoods(size):
    """The peaks are SciPy's local maxima."""
    belief = torch.rand(2, 9, *size, generator=torch.Generator().manual_seed(1))
    score = find_peaks(belief, GEOMETRY, threshold=0.3, max_peaks=6).score
    for found, image in zip(score.reshape(18, 6), belief.reshape(18, *size).numpy(), strict=True):
        around = maximum_filter(image, 3, mode="constant", cval=-1)
        highest = np.sort(image[(image == around) & (image > 0.3)])[::-1]
        assert_array_equal(found[found > 0], highest[:6].astype(np.float64))


def test_random_maps_give_finite_positions():
    rng = torch.Generator().manual_seed(3)
    belief = torch.rand(4, 9, 20, 20, generator=rng)
    belief[0] = (belief[0] > 0.5).float()
    belief[1, :, ::3] = torch.nan
    belief[2, :, ::5, ::5] = torch.inf
    belief[3] *= 1e-3
    peaks = find_peaks(belief, GEOMETRY, threshold=1e-6)
    cells = (peaks.position[peaks.score > 0] - 3.5) / 8
    assert (peaks.score > 0).sum() > 100
    assert (cells > -3).all()
    assert (cells < 23).all()
    assert np.isfinite(peaks.covariance_px[peaks.score > 0]).all()


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_the_covariance_of_a_blurred_peak(noise):
    """The covariance is the excess over the target's variance, xy term included."""
    rng, generator = np.random.default_rng(5), torch.Generator().manual_seed(5)
    y, x = np.mgrid[:NUM_CELLS, :NUM_CELLS]
    for _ in range(20):
        turn, deviation = rng.uniform(0, np.pi), rng.uniform(0.1, 0.6, 2)
        axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        covariance = axes @ np.diag(deviation**2) @ axes.T
        off = np.stack([x, y], -1) - rng.uniform(12, 17, 2)
        precision = np.linalg.inv(covariance + np.eye(2))
        belief = np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", off, precision, off))
        drawn = torch.tensor(belief)[None, None]
        drawn = drawn + noise * torch.randn(drawn.shape, generator=generator)
        peaks = find_peaks(drawn, GEOMETRY, threshold=0.3)
        found = peaks.covariance_px[0, 0, 0] / 64
        assert_allclose(found, covariance, atol=1e-4 if noise == 0 else 0.25)


def test_the_vector_is_the_mean_of_its_disc():
    rng, generator = np.random.default_rng(6), torch.Generator().manual_seed(6)
    keypoints = torch.tensor(rng.uniform(20, 220, (40, 1, 9, 2)))
    objects = torch.zeros(40, 1, dtype=torch.long)
    belief, field = encode(keypoints, objects, 1, (NUM_CELLS, NUM_CELLS), GEOMETRY)
    field = field + 0.05 * torch.randn(field.shape, generator=generator)
    peaks = find_peaks(belief, GEOMETRY, threshold=0.3, max_peaks=1, field=field)
    toward = keypoints[:, 0, 8:] - keypoints[:, 0, :8]
    expected = torch.nn.functional.normalize(toward, dim=-1).numpy()
    error = peaks.toward[:, :8, 0] - expected
    # The mean over about eight cells of a disc reduces the noise to a third.
    assert np.sqrt((error**2).mean()) < 0.025
    assert_array_equal(peaks.toward[:, 8], 0)
