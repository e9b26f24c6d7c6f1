"""How a surface reflects light: plastic, metal, 3D print, brushed metal."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Grooves:
    """Fine parallel grooves: the layer lines of a 3D print, the streaks of brushed metal.

    They tilt the surface's normal. Finer than a pixel they only widen the highlight.

    Attributes:
        axis: Unit vector, object frame, along which groove follows groove.
        pitch: Metres from one groove to the next.
        slope: Largest slope of a groove's flanks, the tangent of the normal's tilt.
        irregularity: 0 for even grooves (layer lines), 1 for random depths and widths (brushing).
    """

    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    pitch: float = 0.0002
    slope: float = 0.3
    irregularity: float = 0.0


@dataclass(frozen=True)
class Material:
    """How a surface reflects light (Lambert plus GGX, metallic workflow).

    Attributes:
        colour: Linear albedo in [0, 1] per channel; a factor on the texture where there is one.
        roughness: GGX roughness in (0, 1]; 1 is chalk.
        specular: Reflectance at normal incidence of the dielectric part, 0.04 for plastics.
        metallic: 0 is a dielectric, 1 a metal: no diffuse light, and the colour is its reflectance
            at normal incidence.
        noise: Relative amplitude of the albedo's variation over the surface.
        noise_pitch: Size of that variation, metres.
        grooves: Layer lines or brushing, or None.
    """

    colour: tuple[float, float, float] = (0.6, 0.6, 0.6)
    roughness: float = 0.6
    specular: float = 0.04
    metallic: float = 0.0
    noise: float = 0.0
    noise_pitch: float = 0.005
    grooves: Grooves | None = None
