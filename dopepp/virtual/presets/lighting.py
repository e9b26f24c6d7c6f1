"""Random light: how many lamps, where, how strong and of which colour.

To add a kind of light, extend :class:`Lighting` by its ranges and :meth:`Lighting.draw`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.random import Generator

from dopepp.core.checks import check_counts, check_number, check_range
from dopepp.geometry.rotation import Vector
from dopepp.virtual.scene import Ambient, Light, triple

_LUMINANCE: Final = np.array([0.2126, 0.7152, 0.0722])
"""Luminance of linear sRGB (BT.709)."""

_RGB_FROM_XYZ: Final = np.array(
    [
        [3.2404542, -1.5371385, -0.4985314],
        [-0.9692660, 1.8760108, 0.0415560],
        [0.0556434, -0.2040259, 1.0572252],
    ]
)
"""CIE XYZ to linear sRGB (IEC 61966-2-1, white D65)."""

_COLDEST_K: Final = 1667.0
_HOTTEST_K: Final = 25000.0
"""Where the approximation of the Planckian locus holds."""


@dataclass(frozen=True)
class Lighting:
    """Ranges of light; intensities are what a white surface facing the light reflects, 1 clips.

    Attributes:
        num_lights: Smallest and largest number of point lights; the first casts shadows.
        ambient_intensity: Of the light from everywhere.
        max_angle_deg: Largest angle between a light's direction and the camera's, as seen from
            the scene; 0 is a flash light on the camera, 90 a light from the side. Over a plane,
            the angle is taken from the plane's normal.
        distance: Of a light from the scene, in units of the camera's distance.
        temperature_k: Colour temperature of a lamp as a camera balanced for 6500 K sees it,
            kelvin; low ones are warm.
        tint: Largest relative deviation of a colour channel from that colour.
        ground_share: Light from below over the light from above.
    """

    num_lights: tuple[int, int] = (1, 3)
    key_intensity: tuple[float, float] = (0.45, 1.3)
    fill_intensity: tuple[float, float] = (0.1, 0.4)
    ambient_intensity: tuple[float, float] = (0.08, 0.4)
    max_angle_deg: float = 75.0
    distance: tuple[float, float] = (1.0, 5.0)
    temperature_k: tuple[float, float] = (4000.0, 8500.0)
    tint: float = 0.06
    ground_share: tuple[float, float] = (0.3, 0.9)

    def __post_init__(self) -> None:
        check_counts("num_lights", self.num_lights, 0, 8, of=self)
        for name in ("key_intensity", "fill_intensity", "ambient_intensity"):
            check_range(name, getattr(self, name), 0.0, 10.0, "1 = white", of=self)
        check_number("max_angle_deg", self.max_angle_deg, 0.0, 180.0, "degrees", of=self)
        check_range("distance", self.distance, 0.1, 1000.0, "camera distances", of=self)
        check_range("temperature_k", self.temperature_k, _COLDEST_K, _HOTTEST_K, "kelvin", of=self)
        check_number("tint", self.tint, 0.0, 0.9, "share", of=self)
        check_range("ground_share", self.ground_share, 0.0, 1.0, "share", of=self)

    def draw(
        self, rng: Generator, centre: Vector, normal: Vector | None = None
    ) -> tuple[tuple[Light, ...], Ambient]:
        """Draw point lights around a point of the scene, and the ambient light.

        They stand around ``centre``; ``normal`` is the supporting plane's, None where there is
        none; both in the camera frame, metres.
        """
        towards = np.array([0.0, 0.0, -1.0]) if normal is None else normal
        far = float(np.linalg.norm(centre))
        lights = []
        for number in range(int(rng.integers(self.num_lights[0], self.num_lights[1] + 1))):
            reach = far * rng.uniform(*self.distance)
            position = centre + reach * _in_cap(rng, towards, self.max_angle_deg)
            strength = rng.uniform(*(self.fill_intensity if number else self.key_intensity))
            lights.append(Light(triple(position), triple(strength * self._colour(rng)), reach))
        if normal is None:
            # Mostly from above and from behind the camera, as in a room.
            towards = rng.normal(size=3) + np.array([0.0, -1.5, -0.5])
            towards = towards / np.linalg.norm(towards)
        above = rng.uniform(*self.ambient_intensity) * self._colour(rng)
        below = above * rng.uniform(*self.ground_share)
        return tuple(lights), Ambient(triple(towards), triple(above), triple(below))

    def _colour(self, rng: Generator) -> Vector:
        """Draw the linear RGB of a lamp of luminance about 1."""
        # Equal steps of 1/T look equally different (mired), so it is what is uniform.
        warm, cold = self.temperature_k
        colour = black_body_rgb(1.0 / rng.uniform(1.0 / cold, 1.0 / warm))
        return np.asarray(colour * (1 + rng.uniform(-self.tint, self.tint, 3)))


def black_body_rgb(temperature_k: float) -> Vector:
    """Return the linear sRGB colour of luminance 1 of a black body (white at about 6500 K).

    The chromaticity is the cubic approximation of the Planckian locus by Kim et al., "Design of
    advanced color temperature control system", US patent 7024034 (2002), for 1667 to 25000 K.
    Colours outside of sRGB's gamut lose their negative part.
    """
    t = 1e3 / temperature_k
    if temperature_k <= 4000:
        x = -0.2661239 * t**3 - 0.2343589 * t**2 + 0.8776956 * t + 0.179910
    else:
        x = -3.0258469 * t**3 + 2.1070379 * t**2 + 0.2226347 * t + 0.240390
    if temperature_k <= 2222:
        y = -1.1063814 * x**3 - 1.34811020 * x**2 + 2.18555832 * x - 0.20219683
    elif temperature_k <= 4000:
        y = -0.9549476 * x**3 - 1.37418593 * x**2 + 2.09137015 * x - 0.16748867
    else:
        y = 3.0817580 * x**3 - 5.87338670 * x**2 + 3.75112997 * x - 0.37001483
    colour = np.maximum(_RGB_FROM_XYZ @ np.array([x / y, 1.0, (1 - x - y) / y]), 0.0)
    return np.asarray(colour / (_LUMINANCE @ colour))


def _in_cap(rng: Generator, axis: Vector, angle_deg: float) -> Vector:
    """Draw a unit vector uniformly over the spherical cap around a unit axis."""
    cosine = rng.uniform(np.cos(np.radians(angle_deg)), 1.0)
    azimuth, sine = rng.uniform(0, 2 * np.pi), np.sqrt(1 - cosine**2)
    helper = np.eye(3)[np.abs(axis).argmin()]
    across = np.cross(axis, helper)
    across /= np.linalg.norm(across)
    around = np.cos(azimuth) * across + np.sin(azimuth) * np.cross(axis, across)
    return np.asarray(cosine * axis + sine * around)
