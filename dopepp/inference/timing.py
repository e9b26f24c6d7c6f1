"""What a frame takes, step by step: preparing the picture, network, decoding, refining."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle, islice
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.drawing.pictures import Picture
from dopepp.geometry.camera import CameraMatrix
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.results import STEPS

WARM_UP: Final = 3
"""Frames behind the first one that are not timed: memory is allocated, kernels are chosen."""


@dataclass(frozen=True)
class Timing:
    """What frames took, milliseconds."""

    first: float  # the first frame after loading
    frame: Float[np.ndarray, "frames"]  # each later one, from picture to poses
    steps: dict[str, Float[np.ndarray, "frames"]]  # by step, what of it each took
    num_found: float  # poses found on a frame, on average


def time_frames(
    estimator: PoseEstimator, pictures: Sequence[tuple[Picture, CameraMatrix]], num_frames: int
) -> Timing:
    """Time an estimator that was just loaded on pictures, with their camera matrices, in turn."""
    rows, num_found = [], []
    for picture, K in islice(cycle(pictures), 1 + WARM_UP + num_frames):
        before, start = estimator.spent_ms.copy(), time.perf_counter()
        found = estimator.predict(picture, K, cropped=True)
        frame = 1000 * (time.perf_counter() - start)
        rows.append([frame, *(estimator.spent_ms[step] - before[step] for step in STEPS)])
        num_found.append(len(found))
    frame, *steps = np.array(rows[1 + WARM_UP :]).T
    by_step = dict(zip(STEPS, steps, strict=True))
    return Timing(rows[0][0], frame, by_step, float(np.mean(num_found)))
