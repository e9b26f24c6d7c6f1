"""Robots: calibration of a camera on an arm, nodes that publish poses, and simulated grasps."""
