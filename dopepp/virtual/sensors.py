"""Random sensors: how often and how strongly each of a camera's defects is there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dopepp.virtual.ranges import check_number, check_range
from dopepp.virtual.scene import Sensor


@dataclass(frozen=True)
class Sensors:
    """Probabilities and ranges of what a camera does to the light.

    Blur and motion belong to the preset's image size and follow it when it is resized.

    Attributes:
        exposure_probability: Chance that the picture is brighter or darker.
        exposure_ev: By how much, stops.
        blur_probability: Chance of a defocus.
        blur_px: Its standard deviation, pixels.
        motion_probability: Chance of a motion blur, in any direction.
        motion_px: Its length, pixels.
        noise_probability: Chance of noise.
        read_noise: Standard deviation of the signal-independent noise, grey levels of 255.
        shot_noise: Standard deviation of the signal-dependent noise at white, grey levels.
        jpeg_probability: Chance of a JPEG compression.
        jpeg_quality: Its quality, 1 to 100.
    """

    exposure_probability: float = 0.5
    exposure_ev: tuple[float, float] = (-0.4, 0.4)
    blur_probability: float = 0.2
    blur_px: tuple[float, float] = (0.3, 1.0)
    motion_probability: float = 0.1
    motion_px: tuple[float, float] = (1.0, 5.0)
    noise_probability: float = 0.5
    read_noise: tuple[float, float] = (0.5, 2.0)
    shot_noise: tuple[float, float] = (0.5, 3.0)
    jpeg_probability: float = 0.15
    jpeg_quality: tuple[int, int] = (70, 95)

    def __post_init__(self) -> None:
        """Check the ranges."""
        for step in ("exposure", "blur", "motion", "noise", "jpeg"):
            check_number(self, f"{step}_probability", 0.0, 1.0, "probability")
        check_range(self, "exposure_ev", -8.0, 8.0, "stops")
        check_range(self, "blur_px", 0.0, 50.0, "pixels")
        check_range(self, "motion_px", 0.0, 200.0, "pixels")
        check_range(self, "read_noise", 0.0, 127.0, "grey levels")
        check_range(self, "shot_noise", 0.0, 127.0, "grey levels")
        check_range(self, "jpeg_quality", 1, 100, "JPEG quality")

    def resized(self, scale: float) -> Sensors:
        """Return the same camera for a picture that is ``scale`` times as large."""
        blur, motion = ((scale * low, scale * high) for low, high in (self.blur_px, self.motion_px))
        return replace(self, blur_px=blur, motion_px=motion)

    def draw(self, rng: np.random.Generator) -> Sensor:
        """Draw a sensor's settings."""
        on = rng.random(5) < (
            self.exposure_probability, self.blur_probability, self.motion_probability,
            self.noise_probability, self.jpeg_probability,
        )  # fmt: skip
        direction, length = rng.uniform(0, 2 * np.pi), rng.uniform(*self.motion_px)
        motion = (float(length * np.cos(direction)), float(length * np.sin(direction)))
        # Every number is drawn whether it is used or not, so a probability changes nothing else.
        exposure, blur = rng.uniform(*self.exposure_ev), rng.uniform(*self.blur_px)
        read, shot = rng.uniform(*self.read_noise), rng.uniform(*self.shot_noise)
        quality = int(rng.integers(self.jpeg_quality[0], self.jpeg_quality[1] + 1))
        return Sensor(
            exposure_ev=exposure if on[0] else 0.0,
            blur_px=blur if on[1] else 0.0,
            motion_px=motion if on[2] else (0.0, 0.0),
            read_noise=read if on[3] else 0.0,
            shot_noise=shot if on[3] else 0.0,
            jpeg_quality=quality if on[4] else None,
            noise_seed=int(rng.integers(2**32)),
        )
