"""Grasping in simulation: 200 grasps from pictures, as the paper counts them (4.3, Table 9)."""

import logging

# PyOpenGL, which MuJoCo loads, tells everybody that it would be faster with another package.
logging.getLogger("OpenGL.acceleratesupport").setLevel(logging.WARNING)
