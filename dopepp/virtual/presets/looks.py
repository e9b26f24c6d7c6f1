"""Distributions of materials (plastics, 3D prints, plain and brushed metals) and of lights.

To add a kind of material or light, add its share and ranges to :class:`Materials` or
:class:`Lighting`, and sample it in ``draw``.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.random import Generator

from dopepp.core.validation import Checked, Pair, Range, Share, Span
from dopepp.geometry.rotation import Vector, rotation_to_z
from dopepp.virtual.scene import Ambient, Grooves, Light, Material, Panel, Triple, triple
from dopepp.virtual.surface import Surface

Shares = Annotated[Pair, Span(0.0, 1.0, "share")]
Roughness = Annotated[Pair, Span(0.02, 1.0, "GGX roughness")]
Pitch = Annotated[Pair, Span(1e-6, 0.1, "metres")]
Slope = Annotated[Pair, Span(0.0, 2.0, "tangent")]
Intensity = Annotated[Pair, Span(0.0, 10.0, "1 = white")]

_GREY_CAST: Final = 0.05  # largest relative deviation of a grey's channels from its brightness


@dataclass(frozen=True)
class Materials(Checked):
    """Ranges of materials; surfaces with a texture or vertex colours keep their colours.

    Attributes:
        albedo: Linear albedo of the brightest channel, the same range for greys and colours.
        coloured_share: Share of untextured surfaces that have a colour; the others are grey.
        saturation: HSV saturation of colours.
        roughness: GGX roughness of dielectrics.
        specular: Reflectance of dielectrics at normal incidence.
        texture_gain: Factor on the colours of coloured surfaces.
        texture_tint: Largest relative deviation of a colour channel from ``texture_gain``, to
            imitate scans by different cameras.
        texture_noise: Relative amplitude of noise on coloured surfaces, to imitate stains and
            openings that the model lacks.
        noise: Relative amplitude of noise on the albedo of an untextured surface.
        noise_pitch: Distance between the noise's lattice points, in radii of the object.
        metal_share: Share of untextured surfaces that are bare metal.
        metal_albedo: Reflectance of metals at normal incidence.
        metal_roughness: GGX roughness of metals.
        brushed_share: Share of metals with brush marks.
        brush_pitch: Mean distance of the marks on brushed metals, metres.
        brush_slope: Largest slope of a mark's flanks, the tangent of the normal's tilt.
        print_share: Share of untextured dielectrics that are 3D prints with layer lines.
        layer_pitch: Height of a print's layers, metres.
        layer_slope: Largest slope of the layers' flanks, defined like ``brush_slope``.
        alike_share: Probability that all instances of a part in an image share a material.
    """

    albedo: Shares = (0.02, 0.9)
    coloured_share: Share = 0.55
    saturation: Shares = (0.2, 1.0)
    roughness: Roughness = (0.25, 0.9)
    specular: Shares = (0.02, 0.07)
    texture_gain: Annotated[Pair, Span(0.0, 4.0, "factor")] = (0.7, 1.2)
    texture_tint: Share = 0.0
    texture_noise: Annotated[Pair, Span(0.0, 10.0, "factor")] = (0.0, 0.0)
    noise: Shares = (0.0, 0.12)
    noise_pitch: Annotated[Pair, Span(1e-3, 10.0, "radii")] = (0.02, 0.2)
    metal_share: Share = 0.15
    metal_albedo: Shares = (0.35, 0.95)
    metal_roughness: Roughness = (0.2, 0.6)
    brushed_share: Share = 0.4
    brush_pitch: Pitch = (0.0001, 0.0005)
    brush_slope: Slope = (0.05, 0.25)
    print_share: Share = 0.4
    layer_pitch: Pitch = (0.0001, 0.0003)
    layer_slope: Slope = (0.1, 0.5)
    alike_share: Share = 0.5

    def draw(self, rng: Generator, surface: Surface) -> Material:
        """Sample a surface's material."""
        pitch = surface.radius * rng.uniform(*self.noise_pitch)
        if surface.is_coloured:
            gain = np.full(3, rng.uniform(*self.texture_gain))
            if self.texture_tint:
                gain *= 1 + rng.uniform(-self.texture_tint, self.texture_tint, 3)
            roughness, specular = rng.uniform(*self.roughness), rng.uniform(*self.specular)
            # Sample only if needed, so that the images of other presets do not change.
            noise = rng.uniform(*self.texture_noise) if self.texture_noise[1] else 0.0
            return Material(triple(gain), roughness, specular, noise=noise, noise_pitch=pitch)
        noise = rng.uniform(*self.noise)
        if rng.random() < self.metal_share:
            return self._metal(rng, noise, pitch)
        return self._dielectric(rng, surface, noise, pitch)

    def _metal(self, rng: Generator, noise: float, pitch: float) -> Material:
        """Sample a bare metal: nearly grey, possibly with brush marks across an object axis."""
        colour = _grey(rng, rng.uniform(*self.metal_albedo))
        grooves = None
        if rng.random() < self.brushed_share:
            axis = int(rng.integers(3))
            grooves = _grooves(rng, axis, self.brush_pitch, self.brush_slope, irregularity=1.0)
        roughness = rng.uniform(*self.metal_roughness)
        return Material(
            colour, roughness, metallic=1.0, noise=noise, noise_pitch=pitch, grooves=grooves
        )

    def _dielectric(self, rng: Generator, surface: Surface, noise: float, pitch: float) -> Material:
        """Sample a plastic; a 3D print has layers along its build axis."""
        brightness = rng.uniform(*self.albedo)
        if rng.random() < self.coloured_share:
            srgb = colorsys.hsv_to_rgb(rng.random(), rng.uniform(*self.saturation), 1.0)
            # A gamma of 2.2 approximates sRGB well enough for a random colour.
            colour = triple(brightness * channel**2.2 for channel in srgb)
        else:
            colour = _grey(rng, brightness)
        grooves = None
        if rng.random() < self.print_share:
            # Slicers lay parts flat: in two of three cases the thinnest axis is the build axis.
            thinnest = rng.random() < 2 / 3
            extents: Vector = np.ptp(surface.hull, axis=0)
            axis = int(extents.argmin()) if thinnest else int(rng.integers(3))
            grooves = _grooves(rng, axis, self.layer_pitch, self.layer_slope)
        roughness, specular = rng.uniform(*self.roughness), rng.uniform(*self.specular)
        return Material(
            colour, roughness, specular, noise=noise, noise_pitch=pitch, grooves=grooves
        )


