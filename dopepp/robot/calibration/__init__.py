"""Calibration of a camera, a tool, a bench, and of where the camera is on the robot (paper 4.3)."""
