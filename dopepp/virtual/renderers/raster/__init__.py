"""The rasteriser: visibility, shadows, fragments, light, picture."""
