"""Simulated grasps by estimated poses, counted as in the paper (4.3, Table 9)."""

import ctypes.util
import logging
import os
import sys

# MuJoCo selects an OpenGL backend at import: a window's, or EGL without a display. Without
# EGL the import would fail, so rendering is switched off; the simulation works.
if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"} & {*os.environ}:
    os.environ["MUJOCO_GL"] = "egl" if ctypes.util.find_library("EGL") else "off"

# MuJoCo loads PyOpenGL, which advertises an accelerator package.
logging.getLogger("OpenGL.acceleratesupport").setLevel(logging.WARNING)
