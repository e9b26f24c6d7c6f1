"""Functions that several benchmarks share: errors, random steps, maps, CPU times, Markdown rows."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import cv2
import numpy as np

from dopepp.geometry.camera import Transform, transform
from dopepp.geometry.rotation import rotation_angle

Value = TypeVar("Value")


class PoseError(NamedTuple):
    """Errors of an estimated pose: rotation in degrees, translation and ADD in millimetres."""

    rotation: float
    translation: float
    add: float


def pose_errors(T: Transform, true: Transform, points: np.ndarray) -> PoseError:
    """Return the errors of a pose; ``points`` (V, 3) are the part's ADD points in metres."""
    distances = np.linalg.norm(transform(T, points) - transform(true, points), axis=1)
    return PoseError(
        math.degrees(float(rotation_angle(T[:3, :3] @ true[:3, :3].T))),
        1e3 * float(np.linalg.norm(T[:3, 3] - true[:3, 3])),
        1e3 * float(distances.mean()),
    )


def random_step(rng: np.random.Generator, angle: float, shift: float) -> np.ndarray:
    """Return a rotation vector of a length (radians) and a shift of a length (metres), (6,)."""
    step = rng.normal(size=6)
    step[:3] *= angle / np.linalg.norm(step[:3])
    step[3:] *= shift / np.linalg.norm(step[3:])
    return step


def encoded(keypoints: np.ndarray, cells: int = 50, stride: int = 8, sigma: float = 1.0):
    """Return the square belief maps and vector field of an object's instances, (n, 9, 2) pixels."""
    import torch

    from dopepp.maps import MapGeometry, encode

    index = torch.zeros(1, len(keypoints), dtype=torch.long)
    geometry = MapGeometry(stride, sigma)
    belief, field = encode(torch.tensor(keypoints)[None], index, 1, (cells, cells), geometry)
    return belief[0], field[0]


def use_one_thread() -> None:
    """Restrict OpenCV and PyTorch to one thread."""
    import torch  # the rendering benchmarks must not import it

    cv2.setNumThreads(1)
    torch.set_num_threads(1)


def timed(call: Callable[[], Value]) -> tuple[Value, float]:
    """Return the result of a call and its CPU time in milliseconds."""
    start = time.process_time()
    value = call()
    return value, 1e3 * (time.process_time() - start)


def print_head(*titles: str) -> None:
    """Print the head of a Markdown table."""
    print_row(*titles)
    print("|" + " --- |" * len(titles), flush=True)


def print_row(*cells: object) -> None:
    """Print a row of a Markdown table."""
    print(f"| {' | '.join(map(str, cells))} |", flush=True)