def _grey(rng: Generator, brightness: float) -> Triple:
    """Sample a linear RGB whose channels are within 5 % of ``brightness``."""
    return triple(np.clip(brightness * (1 + rng.uniform(-_GREY_CAST, _GREY_CAST, 3)), 0.0, 1.0))


def _grooves(
    rng: Generator, axis: int, pitch: Pair, slope: Pair, irregularity: float = 0.0
) -> Grooves:
    """Sample grooves across an object axis (0 to 2); see :class:`~dopepp.virtual.scene.Grooves`.

    The pitch (metres) and the slope are uniform in their ranges.
    """
    direction = triple(np.eye(3)[axis])
    return Grooves(direction, rng.uniform(*pitch), rng.uniform(*slope), irregularity)


_LUMINANCE: Final = np.array([0.2126, 0.7152, 0.0722])  # of linear sRGB (BT.709)
_RGB_FROM_XYZ: Final = np.array(
    [
        [3.2404542, -1.5371385, -0.4985314],
        [-0.9692660, 1.8760108, 0.0415560],
        [0.0556434, -0.2040259, 1.0572252],
    ]
)
"""CIE XYZ to linear sRGB (IEC 61966-2-1, white D65)."""


@dataclass(frozen=True)
class Lighting(Checked):
    """Ranges of light; an intensity is the radiance of a white surface that faces the light.

    Attributes:
        num_lights: Number of point lights; the first is the key light.
        key_intensity: Intensity of the key light.
        fill_intensity: Intensity of the other point lights.
        ambient_intensity: Intensity of the ambient light.
        max_angle_deg: Largest angle at the scene between a light and the camera (or, over a plane,
            the plane's normal); 0 is a flash light on the camera.
        distance: Distance of a light from the scene's centre, camera distances.
        temperature_k: Colour temperature at a white balance of 6500 K; low is reddish.
        tint: Largest relative deviation of a colour channel from the lamp's colour.
        ground_share: Ratio of the light from below to the light from above.
        num_panels: Number of distant lamp tubes and windows, which metals mirror.
        panel_intensity: Radiance of a panel.
        panel_width: Standard deviation across a panel, as the sine of an angle.
        panel_length: Standard deviation along a panel, as the sine of an angle.
    """

    num_lights: Annotated[tuple[int, int], Span(0, 8, "a count")] = (1, 3)
    key_intensity: Intensity = (0.45, 1.3)
    fill_intensity: Intensity = (0.1, 0.4)
    ambient_intensity: Intensity = (0.08, 0.4)
    max_angle_deg: Annotated[float, Range(0.0, 180.0, "degrees")] = 75.0
    distance: Annotated[Pair, Span(0.1, 1000.0, "camera distances")] = (1.0, 5.0)
    # Limits of the approximation of the Planckian locus.
    temperature_k: Annotated[Pair, Span(1667.0, 25000.0, "kelvin")] = (4000.0, 8500.0)
    tint: Annotated[float, Range(0.0, 0.9, "share")] = 0.06
    ground_share: Shares = (0.3, 0.9)
    num_panels: Annotated[tuple[int, int], Span(0, 8, "a count")] = (0, 0)
    panel_intensity: Intensity = (0.5, 4.0)
    panel_width: Annotated[Pair, Span(0.03, 1.0, "sine")] = (0.04, 0.25)
    panel_length: Annotated[Pair, Span(0.03, 1.0, "sine")] = (0.1, 0.7)

    def draw(
        self, rng: Generator, centre: Vector, normal: Vector | None = None
    ) -> tuple[tuple[Light, ...], Ambient]:
        """Sample point lights around ``centre`` (camera frame, metres) and the ambient light.

        ``normal`` is the unit normal of the supporting plane; None without a plane.
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
        panels: list[Panel] = []
        if self.num_panels[1]:  # sample only if needed, so that other presets' images stay equal
            count = int(rng.integers(self.num_panels[0], self.num_panels[1] + 1))
            panels = [self._panel(rng, towards) for _ in range(count)]
        ambient = Ambient(triple(towards), triple(above), triple(below), tuple(panels))
        return tuple(lights), ambient

    def _panel(self, rng: Generator, up: Vector) -> Panel:
        """Sample a lamp tube or window in the upper hemisphere."""
        middle = _in_cap(rng, up, 90.0)
        right, across, _ = rotation_to_z(middle)
        angle = rng.uniform(0, np.pi)
        along = np.cos(angle) * right + np.sin(angle) * across
        width, length = rng.uniform(*self.panel_width), rng.uniform(*self.panel_length)
        intensity = rng.uniform(*self.panel_intensity) * self._colour(rng)
        return Panel(triple(middle), triple(along), width, length, triple(intensity))

    def _colour(self, rng: Generator) -> Vector:
        """Sample the linear RGB of a lamp of luminance about 1."""
        # Uniform in 1/T, because equal steps of 1/T are equally visible (mired).
        warm, cold = self.temperature_k
        colour = black_body_rgb(1.0 / rng.uniform(1.0 / cold, 1.0 / warm))
        return np.asarray(colour * (1 + rng.uniform(-self.tint, self.tint, 3)))


def black_body_rgb(temperature_k: float) -> Vector:
    """Return the linear sRGB colour of luminance 1 of a black body (white at about 6500 K).

    The chromaticity is the cubic approximation of the Planckian locus by Kim et al., "Design of
    advanced color temperature control system", US patent 7024034 (2002), for 1667 to 25000 K.
    Negative components (colours outside sRGB's gamut) are clipped to 0.
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
    """Sample a unit vector uniformly over the spherical cap around a unit axis."""
    cosine = rng.uniform(np.cos(np.radians(angle_deg)), 1.0)
    azimuth, sine = rng.uniform(0, 2 * np.pi), np.sqrt(1 - cosine**2)
    right, across, _ = rotation_to_z(axis)
    around = np.cos(azimuth) * right + np.sin(azimuth) * across
    return np.asarray(cosine * axis - sine * around)
