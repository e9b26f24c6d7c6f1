"""How long it takes from maps to poses: one thread, 50×50 maps, process time.

python benchmarks/decode.py
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from dopepp.geometry.camera import camera_matrix, make_transform, project_keypoints
from dopepp.geometry.cuboid import cuboid_keypoints
from dopepp.maps import MapGeometry, encode, find_peaks
from dopepp.recovery import recover

CELLS, STRIDE, REPEATS = 50, 8, 100
K = camera_matrix(600, 600, 199.5, 199.5)
CRACKER_BOX = cuboid_keypoints(
    np.array([-0.036, -0.082, -0.1065]), np.array([0.036, 0.082, 0.1065])
)


def scene(count: int, rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Maps of instances on a grid, 110 px in size."""
    places = [(x, y) for y in (60.0, 155.0, 250.0, 345.0) for x in (70.0, 200.0, 330.0)]
    keypoints = []
    for u, v in places[:count]:
        z = 1.5
        t = np.array([(u - K[0, 2]) * z / K[0, 0], (v - K[1, 2]) * z / K[1, 1], z])
        T = make_transform(Rotation.random(random_state=rng).as_matrix(), t)
        keypoints.append(project_keypoints(CRACKER_BOX, T, K))
    belief, field = encode(
        torch.tensor(np.array(keypoints))[None],
        torch.zeros(1, count, dtype=torch.long),
        1,
        (CELLS, CELLS),
        MapGeometry(STRIDE),
    )
    return belief[0], field[0]


def milliseconds(call: Callable[[], object]) -> float:
    """Median over repeats, after two to warm up."""
    call(), call()
    times = []
    for _ in range(REPEATS):
        start = time.process_time_ns()
        call()
        times.append(time.process_time_ns() - start)
    return float(np.median(times)) / 1e6


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    rng = np.random.default_rng(parser.parse_args().seed)
    torch.set_num_threads(1)
    head = ("instances", "found", "recover ms", "peaks ms", "filter ms", "ratio")
    print("".join(f"{word:>11}" for word in head))
    for count in (1, 3, 10):
        print("".join(f"{value:>11}" for value in row(count, *scene(count, rng))))


def row(count: int, belief: torch.Tensor, field: torch.Tensor) -> tuple[str, ...]:
    """Time the whole way, peak finding alone, and smoothing the nine maps as a yardstick."""
    geometry, maps = MapGeometry(STRIDE), belief.numpy()

    def whole() -> int:
        return len(recover(belief, field, CRACKER_BOX[None], K, STRIDE))

    spent = milliseconds(whole)
    peaks = milliseconds(lambda: find_peaks(belief[None], geometry, 0.02, 16, field[None]))
    smoothing = milliseconds(lambda: [gaussian_filter(one, 3.0) for one in maps])
    times = (spent, peaks, smoothing, spent / smoothing)
    return str(count), str(whole()), *(f"{value:.2f}" for value in times)


if __name__ == "__main__":
    main()
