"""How long a frame takes from picture to poses, for a network that is not trained.

Every frame goes the whole way of :meth:`~dopepp.inference.estimator.PoseEstimator.predict`: resize
and pad the picture, run the network, find peaks, group them, solve for poses. An untrained network
finds nothing, and nothing would take no time. So the network's own maps are made, timed and put
aside, and poses are recovered from what a trained network would answer: the true maps of the
picture's objects, with noise (:data:`BELIEF_NOISE`).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle, islice
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, UInt8

from dopepp.data.batch import collate
from dopepp.data.sample import Sample
from dopepp.data.transforms.resize import pad_sample, resize_sample
from dopepp.geometry.camera import Letterbox
from dopepp.inference.estimator import Maps, PoseEstimator, letterboxed
from dopepp.maps.encode import MapGeometry
from dopepp.training.targets import draw_maps

BELIEF_NOISE: Final = 0.005
FIELD_NOISE: Final = 0.05
"""Standard deviations, cell by cell, of what is added to true maps. Recovery then takes as long as
on the maps of the three released networks, within about a tenth: 7 to 8 peaks an image, there 9
(``benchmarks/decode.py``). The 0.02 of the crowds in ``benchmarks/recovery.py`` is no trained
network's: it fills every channel with peaks, 144 an image, and takes nearly twice as long."""

WARM_UP: Final = 3
"""Passes that allocate memory, choose kernels and compile; they are not timed."""


@dataclass(frozen=True)
class FrameTimes:
    """Seconds that frames took, in their order.

    Attributes:
        seconds: From picture to poses.
        network_seconds: Of the network in them: from the resized picture to maps.
        recovery_seconds: From maps to poses in them; the rest resizes and pads.
    """

    seconds: Float[np.ndarray, "frames"]
    network_seconds: Float[np.ndarray, "frames"]
    recovery_seconds: Float[np.ndarray, "frames"]


class RehearsedEstimator(PoseEstimator):
    """An estimator that runs its network and then goes on with maps that it was given.

    Attributes:
        answer: Maps that the next prediction recovers poses from, on the estimator's device.
        network_began: When the network was last given a picture, seconds of ``perf_counter``.
        network_ended: When its maps were there.
    """

    answer: Maps
    network_began: float
    network_ended: float

    def maps(self, image: UInt8[np.ndarray, "height width 3"]) -> Maps:
        """Run the network on the image and return the answer in place of its maps."""
        self.network_began = time.perf_counter()
        super().maps(image)
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)  # else the network would still be at work
        self.network_ended = time.perf_counter()
        return self.answer


def time_frames(
    estimator: RehearsedEstimator,
    samples: Sequence[Sample],
    geometry: MapGeometry,
    num_frames: int,
    seed: int,
) -> FrameTimes:
    """Time frames from picture to poses.

    Args:
        estimator: With any weights.
        samples: Pictures with their truth, taken in turn.
        geometry: Of the maps that a trained network would answer.
        num_frames: Timed frames, after :data:`WARM_UP` that are not.
        seed: Of the maps' noise.
    """
    generator = torch.Generator().manual_seed(seed)
    rehearsed = [
        (one, likely_maps(one, estimator, geometry, generator=generator)) for one in samples
    ]
    rows = []
    for sample, estimator.answer in islice(cycle(rehearsed), WARM_UP + num_frames):
        began = time.perf_counter()
        estimator.predict(sample.image, sample.K)
        ended = time.perf_counter()
        network = estimator.network_ended - estimator.network_began
        rows.append((ended - began, network, ended - estimator.network_ended))
    return FrameTimes(*np.array(rows[WARM_UP:]).T)


def likely_maps(
    sample: Sample,
    estimator: PoseEstimator,
    geometry: MapGeometry,
    generator: torch.Generator,
) -> Maps:
    """Return the maps that a trained network would answer: a picture's true ones, with noise.

    Args:
        sample: The picture with its truth, at its own resolution.
        estimator: Whose input they are for, and on whose device they are put.
        geometry: Stride, peak width and disc radius.
        generator: Of the noise.
    """
    size = estimator.checkpoint.input_size
    letterbox = Letterbox.fit(sample.size, size)
    rows, columns, _ = letterboxed(sample.image, letterbox, estimator.network.size_multiple).shape
    seen = pad_sample(resize_sample(sample, size), (columns, rows))
    batch = collate([seen], {part.name: number for number, part in enumerate(estimator.parts)})
    true = draw_maps(batch, batch.keypoints, len(estimator.parts), geometry)
    belief, field = (
        (one[0] + noise * torch.randn(one[0].shape, generator=generator)).to(estimator.device)
        for one, noise in zip(true, (BELIEF_NOISE, FIELD_NOISE), strict=True)
    )
    return belief, field
