"""Visualisation: wireframes, belief maps, contact sheets and curves, as numpy images."""
