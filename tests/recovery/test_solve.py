import numpy as np

from dopepp.geometry.camera import project_keypoints, transform
from dopepp.recovery.association import KeypointGroup
from dopepp.recovery.detection import solve_group


def error(T: np.ndarray | None, truth: np.ndarray, cuboid: np.ndarray) -> float:
    if T is None:
        return np.inf
    return float(np.linalg.norm(transform(T, cuboid) - transform(truth, cuboid), axis=1).mean())


def test_wide_peaks_count_less(box, K, pose):
    """The same noisy pixels with and without the width that betrays the noisy ones."""
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(40):
        truth = pose(rng)
        noise = np.array([0.3] * 5 + [6.0] * 4)
        pixels = project_keypoints(box, truth, K) + rng.normal(size=(9, 2)) * noise[:, None]
        honest = noise[:, None, None] ** 2 * np.eye(2)
        errors.append(
            [
                error(solve_group(group, box, K).T_cam_obj, truth, box)
                for group in (
                    KeypointGroup(pixels, np.ones(9), honest),
                    KeypointGroup(pixels, np.ones(9), np.tile(9.0 * np.eye(2), (9, 1, 1))),
                )
            ]
        )
    told, untold = np.median(errors, axis=0)
    assert told < 0.5 * untold


def test_maps_narrower_than_their_errors_still_give_poses(box, K, pose):
    rng = np.random.default_rng(1)
    good = 0
    for _ in range(40):
        truth = pose(rng)
        pixels = project_keypoints(box, truth, K) + 2.0 * rng.normal(size=(9, 2))
        group = KeypointGroup(pixels, np.ones(9), np.zeros((9, 2, 2)))
        result = solve_group(group, box, K)
        good += error(result.T_cam_obj, truth, box) < 0.0141  # a tenth of the diameter
        assert result.T_cam_obj is None or result.inliers.sum() >= 4
    assert good >= 38
