"""The virtual-reality factory: from parts to labelled images, without torch and without files."""

from dopepp.virtual.backgrounds import Backgrounds, PhotoBackgrounds, ProceduralBackgrounds
from dopepp.virtual.factory import Factory
from dopepp.virtual.placement import (
    DistancePlacement,
    FacingTurning,
    FillPlacement,
    FreeTurning,
    OffsetPlacement,
)
from dopepp.virtual.presets import PRESETS, Distractors, Lighting, Preset
from dopepp.virtual.randomise import random_scene
from dopepp.virtual.rasteriser import Rendered, render, visible_fractions
from dopepp.virtual.scene import Ambient, Light, Material, Scene, SceneObject
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
    "Light",
    "Lighting",
    "Material",
    "OffsetPlacement",
    "PhotoBackgrounds",
    "Preset",
    "ProceduralBackgrounds",
    "Rendered",
    "Scene",
    "SceneObject",
    "Surface",
    "make_surface",
    "random_scene",
    "render",
    "visible_fractions",
]
