"""The rasteriser: visibility, shadows, fragments, light and their sum, the picture."""
