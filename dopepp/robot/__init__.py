"""The robot's side: what ties a camera to an arm."""
