"""Random materials: plastics, 3D prints with layer lines, plain and brushed metal.

To add a kind of material, give :class:`Materials` its share and its ranges, and draw it in
:meth:`Materials.draw`.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.random import Generator

from dopepp.core.checks import check_number, check_range
from dopepp.geometry.rotation import Vector
from dopepp.virtual.scene import Grooves, Material, Triple, triple
from dopepp.virtual.surface import Surface

_GREY_CAST: Final = 0.05
"""Largest relative deviation of a grey's channels: real greys are not quite grey."""

_DISPLAY_POWER: Final = 2.2
"""The usual power for sRGB, exact enough for a random colour."""


@dataclass(frozen=True)
class Materials:
    """Ranges of what surfaces are made of; a textured surface keeps its colours.

    Attributes:
        albedo: Linear albedo of the brightest channel, the same range for greys and colours.
        coloured_share: Share of untextured surfaces that have a colour; the others are grey.
        roughness: GGX roughness of dielectrics.
        specular: Their reflectance at normal incidence.
        texture_gain: Factor on the colours of textured surfaces.
        noise: Relative amplitude of the albedo's variation over an untextured surface.
        noise_pitch: Size of that variation over the object's radius.
        metal_albedo: Their reflectance at normal incidence.
        brushed_share: Share of metals that are brushed.
        brush_pitch: Mean distance of brush marks, metres.
        brush_slope: Largest slope of their flanks, the tangent of the normal's tilt.
        print_share: Share of untextured dielectrics that are 3D prints with layer lines.
        layer_pitch: Height of a print's layers, metres.
        layer_slope: Largest slope of the layers' flanks, the tangent of the normal's tilt.
        alike_share: Chance that all instances of a part in an image are made of the same.
    """

    albedo: tuple[float, float] = (0.02, 0.9)
    coloured_share: float = 0.55
    saturation: tuple[float, float] = (0.2, 1.0)
    roughness: tuple[float, float] = (0.25, 0.9)
    specular: tuple[float, float] = (0.02, 0.07)
    texture_gain: tuple[float, float] = (0.7, 1.2)
    noise: tuple[float, float] = (0.0, 0.12)
    noise_pitch: tuple[float, float] = (0.02, 0.2)
    metal_share: float = 0.15
    metal_albedo: tuple[float, float] = (0.35, 0.95)
    metal_roughness: tuple[float, float] = (0.2, 0.6)
    brushed_share: float = 0.4
    brush_pitch: tuple[float, float] = (0.0001, 0.0005)
    brush_slope: tuple[float, float] = (0.05, 0.25)
    print_share: float = 0.4
    layer_pitch: tuple[float, float] = (0.0001, 0.0003)
    layer_slope: tuple[float, float] = (0.1, 0.5)
    alike_share: float = 0.5

    def __post_init__(self) -> None:
        for kind in ("coloured", "metal", "brushed", "print", "alike"):
            name = f"{kind}_share"
            check_number(name, getattr(self, name), 0.0, 1.0, "share", of=self)
        for name in ("albedo", "saturation", "specular", "metal_albedo", "noise"):
            check_range(name, getattr(self, name), 0.0, 1.0, "share", of=self)
        for name in ("roughness", "metal_roughness"):
            check_range(name, getattr(self, name), 0.02, 1.0, "GGX roughness", of=self)
        check_range("texture_gain", self.texture_gain, 0.0, 4.0, "factor", of=self)
        check_range("noise_pitch", self.noise_pitch, 1e-3, 10.0, "radii", of=self)
        for name in ("brush_pitch", "layer_pitch"):
            check_range(name, getattr(self, name), 1e-6, 0.1, "metres", of=self)
        for name in ("brush_slope", "layer_slope"):
            check_range(name, getattr(self, name), 0.0, 2.0, "tangent", of=self)

    def draw(self, rng: Generator, surface: Surface) -> Material:
        """Draw what a surface is made of."""
        pitch = surface.radius * rng.uniform(*self.noise_pitch)
        if len(surface.uv):
            gain = rng.uniform(*self.texture_gain)
            roughness, specular = rng.uniform(*self.roughness), rng.uniform(*self.specular)
            return Material((gain, gain, gain), roughness, specular, noise_pitch=pitch)
        noise = rng.uniform(*self.noise)
        if rng.random() < self.metal_share:
            return self._metal(rng, noise, pitch)
        return self._dielectric(rng, surface, noise, pitch)

    def _metal(self, rng: Generator, noise: float, pitch: float) -> Material:
        """Draw a bare metal: grey but for a cast, brushed along one of the object's axes or not."""
        colour = _grey(rng, rng.uniform(*self.metal_albedo))
        grooves = None
        if rng.random() < self.brushed_share:
            grooves = Grooves(
                axis=_unit_axis(int(rng.integers(3))),
                pitch=rng.uniform(*self.brush_pitch),
                slope=rng.uniform(*self.brush_slope),
                irregularity=1.0,
            )
        roughness = rng.uniform(*self.metal_roughness)
        return Material(
            colour, roughness, metallic=1.0, noise=noise, noise_pitch=pitch, grooves=grooves
        )

    def _dielectric(self, rng: Generator, surface: Surface, noise: float, pitch: float) -> Material:
        """Draw a plastic; a printed one has layers along the axis it was built up."""
        brightness = rng.uniform(*self.albedo)
        coloured = rng.random() < self.coloured_share
        colour = self._colour(rng, brightness) if coloured else _grey(rng, brightness)
        grooves = None
        if rng.random() < self.print_share:
            grooves = Grooves(
                axis=_build_axis(rng, surface),
                pitch=rng.uniform(*self.layer_pitch),
                slope=rng.uniform(*self.layer_slope),
            )
        roughness, specular = rng.uniform(*self.roughness), rng.uniform(*self.specular)
        return Material(
            colour, roughness, specular, noise=noise, noise_pitch=pitch, grooves=grooves
        )

    def _colour(self, rng: Generator, brightness: float) -> Triple:
        """Draw the linear albedo of a random hue whose brightest channel is given."""
        srgb = colorsys.hsv_to_rgb(rng.random(), rng.uniform(*self.saturation), 1.0)
        return triple(brightness * channel**_DISPLAY_POWER for channel in srgb)


def _grey(rng: Generator, brightness: float) -> Triple:
    return triple(np.clip(brightness * (1 + rng.uniform(-_GREY_CAST, _GREY_CAST, 3)), 0.0, 1.0))


def _build_axis(rng: Generator, surface: Surface) -> Triple:
    """Draw the axis a print was built up along: two times of three the thinnest, as slicers lay."""
    extents: Vector = np.ptp(surface.hull, axis=0)
    thinnest = rng.random() < 2 / 3
    return _unit_axis(int(extents.argmin()) if thinnest else int(rng.integers(3)))


def _unit_axis(number: int) -> Triple:
    return triple(number == axis for axis in range(3))
