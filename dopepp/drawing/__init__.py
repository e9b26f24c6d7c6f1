"""Images for people: wireframes, belief maps, contact sheets and curves, on numpy images."""
