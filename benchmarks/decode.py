"""CPU time from maps to poses on one thread, for drawn maps of 50×50 and for released networks.

python benchmarks/decode.py
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from common import encoded, timed
from scipy.spatial.transform import Rotation

from dopepp.data.rendered import RenderedSource
from dopepp.experiment.results.cost import likely_maps
from dopepp.geometry.camera import camera_matrix, make_transform, project_keypoints
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.network_estimator import Maps, NetworkEstimator
from dopepp.maps import MapGeometry, find_peaks
from dopepp.parts.catalogue import BUILTIN
from dopepp.recovery import recover
from dopepp.virtual import PRESETS, Factory

CELLS, STRIDE, REPEATS = 50, 8, 100
SEED, IMAGES = 0, 12
NOISY = 60
RELEASED = {"pivconnector": "quickstart", "pivconnector_wide": "wide", "servoholder": "quickstart"}
K = camera_matrix(600, 600, 199.5, 199.5)
CRACKER_BOX = cuboid_keypoints(
    np.array([-0.036, -0.082, -0.1065]), np.array([0.036, 0.082, 0.1065])
)


def scene(count: int, rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the maps of instances on a grid, 110 px in size."""
    places = [(x, y) for y in (60.0, 155.0, 250.0, 345.0) for x in (70.0, 200.0, 330.0)]
    keypoints = []
    for u, v in places[:count]:
        z = 1.5
        t = np.array([(u - K[0, 2]) * z / K[0, 0], (v - K[1, 2]) * z / K[1, 1], z])
        T = make_transform(Rotation.random(random_state=rng).as_matrix(), t)
        keypoints.append(project_keypoints(CRACKER_BOX, T, K))
    return encoded(np.array(keypoints), CELLS, STRIDE)


def noisy_maps(rng: np.random.Generator, wrong: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the maps of one instance with noise, for correct or wrong keypoints."""
    t = np.array([*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.8, 1.2)])
    T = make_transform(Rotation.random(random_state=rng).as_matrix(), t)
    keypoints = project_keypoints(CRACKER_BOX, T, K)[None]
    if wrong:
        keypoints += rng.normal(0, 3, keypoints.shape)
        keypoints[0, rng.integers(8)] += rng.uniform(-40, 40, 2)
    maps = encoded(keypoints, CELLS, STRIDE)
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    noises = (0.005, 0.05) if wrong else (0.02, 0.05)
    belief, field = (
        clean + noise * torch.randn(clean.shape, generator=generator)
        for clean, noise in zip(maps, noises, strict=True)
    )
    return belief, field


def milliseconds(call: Callable[[], object], repeats: int = REPEATS) -> float:
    """Return the median CPU time of a call, after two calls to warm up."""
    call(), call()
    return float(np.median([timed(call)[1] for _ in range(repeats)]))


def main() -> None:
    """Print the table."""
    rng = np.random.default_rng(SEED)
    torch.set_num_threads(1)
    print("".join(f"{word:>11}" for word in ("instances", "found", "recover ms", "peaks ms")))
    for count in (1, 3, 10):
        print("".join(f"{value:>11}" for value in row(count, *scene(count, rng))))
    print("\nOne instance, milliseconds: noise on its maps (belief 0.02, field 0.05), and wrong")
    print("keypoints: each off by 3 px (standard deviation), one by up to 40 px more")
    print(f"{'':>16}{'median':>10}{'9 of 10':>10}")
    for name, wrong in (("noisy maps", False), ("wrong keypoints", True)):
        spent = [
            milliseconds(partial(recover, *maps, CRACKER_BOX[None], K, STRIDE), repeats=3)
            for maps in (noisy_maps(rng, wrong) for _ in range(NOISY))
        ]
        print(f"{name:>16}{np.median(spent):10.2f}{np.quantile(spent, 0.9):10.2f}")
    print("\nTest images: the network's own maps, and true maps with the noise of job=cost")
    print(f"{'network':>20}{'own ms':>10}{'peaks':>8}{'noisy ms':>10}{'peaks':>8}")
    for name, preset in RELEASED.items():
        clean, own_peaks, noisy, noisy_peaks = released(name, preset)
        print(f"{name:>20}{clean:10.2f}{own_peaks:8.1f}{noisy:10.2f}{noisy_peaks:8.1f}")


def released(name: str, preset: str) -> tuple[float, ...]:
    """Return median ms and mean number of peaks on a network's maps, then on noisy true maps."""
    estimator = PoseEstimator.load(f"pretrained/{name}")
    geometry = MapGeometry(estimator.network.stride, estimator.recovery.sigma)
    part = BUILTIN[estimator.parts[0].name]()
    source = RenderedSource(Factory([part], PRESETS[preset], SEED), IMAGES, "test")
    generator = torch.Generator().manual_seed(SEED)
    rows = []
    for index in range(IMAGES):
        sample = source.sample(index)
        maps = estimator.maps(sample.image)
        noisy = likely_maps(sample, estimator, geometry, generator)
        rows.append([*decoding(maps, sample.K, estimator), *decoding(noisy, sample.K, estimator)])
    own_ms, own_peaks, noisy_ms, noisy_peaks = np.array(rows).T
    return np.median(own_ms), own_peaks.mean(), np.median(noisy_ms), noisy_peaks.mean()


def decoding(maps: Maps, K: np.ndarray, estimator: NetworkEstimator) -> tuple[float, int]:
    """Return the milliseconds of recovery from maps, and the number of peaks."""
    options, stride = estimator.recovery, estimator.network.stride
    geometry = MapGeometry(stride, options.sigma)
    peaks = find_peaks(maps[0][None], geometry, options.peak_threshold)
    spent = milliseconds(lambda: recover(*maps, estimator.cuboids, K, stride, **vars(options)))
    return spent, int((peaks.score > 0).sum())


def row(count: int, belief: torch.Tensor, field: torch.Tensor) -> tuple[str, ...]:
    """Return the numbers of instances and detections, and ms of recovery and of peak finding."""
    geometry = MapGeometry(STRIDE)

    def num_detections() -> int:
        return len(recover(belief, field, CRACKER_BOX[None], K, STRIDE))

    spent = milliseconds(num_detections)
    peaks = milliseconds(lambda: find_peaks(belief[None], geometry, 0.02, 16, field[None]))
    return str(count), str(num_detections()), f"{spent:.2f}", f"{peaks:.2f}"


if __name__ == "__main__":
    main()
