"""Grasping in simulation: 200 grasps from pictures, as the paper counts them (4.3, Table 9)."""

import ctypes.util
import logging
import os
import sys

# MuJoCo chooses its OpenGL as it is imported: a window's, or EGL's where there is no display. Where
# that is missing it could not be imported at all with it, and simulates without any.
if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"} & {*os.environ}:
    os.environ["MUJOCO_GL"] = "egl" if ctypes.util.find_library("EGL") else "off"

# PyOpenGL, which MuJoCo loads, tells everybody that it would be faster with another package.
logging.getLogger("OpenGL.acceleratesupport").setLevel(logging.WARNING)
