"""The steps of the rasteriser: visibility, shadows, fragments, light, picture."""
