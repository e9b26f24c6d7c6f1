"""Synthetic data: images of parts in random scenes, rendered with labels and without torch."""

from dopepp.virtual.factory import Factory
from dopepp.virtual.presets import PRESETS
from dopepp.virtual.renderers.raster import render
from dopepp.virtual.scene import Scene, SceneObject
from dopepp.virtual.surface import make_surface

__all__ = ["PRESETS", "Factory", "Scene", "SceneObject", "make_surface", "render"]
