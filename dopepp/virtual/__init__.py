"""Synthetic data: images of parts in random scenes, rendered with labels and without torch."""

from dopepp.virtual.backgrounds import Backgrounds, PhotoBackgrounds, ProceduralBackgrounds
from dopepp.virtual.body import Distractors
from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import PRESETS, Preset, preset_of
from dopepp.virtual.presets.looks import Lighting, Materials
from dopepp.virtual.presets.placement import (
    DistancePlacement,
    FacingTurning,
    FillPlacement,
    FreeTurning,
    OffsetPlacement,
)
from dopepp.virtual.presets.table import Table
from dopepp.virtual.renderers.raster import Silhouette, render, silhouette, visible_fractions
from dopepp.virtual.scene import (
    Ambient,
    Grooves,
    Light,
    Material,
    Plane,
    Rendered,
    Scene,
    SceneObject,
)
from dopepp.virtual.sensor import Sensor, Sensors, capture
from dopepp.virtual.surface import Surface, make_surface

__all__ = [
    "PRESETS",
    "Ambient",
    "Backgrounds",
    "DistancePlacement",
    "Distractors",
    "FacingTurning",
    "Factory",
    "FillPlacement",
    "FreeTurning",
    "Grooves",
    "Light",
    "Lighting",
    "Material",
    "Materials",
    "OffsetPlacement",
    "PhotoBackgrounds",
    "Plane",
    "Preset",
    "ProceduralBackgrounds",
    "Rendered",
    "Scene",
    "SceneObject",
    "Sensor",
    "Sensors",
    "Silhouette",
    "Surface",
    "Table",
    "capture",
    "make_surface",
    "preset_of",
    "render",
    "silhouette",
    "visible_fractions",
]
