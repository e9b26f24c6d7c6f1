"""Calibration of a camera, a tool, a bench, and the camera's pose on the robot (paper 4.3)."""
